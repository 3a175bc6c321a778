"""Simulation against scipy.signal, sample-by-sample recursion and finite differences."""

import jax
import jax.numpy as jnp
import jax.test_util
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import signal

from lpvid.models import StateSpace, simulate, simulate_time_varying

from .systems import batch, flexible, matrices

DT = 0.02


@pytest.mark.parametrize(
    ("n_samples", "channels"),
    [(1, (2, 3)), (2, (1, 1)), (47, (2, 3)), (3001, (1, 1)), (3001, (2, 3))],
)
def test_agrees_with_dlsim(n_samples, channels):
    rng = np.random.default_rng(n_samples)
    system = flexible(nu=channels[0], ny=channels[1]).discretise(DT)
    u, x0 = rng.normal(size=(n_samples, channels[0])), rng.normal(size=6)
    _, y, x = signal.dlsim((*matrices(system), DT), u, x0=x0)
    ours = simulate(system, u=u, x0=x0)
    states = system.simulate_states(u=u, x0=x0)
    np.testing.assert_allclose(ours, y, atol=1e-12)
    np.testing.assert_allclose(states, x, atol=1e-12)
    np.testing.assert_allclose(system.simulate(u=u, x0=x0), y, atol=1e-12)


def test_continuous_time_is_held_as_in_lsim():
    rng = np.random.default_rng(0)
    system, u = flexible(), rng.normal(size=(200, 2))
    time = DT * np.arange(200)
    _, y, _ = signal.lsim(matrices(system), u, time, interp=False)
    np.testing.assert_allclose(system.simulate(u=u, dt=DT), y, atol=1e-11)


@settings(max_examples=20, deadline=None)
@given(radius=st.floats(0.0, 1.08), seed=st.integers(0, 100))
def test_stable_and_unstable_systems_follow_the_recursion(radius, seed):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(3, 3))
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    system = StateSpace(A, np.ones((3, 1)), np.ones((1, 3)), dt=1.0)
    u, x = rng.normal(size=(400, 1)), np.zeros(3)
    expected = np.empty((400, 1))
    for k in range(400):
        expected[k] = x.sum()
        x = A @ x + u[k]
    y = np.asarray(system.simulate(u=u))
    scale = np.maximum.accumulate(np.abs(expected))
    assert np.all(np.abs(y - expected) <= 1e-10 * (scale + 1.0))


def test_batches_of_models_inputs_and_states_broadcast():
    rng = np.random.default_rng(1)
    systems = batch(3, dt=DT)
    u, x0 = rng.normal(size=(4, 1, 50, 2)), rng.normal(size=(3, 6))
    y = systems.simulate(u=u, x0=x0)
    assert y.shape == (4, 3, 50, 2)
    states = systems.simulate_states(u=u, x0=x0)
    assert states.shape == (4, 3, 50, 6)
    from_states = np.asarray(states) @ np.asarray(systems.C.mT) + u @ np.asarray(systems.D.mT)
    np.testing.assert_allclose(from_states, y, atol=1e-12)
    one = jax.tree.map(lambda leaf: leaf[2], systems)
    np.testing.assert_allclose(y[1, 2], one.simulate(u=u[1, 0], x0=x0[2]), atol=1e-12)
    mapped = jax.vmap(lambda system, x0: system.simulate(u=u[1, 0], x0=x0))(systems, x0)
    np.testing.assert_allclose(mapped, y[1], atol=1e-12)


def test_a_single_input_may_be_flat():
    system = flexible(nu=1).discretise(DT)
    u = np.random.default_rng(2).normal(size=60)
    np.testing.assert_array_equal(system.simulate(u=u), system.simulate(u=u[:, None]))


@pytest.mark.slow
def test_gradients_forward_and_reverse():
    system = flexible(modes=1).discretise(DT)
    rng = np.random.default_rng(3)
    u, x0, weight = (jnp.asarray(rng.normal(size=s)) for s in ((50, 2), (2,), (50, 2)))

    @jax.jit
    def value(system, u, x0):
        return jnp.sum(weight * system.simulate(u=u, x0=x0))

    jax.test_util.check_grads(
        value, (system, u, x0), order=1, modes=("fwd", "rev"), rtol=1e-7, eps=1e-5
    )


def test_time_varying_agrees_with_the_recursion_and_with_constant_matrices():
    rng = np.random.default_rng(4)
    system = flexible().discretise(DT)
    u, x0 = rng.normal(size=(37, 2)), jnp.asarray(rng.normal(size=6))
    u = jnp.asarray(u)
    constant = [jnp.broadcast_to(m, (37, *m.shape)) for m in jax.tree.leaves(system)]
    y = simulate_time_varying(*constant, u=u, x0=x0)
    np.testing.assert_allclose(y, system.simulate(u=u, x0=x0), atol=1e-12)

    varying = [m * (1.0 + 0.1 * jnp.asarray(rng.normal(size=(37, 1, 1)))) for m in constant]
    expected, x = [], np.zeros(6)
    for A, B, C, D, sample in zip(*map(np.asarray, (*varying, u)), strict=True):
        expected.append(C @ x + D @ sample)
        x = A @ x + B @ sample
    np.testing.assert_allclose(simulate_time_varying(*varying, u=u), expected, atol=1e-12)


@pytest.mark.slow
def test_time_varying_gradients():
    rng = np.random.default_rng(5)
    shapes = ((9, 2, 2), (9, 2, 1), (9, 1, 2), (9, 1, 1), (9, 1), (2,))
    arguments = tuple(jnp.asarray(0.5 * rng.normal(size=shape)) for shape in shapes)

    @jax.jit
    def value(A, B, C, D, u, x0):
        return jnp.sum(simulate_time_varying(A, B, C, D, u=u, x0=x0) ** 2)

    jax.test_util.check_grads(value, arguments, order=1, modes=("fwd", "rev"), rtol=1e-6)


def test_faults_are_named():
    system = flexible()
    with pytest.raises(ValueError, match="give the sample time dt"):
        system.simulate(u=np.zeros((5, 2)))
    with pytest.raises(ValueError, match="u has shape"):
        system.simulate(u=np.zeros((5, 3)), dt=DT)
    with pytest.raises(ValueError, match="u has shape"):
        system.simulate(u=np.zeros(5), dt=DT)
    with pytest.raises(ValueError, match="x0 has shape"):
        system.simulate(u=np.zeros((5, 2)), x0=np.zeros(5), dt=DT)
    with pytest.raises(ValueError, match="the model's sample time"):
        system.discretise(DT).simulate(u=np.zeros((5, 2)), dt=0.1)
