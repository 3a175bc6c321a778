"""The delta method against Monte Carlo, closed forms and finite differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpvid.analysis import (
    ResponseUncertainty,
    frequency_response_covariance,
    pole_covariance,
    propagate,
)
from lpvid.models import StateSpace

THETA = np.array([2.0 * np.pi * 2.0, 0.05, 1.5, 3.0])
SPREAD = np.array([0.03, 0.002, 0.01, 0.05])
HALF = np.diag(SPREAD) @ np.linalg.cholesky(np.full((4, 4), 0.3) + 0.7 * np.eye(4))
P = HALF @ HALF.T
OMEGA = np.array([0.0, 5.0, 2.0 * np.pi * 2.0, 40.0])
DRAWS = 4000


def build(theta, stack):
    """One mode of frequency θ0 and damping ratio θ1, and a real pole at −θ3."""
    w, z, gain, rate = theta[0], theta[1], theta[2], theta[3]
    A = stack([[0.0, 1.0, 0.0], [-(w**2), -2.0 * z * w, 0.0], [0.0, 0.0, -rate]])
    return A, np.array([[0.0], [1.0], [1.0]]), stack([[gain * w**2, 0.0, rate]])


def model_at(theta):
    def stack(rows):
        return jnp.stack([jnp.stack([jnp.asarray(v, float) for v in row]) for row in rows])

    A, B, C = build(theta, stack)
    return StateSpace(A, B, C)


def sampled_at(theta):
    return model_at(theta).discretise(0.05)


@pytest.fixture(scope="module")
def draws():
    return THETA + np.random.default_rng(7).standard_normal((DRAWS, 4)) @ HALF.T


def assert_covariance(found, samples):
    """Within five standard errors of a sample covariance, and the delta method's second order."""
    wanted = np.cov(samples.T)
    sizes = np.sqrt(np.diagonal(wanted))
    np.testing.assert_allclose(
        found / np.outer(sizes, sizes),
        wanted / np.outer(sizes, sizes),
        atol=5 * 2**0.5 / DRAWS**0.5,
    )


def test_propagation_of_linear_and_shaped_functions():
    M = np.random.default_rng(8).standard_normal((6, 4))
    value, covariance = propagate(lambda p: (M @ p).reshape(2, 3), THETA, P)
    assert value.shape == (2, 3) and covariance.shape == (2, 3, 2, 3)
    np.testing.assert_allclose(covariance.reshape(6, 6), M @ P @ M.T, rtol=1e-12)
    scalar, variance = jax.jit(lambda p: propagate(lambda q: q @ q, p, P))(THETA)
    np.testing.assert_allclose(variance, 4.0 * THETA @ P @ THETA, rtol=1e-12)
    assert scalar.shape == variance.shape == ()


@pytest.fixture(scope="module")
def found():
    """All that is tested of the two models, compiled once."""

    def polar(theta):
        response = sampled_at(theta).frequency_response(OMEGA)[:, 0, 0]
        return jnp.stack([jnp.abs(response), jnp.angle(response)])

    def everything(theta):
        return {
            "response": frequency_response_covariance(model_at, theta, P, OMEGA),
            "sampled response": frequency_response_covariance(sampled_at, theta, P, OMEGA),
            "polar": propagate(polar, theta, P)[1],
            "poles": pole_covariance(model_at, theta, P),
            "sampled poles": pole_covariance(sampled_at, theta, P),
        }

    return jax.jit(everything)(THETA)


def test_response_covariance_is_that_of_random_parameters(draws, found):
    known = found["response"]
    w, z, gain, rate = draws.T
    for index, omega in enumerate(OMEGA):
        s = 1j * omega
        response = gain * w**2 / (s**2 + 2 * z * w * s + w**2) + rate / (s + rate)
        if omega == 0.0:
            # Only the gain matters there.
            wanted = np.diag([P[2, 2], 0.0])
            np.testing.assert_allclose(known.covariance[index, 0, 0], wanted, atol=1e-15)
            continue
        samples = np.stack([response.real, response.imag], axis=1)
        assert_covariance(known.covariance[index, 0, 0], samples)
        size, angle = np.abs(response), np.angle(response)
        np.testing.assert_allclose(known.magnitude_std[index, 0, 0], size.std(), rtol=0.08)
        np.testing.assert_allclose(known.phase_std[index, 0, 0], angle.std(), rtol=0.08)


def test_magnitude_and_phase_follow_from_propagation(found):
    known = found["sampled response"]
    variance = np.einsum("aiai->ai", found["polar"])
    np.testing.assert_allclose(known.magnitude_std[:, 0, 0] ** 2, variance[0], rtol=1e-9)
    np.testing.assert_allclose(known.phase_std[:, 0, 0] ** 2, variance[1], rtol=1e-9, atol=1e-20)


def test_a_response_that_is_zero_has_a_radius_and_no_phase():
    covariance = jnp.array([0.04, 0.0, 0.01]).reshape(1, 1, 1, 3)[..., jnp.array([[0, 1], [1, 2]])]
    known = ResponseUncertainty(jnp.zeros(1), jnp.zeros((1, 1, 1), complex), covariance)
    assert float(known.magnitude_std[0, 0, 0]) == pytest.approx(0.2)
    assert np.isinf(known.phase_std[0, 0, 0])


@pytest.mark.parametrize("kind", ["poles", "sampled poles"])
def test_pole_covariance_is_that_of_random_parameters(kind, draws, found):
    known = found[kind]
    w, z, _, rate = draws.T
    upper = w * (-z + 1j * np.sqrt(1 - z**2))
    plane = (lambda s: np.exp(0.05 * s)) if kind == "sampled poles" else (lambda s: s)
    # By frequency: the real pole, then the pair, the upper one first.
    np.testing.assert_allclose(known.frequency, [3.0, THETA[0], THETA[0]], rtol=1e-9)
    np.testing.assert_allclose(known.damping, [1.0, 0.05, 0.05], rtol=1e-9)
    real = plane(-rate)
    np.testing.assert_allclose(known.covariance[0, 0, 0], real.var(), rtol=0.12)
    np.testing.assert_allclose(np.asarray(known.covariance[0])[[0, 1, 1], [1, 0, 1]], 0.0)
    for index, pole in ((1, plane(upper)), (2, plane(upper.conj()))):
        assert_covariance(known.covariance[index], np.stack([pole.real, pole.imag], axis=1))
    # Frequency and damping are parameters themselves.
    wanted = np.sqrt([P[3, 3], P[0, 0], P[0, 0]])
    np.testing.assert_allclose(known.frequency_std, wanted, rtol=1e-8)
    np.testing.assert_allclose(known.damping_std, np.sqrt([0.0, P[1, 1], P[1, 1]]), atol=1e-10)


class Structured(eqx.Module):
    """A model that has its matrices as `state_space`, and a method as `Refined` has one."""

    scale: jax.Array

    @property
    def state_space(self):
        return StateSpace(-self.scale[None, None], [[1.0]], [[1.0]])

    def model_at(self, parameters):
        return Structured(self.scale * parameters[0])


def test_models_with_a_state_space_inside():
    known = pole_covariance(Structured(jnp.array(2.0)).model_at, [1.5], [[0.01]])
    np.testing.assert_allclose(known.poles, [-3.0])
    np.testing.assert_allclose(known.frequency_std, [0.2], rtol=1e-12)
    # Compiled once, with what the method depends on as an argument.
    other = pole_covariance(Structured(jnp.array(4.0)).model_at, [1.5], [[0.01]])
    np.testing.assert_allclose(other.frequency_std, [0.4], rtol=1e-12)


def test_faults_are_named():
    with pytest.raises(ValueError, match="model_at: returns"):
        pole_covariance(lambda p: p, THETA, P)
    with pytest.raises(ValueError, match="covariance has shape"):
        pole_covariance(model_at, THETA, P[:2])
    with pytest.raises(ValueError, match="covariance has shape"):
        propagate(jnp.sum, THETA, P[:2])
    with pytest.raises(ValueError, match="real ones"):
        propagate(lambda p: p.astype(complex), THETA, P)
