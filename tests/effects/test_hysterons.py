"""Elements with hysteresis against a fine integration of their differential equations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

from lpvid.effects import at, law

DT = 0.05
LENGTH = 0.2


@jax.jit
def _bouc_wen(velocities, shape):
    def step(memory, velocity):
        memory = law("bouc-wen").advance(at(velocity=velocity), shape, memory, jnp.asarray(DT))
        return memory, memory[0]

    return lax.scan(step, jnp.zeros(2), velocities)[1]


@jax.jit
def _dahl(velocities, length):
    def step(memory, velocity):
        memory = law("dahl").advance(at(velocity=velocity), length, memory, jnp.asarray(DT))
        return memory, memory[0]

    return lax.scan(step, jnp.zeros(2), velocities)[1]


def integrated(velocities, ratio):
    """Wen's equation for velocities held over the steps, by SciPy."""
    z, out = 0.0, []
    for v in velocities:
        solution = solve_ivp(
            lambda t, z, v=v: (
                (v - np.abs(z) * (ratio * abs(v) * np.sign(z) + (1 - ratio) * v)) / LENGTH
            ),
            (0.0, DT),
            [z],
            rtol=1e-9,
            atol=1e-11,
            max_step=DT / 20,
        )
        z = solution.y[0, -1]
        out.append(z)
    return np.array(out)


VELOCITIES = 6.0 * np.random.default_rng(4).standard_normal(40)


@pytest.mark.parametrize("ratio", [0.5, 0.7, 1.0])
def test_bouc_wen_is_its_differential_equation(ratio):
    got = _bouc_wen(VELOCITIES, jnp.array([LENGTH, ratio]))
    assert_allclose(got, integrated(VELOCITIES, ratio), atol=1e-6)


def test_dahl_is_its_differential_equation():
    got = _dahl(VELOCITIES, jnp.array([LENGTH]))
    # Dahl's is Wen's equation at a ratio of 1.
    assert_allclose(got, integrated(VELOCITIES, 1.0), atol=1e-6)
    assert_allclose(got, _bouc_wen(VELOCITIES, jnp.array([LENGTH, 1.0])), atol=1e-8)


def test_the_step_is_never_stiff():
    velocities = np.where(np.arange(40) % 3 == 0, -1e6, 1e6)
    assert_allclose(_dahl(velocities, jnp.array([1e-6])), np.sign(velocities), atol=1e-12)
    got = _bouc_wen(velocities, jnp.array([1e-6, 0.6]))
    assert_allclose(got, np.sign(velocities), atol=1e-12)


def test_steps_add_up():
    halves = np.repeat(VELOCITIES, 2)
    shape = jnp.array([LENGTH, 0.65])
    once = _bouc_wen(VELOCITIES, shape)
    twice = _bouc_wen(0.5 * halves, shape)[1::2]
    assert_allclose(twice, once, atol=1e-12)


def test_play_follows_its_slot_and_loses_the_same_at_any_speed():
    radius, stroke = 0.3, 1.0

    @jax.jit
    def force(positions):
        def step(memory, q):
            signals, shape = at(position=q), jnp.array([radius])
            value = law("play").regressors(signals, shape, memory)[0]
            return law("play").advance(signals, shape, memory, jnp.asarray(DT)), value

        return lax.scan(step, jnp.zeros(2), positions)[1]

    for count in (400, 4000):
        phase = np.linspace(0.0, 6.0 * np.pi, 3 * count + 1)
        positions = stroke * np.sin(phase)
        got = np.asarray(force(positions))
        p, expected = 0.0, []
        for q in positions:
            p = q - radius if q - radius > p else q + radius if q + radius < p else p
            expected.append(p - q)
        assert_allclose(got, expected, atol=1e-14)
        last = slice(2 * count, 3 * count + 1)
        # The loop is a parallelogram of height 2r and width 2(A − r).
        loss = -np.trapezoid(got[last], positions[last])
        assert_allclose(loss, 4.0 * radius * (stroke - radius), rtol=1e-3)
