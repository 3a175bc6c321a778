"""Delay, lags and the attached oscillator against SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.signal import lsim

from lpvid.effects import HISTORY, at, law

DT = 0.02
COUNT = 60
SIGNAL = np.random.default_rng(5).standard_normal(COUNT) + 3.0
TIME = DT * np.arange(COUNT)


def _lagged(name, port):
    one, tau = law(name), jnp.array([0.07])

    @jax.jit
    def run(signal):
        def step(memory, value):
            signals = at(**{port: value})
            added = one.regressors(signals, tau, memory)[0]
            return one.advance(signals, tau, memory, jnp.asarray(DT)), value + added

        return lax.scan(step, jnp.zeros(2), signal)[1]

    return np.asarray(run(SIGNAL))


def test_actuator_lag_of_a_held_input():
    got = _lagged("actuator-lag", "input")
    system = ([[-1 / 0.07]], [[1 / 0.07]], [[1.0]], [[0.0]])
    # lsim's interp=False holds the input over the sample.
    _, expected, _ = lsim(system, SIGNAL, TIME, X0=[SIGNAL[0]], interp=False)
    assert_allclose(got, expected, rtol=1e-10)


def test_sensor_lag_of_an_output_held_over_the_step():
    got = _lagged("sensor-lag", "output")
    system = ([[-1 / 0.07]], [[1 / 0.07]], [[1.0]], [[0.0]])
    _, expected, _ = lsim(system, SIGNAL, TIME, X0=[SIGNAL[0]], interp=False)
    assert_allclose(got, expected, rtol=1e-10)


def test_delay_is_the_mean_of_the_delayed_staircase():
    one = law("input-delay")
    history = SIGNAL[:HISTORY]
    signals = at(input=history[0], history=history, sample=DT)
    run = jax.jit(lambda d: one.regressors(signals, d, jnp.zeros(2))[0])
    inside = DT * (np.arange(1000) + 0.5) / 1000
    for samples in (0.0, 0.25, 1.0, 3.605, 12.0):
        # History's entry i was sent i samples ago and held for one.
        sent = np.ceil((samples * DT - inside) / DT - 1e-12).astype(int)
        expected = history[np.maximum(sent, 0)].mean()
        assert_allclose(history[0] + run(jnp.array([samples * DT])), expected, rtol=1e-9)
        quarters = [
            at(input=history[0], history=history, sample=DT, step_start=k * DT / 4, step=DT / 4)
            for k in range(4)
        ]
        shape = jnp.array([samples * DT])
        each = [float(one.regressors(part, shape, jnp.zeros(2))[0]) for part in quarters]
        for part, inside_it in zip(each, np.split(sent, 4), strict=True):
            own = history[np.maximum(inside_it, 0)].mean()
            assert_allclose(history[0] + part, own, rtol=1e-9)
    assert float(one.regressors(at(input=1.0), jnp.array([0.1]), jnp.zeros(2))[0]) == 0.0


OMEGA, ZETA = 25.0, 0.08


def test_oscillator_under_a_held_acceleration_is_exact():
    # r, ż, q̇ and q̈ under ṙ = ż − q̇, z̈ = −ω² r − 2ζω (ż − q̇), q̈ held.
    d = 2 * ZETA * OMEGA
    matrix = [[0, 1, -1, 0], [-(OMEGA**2), -d, d, 0], [0, 0, 0, 1], [0, 0, 0, 0]]
    start = np.array([0.3, -0.8, 1.7, 4.0])
    expected = expm(DT * np.array(matrix)) @ start
    signals = at(velocity=start[2] + 0.5 * DT * start[3], acceleration=start[3], step=DT)
    shape, memory = jnp.array([OMEGA, ZETA]), jnp.asarray(start[:2])
    got = law("missing-mode").advance(signals, shape, memory, jnp.asarray(DT))
    assert_allclose(got, expected[:2], rtol=1e-11)


def test_oscillator_on_a_moving_coordinate_converges_with_the_square_of_the_step():
    one, shape, end = law("missing-mode"), jnp.array([OMEGA, ZETA]), 1.2

    def velocity(t):
        return np.sin(7.0 * t)

    def rates(t, state):
        rate = state[1] - velocity(t)
        return [rate, -(OMEGA**2) * state[0] - 2 * ZETA * OMEGA * rate]

    truth = solve_ivp(rates, (0.0, end), [0.0, 0.0], rtol=1e-10, atol=1e-12).y[:, -1]

    @jax.jit
    def run(velocities, accelerations, dt):
        def step(memory, now):
            signals = at(velocity=now[0], acceleration=now[1], step=dt)
            return one.advance(signals, shape, memory, dt), None

        return lax.scan(step, jnp.zeros(2), (velocities, accelerations))[0]

    errors = []
    for count in (120, 240):
        time = end / count * (np.arange(count) + 0.5)
        got = run(velocity(time), 7.0 * np.cos(7.0 * time), jnp.asarray(end / count))
        errors.append(np.abs(np.asarray(got) - truth)[1])
    assert 3.5 < errors[0] / errors[1] < 4.5
