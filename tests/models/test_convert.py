"""Conversions against scipy.signal, round trips and finite differences."""

import jax
import jax.numpy as jnp
import jax.test_util
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from lpvid.models import StateSpace, Tustin, ZeroOrderHold, c2d, d2c, gramians

from .systems import batch, flexible, matrices

DT = 0.02
METHODS = {"zoh": ZeroOrderHold(), "bilinear": Tustin()}


@pytest.mark.parametrize("name", METHODS)
def test_c2d_agrees_with_scipy(name):
    system = flexible()
    ours = c2d(system, DT, METHODS[name])
    expected = StateSpace(*signal.cont2discrete(matrices(system), DT, method=name)[:4], dt=DT)
    if name == "zoh":
        for mine, theirs in zip(matrices(ours), matrices(expected), strict=True):
            np.testing.assert_allclose(mine, theirs, atol=1e-14)
    # SciPy scales the states of the bilinear rule otherwise.
    omega = np.linspace(0.0, 100.0, 7)
    np.testing.assert_allclose(
        ours.frequency_response(omega), expected.frequency_response(omega), rtol=1e-10
    )


@pytest.mark.parametrize("name", METHODS)
@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), dt=st.floats(1e-4, 0.04))
def test_round_trip(name, seed, dt):
    # The fastest mode is below 10 Hz: 0.04 s keeps every pole below the Nyquist frequency.
    system = flexible(seed)
    back = d2c(c2d(system, dt, METHODS[name]), METHODS[name])
    assert back.dt == 0.0
    # The discrete matrices are known to rounding, that is A to eps/dt.
    scale = 1e-13 * (1.0 / dt + np.abs(system.A).max())
    for mine, theirs in zip(matrices(back), matrices(system), strict=True):
        np.testing.assert_allclose(mine, theirs, atol=scale)


def test_tustin_keeps_the_gramians():
    system = flexible()
    for mine, theirs in zip(gramians(c2d(system, DT, Tustin())), gramians(system), strict=True):
        np.testing.assert_allclose(mine, theirs, atol=1e-9)


def test_integrators_are_exact():
    double = StateSpace([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [[1.0, 0.0]])
    discrete = c2d(double, 0.5)
    np.testing.assert_allclose(discrete.A, [[1.0, 0.5], [0.0, 1.0]], rtol=1e-15)
    np.testing.assert_allclose(discrete.B, [[0.125], [0.5]], rtol=1e-15)
    for method in METHODS.values():
        np.testing.assert_allclose(d2c(c2d(double, 0.5, method), method).A, double.A, atol=1e-13)


@pytest.mark.parametrize("name", METHODS)
def test_batches_and_vmap(name):
    systems, method = batch(3), METHODS[name]
    discrete = c2d(systems, DT, method)
    mapped = jax.vmap(lambda system: c2d(system, DT, method))(systems)
    back = jax.jit(lambda system: d2c(system, method))(discrete)
    for k in range(3):
        one = c2d(jax.tree.map(lambda leaf, k=k: leaf[k], systems), DT, method)
        np.testing.assert_allclose(discrete.A[k], one.A, atol=1e-14)
        np.testing.assert_allclose(mapped.B[k], one.B, atol=1e-14)
    np.testing.assert_allclose(back.A, systems.A, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_gradients(name):
    system, method = flexible(modes=1), METHODS[name]
    rng = np.random.default_rng(0)
    weights = [jnp.asarray(rng.normal(size=m.shape)) for m in matrices(system)]

    def weighted(converted):
        return sum(jnp.sum(w * m) for w, m in zip(weights, jax.tree.leaves(converted), strict=True))

    # One round trip checks both ways; its value alone could hide errors that cancel.
    def value(system):
        discrete = c2d(system, 0.03, method)
        return weighted(discrete) + 0.01 * weighted(d2c(discrete, method))

    jax.test_util.check_grads(
        jax.jit(value), (system,), order=1, modes=("fwd", "rev"), rtol=1e-6, eps=1e-4
    )


def test_d2c_gradient_alone():
    discrete = c2d(flexible(modes=1), 0.03)

    def value(system):
        return jnp.sum(d2c(system).A ** 2) + jnp.sum(d2c(system).B ** 3)

    jax.test_util.check_grads(
        jax.jit(value), (discrete,), order=1, modes=("fwd", "rev"), rtol=1e-6, eps=1e-6
    )


def test_no_logarithm_is_refused_with_the_remedy():
    alternating = StateSpace([[-0.5]], [[1.0]], [[1.0]], dt=0.1)
    with pytest.raises(ValueError, match=r"Tustin\(\).*smaller sample time"):
        d2c(alternating)
    assert np.isnan(jax.jit(d2c)(alternating).A)
    assert d2c(alternating, Tustin()).A.item() == pytest.approx(-60.0)
    with pytest.raises(ValueError, match="z = -1"):
        d2c(StateSpace([[-1.0]], [[1.0]], [[1.0]], dt=0.1), Tustin())
    delay = StateSpace([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [[1.0, 0.0]], dt=0.1)
    with pytest.raises(ValueError, match="negative real axis"):
        d2c(delay)


def test_wrong_domains_are_refused():
    system = flexible()
    with pytest.raises(ValueError, match="in continuous time already"):
        d2c(system)
    with pytest.raises(ValueError, match="in discrete time already"):
        c2d(c2d(system, DT), DT)
    with pytest.raises(ValueError, match="positive"):
        c2d(system, 0.0)
