"""The model class: validation, poles and arithmetic against python-control."""

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpvid.models import StateSpace, to_control

from .systems import batch, flexible, matrices

OMEGA = np.array([0.0, 3.0, 20.0, 55.0])


def test_shapes_and_repr():
    system = StateSpace(np.eye(2), [[1], [2]], [[1, 0]])
    assert (system.nx, system.nu, system.ny) == (2, 1, 1)
    assert system.B.dtype == float
    np.testing.assert_array_equal(system.D, [[0.0]])
    assert repr(system) == "StateSpace(nx=2, nu=1, ny=1, continuous)"
    assert repr(batch(3, dt=0.02)) == "StateSpace(nx=6, nu=2, ny=2, dt=0.02 s, batch=(3,))"
    assert "StateSpace(continuous" in repr(jax.tree.map(lambda leaf: 0, system))


def test_matrices_without_batch_axes_join_a_batch():
    systems = StateSpace(np.zeros((4, 2, 2)), np.ones((2, 1)), np.ones((1, 2)))
    assert systems.batch_shape == (4,)
    assert systems.B.shape == (4, 2, 1) and systems.D.shape == (4, 1, 1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.zeros((2, 3)), np.ones((2, 1)), np.ones((1, 3))), "A has shape"),
        ((np.eye(2), np.ones((1, 2)), np.ones((1, 2))), "B has shape"),
        ((np.eye(2), np.ones((2, 1)), np.ones((2, 1))), "C has shape"),
        ((np.eye(2), np.ones((2, 1)), np.ones((1, 2)), np.ones((2, 1))), "D has shape"),
        ((np.eye(2), np.ones(2), np.ones((1, 2))), "B has shape.*explicitly"),
        ((1j * np.eye(2), np.ones((2, 1)), np.ones((1, 2))), "A is complex"),
        ((np.ones((2, 2, 2)), np.ones((3, 2, 1)), np.ones((1, 2))), "batch axes"),
        ((np.eye(2), np.ones((2, 1)), np.ones((1, 2)), None, -0.1), "dt is -0.1"),
        ((np.eye(2), np.ones((2, 1)), np.ones((1, 2)), None, np.nan), "dt is nan"),
    ],
)
def test_faults_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        StateSpace(*arguments)


@pytest.mark.parametrize("dt", [0.0, 0.02])
def test_modes_agree_with_control(dt):
    system = flexible()
    system = system.discretise(dt) if dt else system
    frequency, damping, poles = control.damp(to_control(system), doprint=False)
    order = np.argsort(frequency)
    modes = system.modes()
    np.testing.assert_allclose(modes.frequency, frequency[order], rtol=1e-10)
    np.testing.assert_allclose(modes.damping, damping[order], rtol=1e-8)
    np.testing.assert_allclose(np.sort_complex(system.poles()), np.sort_complex(poles), rtol=1e-9)
    assert system.is_stable()


def test_modes_of_an_integrator_are_finite():
    modes = StateSpace([[0.0]], [[1.0]], [[1.0]]).modes()
    assert modes.frequency.item() == 0.0 and modes.damping.item() == 1.0


def test_stability():
    assert not StateSpace([[0.0]], [[1.0]], [[1.0]]).is_stable()
    assert not StateSpace([[1.0]], [[1.0]], [[1.0]], dt=1.0).is_stable()
    stable = StateSpace([[[-0.5]], [[-1.5]]], [[1.0]], [[1.0]], dt=1.0).is_stable()
    np.testing.assert_array_equal(stable, [True, False])


@pytest.mark.parametrize("dt", [0.0, 0.02])
def test_arithmetic_agrees_with_control(dt):
    first, second = flexible(0), flexible(1, modes=2)
    if dt:
        first, second = first.discretise(dt), second.discretise(dt)
    theirs = to_control(first), to_control(second)
    points = np.exp(1j * OMEGA * dt) if dt else 1j * OMEGA
    for ours, expected in (
        (first + second, theirs[0] + theirs[1]),
        (first - second, theirs[0] - theirs[1]),
        (first @ second, theirs[0] * theirs[1]),
        (-first, -theirs[0]),
    ):
        response = np.stack([expected(point) for point in points])
        np.testing.assert_allclose(ours.frequency_response(OMEGA), response, rtol=1e-8)
        assert ours.dt == first.dt


def test_arithmetic_broadcasts_over_batches():
    systems, one = batch(3), flexible(7)
    expected = systems.frequency_response(OMEGA) - one.frequency_response(OMEGA)[None]
    np.testing.assert_allclose((systems - one).frequency_response(OMEGA), expected, atol=1e-10)
    product = systems.frequency_response(OMEGA) @ one.frequency_response(OMEGA)[None]
    np.testing.assert_allclose((systems @ one).frequency_response(OMEGA), product, atol=1e-10)


def test_arithmetic_faults():
    system = flexible()
    with pytest.raises(ValueError, match="Cannot add models with dt"):
        system + system.discretise(0.1)
    with pytest.raises(ValueError, match="channels"):
        system + flexible(nu=1)
    with pytest.raises(ValueError, match="Cannot connect"):
        system @ flexible(ny=3)
    with pytest.raises(TypeError):
        system + 1.0  # pyright: ignore


@pytest.mark.parametrize("dt", [0.0, 0.02])
def test_dc_gain_is_the_response_at_zero(dt):
    systems = batch(3, dt=dt)
    response = systems.frequency_response(0.0)[:, 0]
    np.testing.assert_allclose(systems.dc_gain(), response.real, rtol=1e-9)


def test_transform_changes_states_only():
    rng = np.random.default_rng(0)
    systems, T = batch(3), rng.normal(size=(6, 6))
    changed = systems.transform(T)
    np.testing.assert_allclose(changed.B, T @ np.asarray(systems.B))
    np.testing.assert_allclose(T @ np.asarray(systems.A), changed.A @ T, atol=1e-9)
    response = systems.frequency_response(OMEGA)
    np.testing.assert_allclose(changed.frequency_response(OMEGA), response, rtol=1e-8)
    with pytest.raises(ValueError, match="T has shape"):
        systems.transform(np.eye(5))


def test_it_is_a_pytree_with_static_sample_time():
    system = flexible().discretise(0.02)
    doubled = jax.jit(lambda s: jax.tree.map(lambda leaf: 2.0 * leaf, s))(system)
    assert doubled.dt == 0.02
    np.testing.assert_array_equal(doubled.C, 2.0 * system.C)
    assert len(jax.tree.leaves(system)) == 4
    gradient = jax.grad(lambda s: jnp.sum(s.dc_gain()))(system)
    assert isinstance(gradient, StateSpace)
    np.testing.assert_allclose(gradient.D, np.ones((2, 2)))
    assert matrices(gradient)[0].shape == (6, 6)
