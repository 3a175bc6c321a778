"""Frequency responses against scipy.signal and finite differences."""

import jax
import jax.numpy as jnp
import jax.test_util
import numpy as np
import pytest
from scipy import signal

from lpvid.models import StateSpace, frequency_response

from .systems import batch, flexible, matrices

OMEGA = np.linspace(0.0, 80.0, 11)


def test_agrees_with_scipy_in_continuous_time():
    A, B, C, D = matrices(flexible())
    ours = frequency_response(flexible(), OMEGA)
    for k in range(2):
        _, expected = signal.freqresp((A, B[:, [k]], C[:1], D[:1, [k]]), OMEGA)
        np.testing.assert_allclose(ours[:, 0, k], expected, rtol=1e-10)


def test_agrees_with_scipy_in_discrete_time():
    system = flexible().discretise(0.02)
    A, B, C, D = matrices(system)
    _, expected = signal.dfreqresp((A, B[:, [1]], C[1:], D[1:, [1]], 0.02), OMEGA * 0.02)
    np.testing.assert_allclose(system.frequency_response(OMEGA)[:, 1, 1], expected, rtol=1e-10)


def test_batches_broadcast():
    systems = batch(3)
    responses = systems.frequency_response(OMEGA)
    assert responses.shape == (3, 11, 2, 2)
    mapped = jax.vmap(lambda system: system.frequency_response(OMEGA))(systems)
    np.testing.assert_allclose(responses, mapped, rtol=1e-12)


def test_a_double_integrator_needs_no_eigenvectors():
    system = StateSpace([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [[1.0, 0.0]])
    response = system.frequency_response([0.5, 2.0])[:, 0, 0]
    np.testing.assert_allclose(response, [-4.0, -0.25], rtol=1e-14)


# Few entries take the tangent rule with the Jacobian, many the one with two products.
@pytest.mark.parametrize("modes", [1, 10])
@pytest.mark.parametrize("dt", [0.0, pytest.param(0.02, marks=pytest.mark.slow)])
def test_gradients_forward_and_reverse(modes, dt):
    system = flexible(modes=modes)
    system = system.discretise(dt) if dt else system
    rng = np.random.default_rng(0)
    weight = jnp.asarray(rng.normal(size=(2, 4, 2, 2)))

    @jax.jit
    def value(system, omega):
        response = system.frequency_response(omega)
        return jnp.sum(weight[0] * response.real + weight[1] * response.imag)

    arguments = (system, jnp.asarray([1.0, 10.0, 30.0, 70.0]))
    jax.test_util.check_grads(value, arguments, order=1, modes=("fwd", "rev"), rtol=1e-5, eps=1e-6)


def test_second_derivatives():
    system = flexible(modes=1)

    def value(A):
        response = StateSpace(A, system.B, system.C).frequency_response([3.0, 20.0])
        return jnp.sum(jnp.abs(response) ** 2)

    gradient = jax.jit(jax.grad(value))
    E, step = jnp.asarray(np.random.default_rng(1).normal(size=(2, 2))), 1e-5
    curvature = jax.jvp(gradient, (system.A,), (E,))[1]
    expected = (gradient(system.A + step * E) - gradient(system.A - step * E)) / (2 * step)
    np.testing.assert_allclose(curvature, expected, rtol=1e-6)
