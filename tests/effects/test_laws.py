"""Every law against its formula in NumPy, its derivatives against differences, its finiteness."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from lpvid.effects import HISTORY, LIBRARY, MEMORY, Signals, at, law

NAMES = [one.name for one in LIBRARY]
SCALARS = (
    "position",
    "velocity",
    "acceleration",
    "load",
    "input",
    "output",
    "time",
    "sample",
    "step_start",
    "step",
)


def unpack(vector):
    """Signals, shape, memory and step from one vector."""
    scalars, rest = vector[: len(SCALARS)], vector[len(SCALARS) :]
    history, rest = rest[:HISTORY], rest[HISTORY:]
    shape, memory, dt = rest[:2], rest[2 : 2 + MEMORY], rest[-1]
    named = {name: scalars[i] for i, name in enumerate(SCALARS)}
    return Signals(**named, history=history), shape, memory, dt


SIZE = len(SCALARS) + HISTORY + 2 + MEMORY + 1


@jax.jit
def everything(vector):
    """Regressors, then the next memory, of every law one after another."""
    signals, shape, memory, dt = unpack(vector)
    parts = []
    for one in LIBRARY:
        parts += [one.regressors(signals, shape, memory), one.advance(signals, shape, memory, dt)]
    return jnp.concatenate(parts)


forward = jax.jit(lambda vector, way: jax.jvp(everything, (vector,), (way,))[1])
backward = jax.jit(jax.grad(lambda vector: jnp.sum(everything(vector))))


def of(name, vector):
    """Regressors of one law, out of everything."""
    place = 0
    for one in LIBRARY:
        count = len(one.amplitudes)
        if one.name == name:
            return np.asarray(everything(vector))[place : place + count]
        place += count + MEMORY
    raise KeyError(name)


def clipped(x, limit):
    return float(np.clip(x, -limit, limit))


# Sharp laws where the smooth one is within the given bound of it: 1e-12 for |x|, half of the
# rounding 0.02 for the corner of a clip.
FORMULAS = {
    "coulomb": (lambda s, p, m: [-np.tanh(s["velocity"] / p[0])], 1e-12),
    "stribeck": (
        lambda s, p, m: [
            -np.tanh(s["velocity"] / p[0]) * np.exp(-(s["velocity"] ** 2) / p[1] ** 2)
        ],
        1e-12,
    ),
    "asymmetric-viscous": (lambda s, p, m: [-abs(s["velocity"])], 2e-12),
    "asymmetric-coulomb": (lambda s, p, m: [-(np.tanh(s["velocity"] / p[0]) ** 2)], 1e-12),
    "load-dependent": (
        lambda s, p, m: [-abs(s["load"]) * np.tanh(s["velocity"] / p[0])],
        2e-12,
    ),
    "dahl": (lambda s, p, m: [-m[0]], 0.0),
    "bouc-wen": (lambda s, p, m: [-m[0]], 0.0),
    "quadratic-drag": (lambda s, p, m: [-s["velocity"] * abs(s["velocity"])], 1e-11),
    "play": (
        lambda s, p, m: [np.clip(m[0], s["position"] - p[0], s["position"] + p[0]) - s["position"]],
        1e-12,
    ),
    "cubic-stiffness": (lambda s, p, m: [-(s["position"] ** 3)], 1e-12),
    "quadratic-stiffness": (lambda s, p, m: [-(s["position"] ** 2)], 1e-12),
    "odd-quadratic-stiffness": (lambda s, p, m: [-s["position"] * abs(s["position"])], 1e-11),
    "backlash": (lambda s, p, m: [clipped(s["position"], p[0])], 0.01),
    "saturation": (lambda s, p, m: [clipped(s["input"], p[0]) - s["input"]], 0.01),
    "gain-cubic": (lambda s, p, m: [s["input"] ** 3], 1e-12),
    "gain-asymmetry": (lambda s, p, m: [abs(s["input"])], 2e-12),
    "gain-square": (lambda s, p, m: [s["input"] * abs(s["input"])], 1e-11),
    "missing-mode": (
        lambda s, p, m: [p[0] ** 2 * m[0] + 2 * p[1] * p[0] * (m[1] - s["velocity"])],
        1e-12,
    ),
    "gravity": (lambda s, p, m: [-np.sin(s["position"]), -np.cos(s["position"])], 1e-12),
    "torque-ripple": (
        lambda s, p, m: [np.sin(p[0] * s["position"]), np.cos(p[0] * s["position"])],
        1e-12,
    ),
    "periodic-disturbance": (
        lambda s, p, m: [np.sin(p[0] * s["time"]), np.cos(p[0] * s["time"])],
        1e-12,
    ),
    "torque-bias": (lambda s, p, m: [1.0], 0.0),
    "sensor-bias": (lambda s, p, m: [1.0], 0.0),
    "sensor-drift": (lambda s, p, m: [s["time"]], 0.0),
    "absolute-value-sensor": (lambda s, p, m: [abs(s["output"]) - s["output"]], 2e-12),
    "cubic-sensor": (lambda s, p, m: [s["output"] ** 3], 1e-12),
    "scheduling": (lambda s, p, m: [s["input"]], 0.0),
    "parameter-drift": (lambda s, p, m: [s["input"]], 0.0),
    "centrifugal": (lambda s, p, m: [-(s["velocity"] ** 2) * np.sin(s["position"])], 1e-12),
}
# Against other routes: Lagrange's equation here, fine integration in test_hysterons and
# test_lags_and_modes.
ELSEWHERE = {"position-dependent-inertia", "input-delay", "actuator-lag", "sensor-lag"}


def test_every_law_has_its_formula():
    assert set(FORMULAS) | ELSEWHERE == set(NAMES)
    assert not set(FORMULAS) & ELSEWHERE


@pytest.mark.parametrize("name", FORMULAS)
def test_formula(name):
    formula, tolerance = FORMULAS[name]
    rng = np.random.default_rng(1)
    # A single shape p[0] is at most one, so that a corner's bound is absolute.
    for vector in rng.uniform(-2.0, 2.0, (20, SIZE)):
        vector[-5:-3] = rng.uniform(0.3, 1.0, 2)
        shape, memory = vector[-5:-3], vector[-3:-1]
        signals = dict(zip(SCALARS, vector, strict=False))
        expected = formula(signals, shape, memory)
        assert_allclose(of(name, vector), expected, rtol=1e-12, atol=tolerance)


def test_friction_takes_energy_out():
    rng = np.random.default_rng(2)
    for vector in rng.uniform(-2.0, 2.0, (20, SIZE)):
        vector[-5:-3] = rng.uniform(0.3, 1.0, 2)
        for name in ("coulomb", "stribeck", "load-dependent", "quadratic-drag"):
            assert of(name, vector)[0] * vector[1] <= 0.0


def test_inertia_of_the_position_is_lagranges():
    def kinetic(m, q, v):
        return 0.5 * (m[0] * jnp.cos(q) + m[1] * jnp.sin(q)) * v**2

    @jax.jit
    def force(m, q, v, a):
        momentum = jax.grad(kinetic, argnums=2)
        _, rate = jax.jvp(lambda q, v: momentum(m, q, v), (q, v), (v, a))
        return rate - jax.grad(kinetic, argnums=1)(m, q, v)

    q, v, a = (jnp.asarray(x) for x in (0.7, -1.3, 2.1))
    signals = at(position=q, velocity=v, acceleration=a)
    got = law("position-dependent-inertia").regressors(signals, jnp.zeros(0), jnp.zeros(2))
    for i, m in enumerate(jnp.eye(2)):
        assert_allclose(got[i], -force(m, q, v, a), rtol=1e-12)


def test_derivatives_against_differences():
    rng = np.random.default_rng(3)
    # Off the kinks: a delay of a broken number of samples, a play that does not change sides.
    vector = rng.uniform(0.3, 2.0, SIZE)
    vector[-5:-3] = 0.41, 0.6
    vector[-3:] = 0.25, 0.15, 0.1
    exact = np.stack([forward(vector, way) for way in np.eye(SIZE)], axis=1)
    step = 1e-6
    for i in range(SIZE):
        ahead, behind = vector.copy(), vector.copy()
        ahead[i] += step
        behind[i] -= step
        difference = (np.asarray(everything(ahead)) - np.asarray(everything(behind))) / (2 * step)
        assert_allclose(exact[:, i], difference, rtol=1e-6, atol=1e-7)
    assert_allclose(np.asarray(backward(vector)), exact.sum(axis=0), rtol=1e-9, atol=1e-12)


@st.composite
def _vectors(draw):
    size = st.floats(-1e8, 1e8, allow_subnormal=False)
    small = st.sampled_from([0.0, -0.0, 1e-9, -1e-9, 1e-30, 1.0, -1.0, 1e8, -1e8])
    signals = draw(st.lists(small | size, min_size=SIZE - 5, max_size=SIZE - 5))
    shape = draw(
        st.lists(st.sampled_from([0.0, 1e-12, 0.01, 0.5, 1.0, 1e4]), min_size=2, max_size=2)
    )
    memory = draw(st.lists(small, min_size=2, max_size=2))
    dt = draw(st.sampled_from([1e-5, 1e-3, 0.1]))
    return np.array([*signals, *shape, *memory, dt])


@settings(max_examples=60, deadline=None)
@given(_vectors())
def test_nothing_is_ever_undefined(vector):
    """Zeros, large signals, and shapes and memories that belong to another law."""
    assert np.all(np.isfinite(everything(vector)))
    # A derivative that is not a number makes every sum with it none.
    assert np.all(np.isfinite(forward(vector, np.ones(SIZE))))
    assert np.all(np.isfinite(backward(vector)))
