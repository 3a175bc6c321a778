"""LPV models from physical parameters."""

import jax.numpy as jnp
import numpy as np
import pytest

from lpvid.models import GrayBoxLPV, StateSpace, series

NAMES = ("stiffness", "hardening", "damping")


def spring(parameters, kappa):
    stiffness = parameters[0] + parameters[1] * kappa[0] ** 2
    A = jnp.array([[0.0, 1.0], [-1.0, 0.0]]).at[1].set(-jnp.stack([stiffness, parameters[2]]))
    return StateSpace(A, jnp.array([[0.0], [1.0]]), jnp.array([[1.0, 0.0]]))


@pytest.fixture(scope="module")
def model():
    return GrayBoxLPV(spring, [4.0, 1.0, 0.2], NAMES, kappa_low=0.0, kappa_high=2.0)


def test_frozen_models_are_the_functions(model):
    np.testing.assert_array_equal(model.at(1.5).A, spring(model.parameters, jnp.array([1.5])).A)
    assert model.nx == 2 and bool(model.is_stable(1.0))
    with pytest.warns(UserWarning, match="extrapolates"):
        model.at(2.5)


def test_at_rest_it_simulates_like_the_frozen_model(model):
    u = np.random.default_rng(0).standard_normal((60, 1))
    expected = model.at(1.0).simulate(u=u, dt=0.1)
    found = model.simulate(u=u, kappa=np.full(60, 1.0), dt=0.1)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


def test_faults_are_named():
    with pytest.raises(ValueError, match="one name a parameter"):
        GrayBoxLPV(spring, [4.0, 1.0], NAMES, kappa_low=0.0, kappa_high=1.0)
    with pytest.raises(ValueError, match="no range"):
        GrayBoxLPV(spring, [4.0, 1.0, 0.2], NAMES, kappa_low=1.0, kappa_high=0.0)


def test_it_connects_like_any_other(model):
    lag = StateSpace([[-3.0]], [[3.0]], [[1.0]])
    both = series(model, lag).at(1.0)
    expected = series(model.at(1.0), lag)
    np.testing.assert_allclose(both.dc_gain(), expected.dc_gain(), rtol=1e-12)
