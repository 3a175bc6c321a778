"""B or C again: exact without noise, NumPy's least squares with it, derivatives by differences."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

from lpvid._results import Status
from lpvid.data import IOData
from lpvid.models import StateSpace
from lpvid.reduce import InputUpdate, OutputUpdate, update_model

DT = 0.1
EVERYTHING = InputUpdate(feedthrough=True, initial_state=True)


@pytest.fixture(scope="module")
def true():
    A = np.array([[0.9, 0.3, 0.0], [-0.3, 0.9, 0.1], [0.0, 0.0, 0.5]])
    rng = np.random.default_rng(0)
    B, C, D = rng.standard_normal((3, 2)), rng.standard_normal((2, 3)), rng.standard_normal((2, 2))
    return StateSpace(A, B, np.array([[1.0], [20.0]]) * C, D, dt=DT)


@pytest.fixture(scope="module")
def starts():
    return np.random.default_rng(1).standard_normal((2, 3))


@pytest.fixture(scope="module")
def data(true, starts):
    rng = np.random.default_rng(2)
    u = [rng.standard_normal((n, 2)) for n in (50, 40)]
    return IOData(u=u, y=[true.simulate(u=v, x0=x) for v, x in zip(u, starts, strict=True)], dt=DT)


def changed(model, **matrices):
    parts = {name: getattr(model, name) for name in "ABCD"} | matrices
    return StateSpace(*(parts[name] for name in "ABCD"), dt=model.dt)


def test_without_noise_everything_is_found_again(true, data, starts):
    found = update_model(changed(true, B=0 * true.B, D=0 * true.D), data, EVERYTHING)
    np.testing.assert_allclose(found.model.B, true.B, atol=1e-10)
    np.testing.assert_allclose(found.model.D, true.D, atol=1e-9)
    np.testing.assert_allclose(found.x0, starts, atol=1e-9)
    assert found.status == Status.successful and np.all(found.relative_error < 1e-10)
    found = update_model(changed(true, B=0 * true.B), data, x0=starts)
    np.testing.assert_allclose(found.model.B, true.B, atol=1e-10)
    wrong = changed(true, C=0 * true.C, D=0 * true.D)
    found = update_model(wrong, data, OutputUpdate(feedthrough=True), x0=starts)
    np.testing.assert_allclose(found.model.C, true.C, atol=1e-8)
    np.testing.assert_allclose(found.model.D, true.D, atol=1e-8)


def test_with_noise_it_is_least_squares_on_the_responses_of_scipy(true, data):
    """Columns by SciPy's simulation of one entry of B at a time (002, equations 3-13 to 3-18)."""
    rng = np.random.default_rng(3)
    noisy = data.replace(y=data.y + jnp.asarray(rng.standard_normal(data.y.shape)))
    A, C, D = (np.asarray(m) for m in (true.A, true.C, true.D))
    scale = np.sqrt(np.mean(np.asarray(noisy.y) ** 2, axis=0))

    def stacked(B, D):
        parts = [
            scipy.signal.dlsim((A, B, C, D, DT), np.asarray(r.u))[1] / scale for r in noisy.records
        ]
        return np.concatenate(parts).ravel()

    columns = []
    for j in range(2):
        for i in range(3):
            unit = np.zeros((3, 2))
            unit[i, j] = 1.0
            columns.append(stacked(unit, 0 * D))
    right = (np.asarray(noisy.y) / scale).ravel() - stacked(np.zeros((3, 2)), D)
    expected = np.linalg.lstsq(np.stack(columns, axis=1), right, rcond=None)[0]
    found = update_model(true, noisy)
    np.testing.assert_allclose(found.model.B, expected.reshape(2, 3).T, rtol=1e-9)
    states = [
        scipy.signal.dlsim((A, true.B, np.eye(3), np.zeros((3, 2)), DT), np.asarray(r.u))[1]
        for r in noisy.records
    ]
    rows = np.concatenate([np.concatenate(states), np.asarray(noisy.u)], axis=1)
    expected = np.linalg.lstsq(rows, np.asarray(noisy.y), rcond=None)[0].T
    found = update_model(true, noisy, OutputUpdate(feedthrough=True)).model
    np.testing.assert_allclose(np.concatenate([found.C, found.D], axis=1), expected, rtol=1e-8)


def errors(true, data, shift, method):
    """A number that depends on all that is found, for a model and records that move together."""
    model = changed(true, A=true.A + shift * jnp.eye(3))
    found = update_model(model, data.replace(y=data.y * (1.0 + shift)), method)
    return jnp.sum(found.relative_error) + jnp.sum(found.model.B + 3.0 * found.model.C.T)


def test_derivatives_are_those_of_differences(true, data):
    value = functools.partial(errors, true, data, method=EVERYTHING)
    step = 1e-5
    difference = (value(shift=-0.02 + step) - value(shift=-0.02 - step)) / (2 * step)
    slope = jax.jit(jax.grad(lambda shift: value(shift=shift)))(-0.02)
    np.testing.assert_allclose(slope, difference, rtol=1e-6)


@pytest.mark.slow
def test_derivatives_for_both_matrices_under_vmap(true, data):
    def both(shift):
        return sum(errors(true, data, shift, m) for m in (InputUpdate(), OutputUpdate()))

    step = 1e-5
    shifts = -0.02 + step * jnp.array([-1.0, 0.0, 1.0])
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(both)))(shifts)
    np.testing.assert_allclose(slopes[1], (values[2] - values[0]) / (2 * step), rtol=1e-6)
    np.testing.assert_allclose(values[1], both(shifts[1]), rtol=1e-10)


def test_a_state_that_is_not_seen_is_said_and_given_no_weight(true, data):
    unseen = changed(true, C=true.C.at[:, 2].set(0.0), A=jnp.diag(jnp.array([0.9, 0.5, 0.7])))
    found = update_model(unseen, data)
    assert found.status == Status.ill_conditioned
    np.testing.assert_allclose(found.model.B[2], 0.0, atol=1e-12)
    assert np.all(np.isfinite(found.relative_error))


def test_faults_are_named(true, data):
    with pytest.raises(ValueError, match="dt=0.2"):
        update_model(StateSpace(true.A, true.B, true.C, dt=0.2), data)
    with pytest.raises(ValueError, match="data.select"):
        update_model(StateSpace(true.A, true.B[:, :1], true.C, dt=DT), data)
    with pytest.raises(ValueError, match="batch axes"):
        update_model(jax.tree.map(lambda m: m[None], true), data)
    short = IOData(u=data.u[:4], y=data.y[:4], dt=DT)
    with pytest.raises(ValueError, match="longer records"):
        update_model(true, short, EVERYTHING)
