"""Records of the arm with an effect that its linear model does not know."""

import jax
import numpy as np
import pytest

from lpvid.mechanics import reference_two_link_arm
from lpvid.models import ZeroOrderHold
from lpvid.study import undeclared_record

ARM = reference_two_link_arm()


def _record(seed, **options):
    return undeclared_record(ARM, jax.random.key(seed), n_samples=200, **options)


@pytest.fixture(scope="module")
def drawn():
    return [_record(seed) for seed in range(12)]


def test_the_key_draws_effect_and_size(drawn):
    assert {one.name for one in drawn} == {"coulomb", "quadratic-drag", "input-delay"}
    assert {one.joint for one in drawn if one.name == "coulomb"} == {1, 2}
    assert len({one.size for one in drawn}) == 12
    again = _record(3)
    np.testing.assert_array_equal(again.data.y, drawn[3].data.y)
    assert again[1:] == drawn[3][1:]
    one = drawn[0].data
    assert one.y.shape == (200, 2) and one.dt == pytest.approx(1e-3)


def _expected(one):
    """The linearised arm, step by step; its drives turn a torque τ into a reference τ/λ."""
    fine = ARM.linearised(np.pi / 2).discretise(1e-4, ZeroOrderHold())
    A, B, C = (np.asarray(matrix) for matrix in (fine.A, fine.B, fine.C))
    late = round(one.size / 1e-4) if one.name == "input-delay" else 0
    u = np.concatenate([np.zeros((late, 2)), np.repeat(np.asarray(one.data.u), 10, axis=0)])
    x, y = np.zeros(6), []
    for reference in u[: 10 * one.data.n_samples]:
        y.append(C @ x)
        rate, torque = x[2:4], np.zeros(2)
        if one.name == "coulomb":
            torque = -one.size * np.tanh(rate / 2e-3)
        if one.name == "quadratic-drag":
            torque = -one.size * rate * np.abs(rate)
        at_joint = np.arange(1, 3) == one.joint
        x = A @ x + B @ (reference + np.where(at_joint, torque, 0.0) / ARM.velocity_gains)
    return np.asarray(y)[::10]


def test_the_record_is_what_the_linear_arm_does_with_the_effect(drawn):
    for one in {(one.name, one.joint): one for one in drawn}.values():
        expected = _expected(one)
        # Small motion: what is left is 1 % of noise and a little curvature.
        assert np.all(np.std(one.data.y - expected, axis=0) < 0.04 * np.std(expected, axis=0))


def test_faults_are_named():
    with pytest.raises(ValueError, match="theta2=4"):
        _record(0, theta2=4.0)
    with pytest.raises(ValueError, match="n_samples=10"):
        undeclared_record(ARM, jax.random.key(0), n_samples=10)
