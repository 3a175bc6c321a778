"""Innovation fits of nonlinear mechanics: pendulums in closed loop, the library's own arms."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from jaxtyping import Array, Float
from scipy.linalg import solve_discrete_are

from lpvid._results import Status
from lpvid.analysis import horizon_errors, predict
from lpvid.data import IOData
from lpvid.mechanics import (
    reference_single_link_arm,
    reference_two_link_arm,
    simulate_single_link,
)
from lpvid.models import NonlinearModel, steps_of
from lpvid.refinement import Innovation, OutputError, refine
from lpvid.refinement._parameterisation import Record
from lpvid.refinement._recognise import recognise

DT = 0.05
# Upright: θ̈ = toppling sin θ − damping θ̇ + gain u.
TRUTH = {"damping": 0.5, "gain": 4.0, "toppling": 9.0}
GAIN = np.array([[0.9], [3.0]])
NOISE = 0.05


def motion(plant, x, u):
    acceleration = plant["toppling"] * jnp.sin(x[0]) - plant["damping"] * x[1]
    return jnp.stack([x[1], acceleration + plant["gain"] * u[0]])


def angle(plant, x, u):
    del plant, u
    return x[:1]


def upright(damping, gain, toppling):
    plant = {"damping": damping, "gain": gain, "toppling": toppling}
    return NonlinearModel(plant, motion, angle, rest=[0.0, 0.0])


def balanced(n, seed):
    """A record with process noise through K, balanced by a proportional-derivative controller."""
    rng = np.random.default_rng(seed)
    asked, e = np.repeat(rng.standard_normal(-(-n // 10)), 10)[:n], NOISE * rng.standard_normal(n)
    model = upright(**TRUTH)
    step = jax.jit(lambda x, u: model.step(x, u, dt=DT)[0])
    x, y, u = np.zeros(2), np.zeros(n), np.zeros(n)
    for t in range(n):
        y[t] = x[0] + e[t]
        u[t] = asked[t] - 6.0 * y[t] - (y[t] - y[max(t - 1, 0)]) / DT
        x = np.asarray(step(x, u[t : t + 1])) + GAIN[:, 0] * e[t]
    return IOData(u=u, y=y, dt=DT)


DATA = balanced(40, 5)


def test_the_prediction_is_that_of_the_recursion_and_so_are_its_slopes():
    model = upright(**TRUTH)
    kind, values = recognise(model, DATA, Innovation(GAIN))
    assert kind.names[:3] == ("plant['damping']", "plant['gain']", "plant['toppling']")
    each, x0 = Record(DATA.u, DATA.y, None, jnp.asarray(0)), jnp.array([0.1, 0.0])

    def respond(v):
        y = kind.respond(v[:5], each, v[5:])
        return y, y

    point = jnp.concatenate([values, x0])
    slopes, y = jax.jit(jax.jacfwd(respond, has_aux=True))(point)
    step = jax.jit(lambda x, u: model.step(x, u, dt=DT)[0])
    states = [np.asarray(x0)]
    for u, measured in zip(np.asarray(DATA.u), np.asarray(DATA.y), strict=True):
        x = states[-1]
        states.append(np.asarray(step(x, u)) + GAIN @ (measured - x[:1]))
    states = np.array(states[:-1])
    np.testing.assert_allclose(y, states[:, :1], atol=1e-12)
    h = 1e-6
    moved = jax.jit(jax.vmap(lambda v: respond(v)[0]))
    steps = h * jnp.eye(7)
    difference = (moved(point[None] + steps) - moved(point[None] - steps)) / (2 * h)
    np.testing.assert_allclose(np.moveaxis(difference, 0, -1), slopes, atol=1e-7)
    # Three steps ahead from every state of the recursion.
    along = {"u": DATA.u, "dt": DT, "x0": x0}
    ahead = predict(model, y=DATA.y, gain=GAIN, horizon=3, **along)
    x, u = states[:-2], np.asarray(DATA.u)
    for later in range(2):
        x = np.asarray(jax.vmap(step)(x, u[later : later + len(x)]))
    np.testing.assert_allclose(ahead[2:], x[:, :1], atol=1e-12)
    np.testing.assert_allclose(ahead[:2], model.simulate(**along)[:2], atol=1e-12)


class Tank(eqx.Module):
    """ẋ = u − outflow √(1 + x) by Euler's rule: nothing but a step."""

    outflow: Float[Array, ""]
    n_states: int = eqx.field(static=True, default=1)

    def step(self, x, u, *, dt):
        return x + dt * (u - self.outflow * jnp.sqrt(1.0 + x)), x


class Forgetful(eqx.Module):
    """Returns one state of two."""

    outflow: Float[Array, ""]
    n_states: int = eqx.field(static=True, default=2)

    def step(self, x, u, *, dt):
        return x[:1] + dt * self.outflow * u, x[:1]


class Scheduled(eqx.Module):
    """Needs κ; returns what `returned` says of its state and its output."""

    outflow: Float[Array, ""]
    returned: Callable = eqx.field(static=True, default=lambda x, y: (x, y))
    n_states: int = eqx.field(static=True, default=1)

    def step(self, x, u, *, dt, kappa):
        return self.returned(x + dt * kappa * (u - self.outflow * x), x)


class Simulated(eqx.Module):
    """Nothing but a simulation."""

    outflow: Float[Array, ""]
    n_states: int = eqx.field(static=True, default=1)

    def simulate(self, *, u, dt, x0):
        return jax.lax.scan(lambda x, u: (x + dt * (u - self.outflow * x), x), x0, u)[1]


class Sensor(eqx.Module):
    """A gain that the output's function holds."""

    gain: Float[Array, ""]

    def __call__(self, plant, x, u):
        return self.gain * x[:1]


def test_what_is_estimated_is_in_the_plant():
    sensor = Sensor(jnp.asarray(2.0))
    held = NonlinearModel(TRUTH, motion, sensor, rest=[0.0, 0.0])
    kind, values = recognise(held, DATA, OutputError())
    assert kind.names == ("plant['damping']", "plant['gain']", "plant['toppling']")
    assert kind.build(values + 1.0).output.gain == 2.0
    plant = {"arm": TRUTH, "sensor": sensor}
    declared = NonlinearModel(
        plant,
        lambda p, x, u: motion(p["arm"], x, u),
        lambda p, x, u: p["sensor"](p, x, u),
        rest=[0.0, 0.0],
    )
    assert "plant['sensor'].gain" in recognise(declared, DATA, OutputError())[0].names


def test_what_a_module_needs():
    one = jnp.asarray(1.0)
    with pytest.raises(ValueError, match="offers simulate alone"):
        refine(Simulated(one), DATA, predictor=Innovation())
    with pytest.raises(ValueError, match="n_states does not say"):
        refine(Tank(one, 0), DATA, predictor=Innovation())
    with pytest.raises(ValueError, match="leads from 2 states"):
        refine(Forgetful(one), DATA, predictor=Innovation())
    with pytest.raises(ValueError, match=r"output of shape \(2,\); this data needs \(1,\)"):
        refine(Tank(one, 2), DATA, predictor=Innovation())
    scheduled = IOData(u=DATA.u, y=DATA.y, kappa=np.ones(40), dt=DT)
    with pytest.raises(ValueError, match="n_states does not say"):
        refine(Tank(one, 0), DATA)
    with pytest.raises(ValueError, match="Scheduled needs the scheduling"):
        refine(Scheduled(one), DATA)
    with pytest.raises(ValueError, match="kappa: the model depends on a schedule"):
        predict(Scheduled(one), u=DATA.u, y=DATA.y, gain=[[1.0]], dt=DT)
    with pytest.raises(ValueError, match="returns 3 values; a tuple of two is needed"):
        refine(Scheduled(one, lambda x, y: (x, y, y)), scheduled)
    with pytest.raises(ValueError, match="returns a ShapeDtypeStruct; a tuple of two"):
        refine(Scheduled(one, lambda x, y: x), scheduled, predictor=Innovation())
    with pytest.raises(ValueError, match=r"output: it returns an array of shape \(\)"):
        refine(NonlinearModel(TRUTH, motion, lambda p, x, u: x[0], rest=[0.0, 0.0]), DATA)
    with pytest.raises(ValueError, match=r"dynamics: it returns an array of shape \(1,\)"):
        refine(NonlinearModel(TRUTH, angle, angle, rest=[0.0, 0.0]), DATA)
    with pytest.raises(ValueError, match="NonlinearModel"):
        refine(reference_two_link_arm(), DATA, predictor=Innovation())
    with pytest.raises(ValueError, match="step"):
        predict(Simulated(one), u=DATA.u, y=DATA.y, gain=[[1.0]], dt=DT)
    with pytest.raises(ValueError, match="has no step"):
        steps_of(Simulated(one), u=DATA.u, dt=DT)
    with pytest.raises(ValueError, match="substeps"):
        NonlinearModel({}, motion, angle, rest=[0.0], substeps=0)
    with pytest.raises(ValueError, match="rest"):
        NonlinearModel({}, motion, angle, rest=[])
    u, model = np.full((8, 1), 2.0), Tank(one)
    levels = [0.0]
    for _ in range(7):
        levels.append(levels[-1] + DT * (2.0 - np.sqrt(1.0 + levels[-1])))
    np.testing.assert_allclose(predict(model, u=u, dt=DT)[:, 0], levels, atol=1e-14)
    # So is what output error compares with the record.
    data = IOData(u=u, y=u, dt=DT)
    kind, values = recognise(model, data, OutputError())
    each = Record(data.u, data.y, None, jnp.asarray(0))
    np.testing.assert_allclose(kind.respond(values, each, jnp.zeros(1))[:, 0], levels, atol=1e-14)


@pytest.mark.slow
def test_a_pendulum_balanced_upright():
    data = balanced(600, 6)
    start = upright(0.8, 3.0, 6.0)
    fit = refine(start, data, predictor=Innovation([[1.0], [4.0]]))
    assert fit.status == Status.successful
    truth = np.concatenate([list(TRUTH.values()), GAIN[:, 0]])
    assert np.max(np.abs(fit.parameters - truth) / fit.standard_errors) < 4.0
    np.testing.assert_allclose(fit.noise_covariance.item(), NOISE**2, rtol=0.2)
    r = np.asarray(fit.residual)[:, 0]
    share = np.array([np.sum(r[k:] * r[:-k]) for k in range(1, 11)]) / np.sum(r**2)
    assert np.max(np.abs(share)) < 4.0 / np.sqrt(len(r))
    along = {"u": data.u, "y": data.y, "gain": fit.innovation_gain, "dt": DT, "x0": fit.x0}
    np.testing.assert_allclose(data.y - predict(fit.model, **along), fit.residual, atol=1e-10)
    errors = horizon_errors(fit.model, horizons=[1, 2, 4, 8], **along)
    assert np.all(np.diff(errors.rmse[:, 0]) > 0.0)


@pytest.mark.slow
def test_the_single_link_arm_is_what_it_simulates():
    arm, dt = reference_single_link_arm(payload_mass=0.2, modes=1), 1 / 300
    u = np.random.default_rng(8).standard_normal((60, 1))
    model = NonlinearModel(
        arm,
        lambda arm, x, u: arm.dynamics(x, arm.current_gain * u[0]),
        lambda arm, x, u: arm.sensors(x),
        rest=np.zeros(4),
        substeps=8,
    )
    y = simulate_single_link(arm, reference=u, dt=dt).y
    np.testing.assert_allclose(model.simulate(u=u, dt=dt), y, atol=1e-10)
    # Predicted with the gain at zero it is the same, whatever was measured.
    kind, values = recognise(model, IOData(u=u, y=0.0 * y, dt=dt), Innovation())
    each, x0 = Record(jnp.asarray(u), 0.0 * y, None, jnp.asarray(0)), jnp.zeros(4)
    found = jax.jit(lambda v: kind.respond(v, each, x0))(values)
    np.testing.assert_allclose(found, y, atol=1e-10)


@pytest.mark.slow
def test_the_two_link_arm_in_closed_loop():
    """The likelihood's slope at the truth is as small as its information says it has to be."""

    def whole(x):
        # Nothing depends on the first joint's angle.
        return jnp.concatenate([jnp.zeros(1), x])

    def output(arm, x, u):
        del u
        x = whole(x)
        return arm.joint_velocities(x[:4], x[4:])

    def plant(arm):
        rest = [1.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
        return NonlinearModel(arm, lambda a, x, u: a.dynamics(whole(x), u)[1:], output, rest=rest)

    arm, n, dt = reference_two_link_arm(), 200, 2e-3
    model = plant(arm)
    step = jax.jit(lambda x, u: model.step(x, u, dt=dt))
    # The Kalman gain of the arm at rest, for noise on the velocities as large as the sensors'. The
    # second joint's angle moves nothing there and is not corrected.
    A, C = (np.asarray(J)[:, 1:] for J in jax.jacfwd(step)(jnp.zeros(7), jnp.zeros(2)))
    P = solve_discrete_are(A[1:].T, C.T, np.diag([0.0, 0.0, 1.0, 1.0, 1.0, 1.0]), np.eye(2))
    gain = np.zeros((7, 2))
    gain[1:] = A[1:] @ P @ C.T @ np.linalg.inv(C @ P @ C.T + np.eye(2))
    rng = np.random.default_rng(9)
    asked = 1.5 * np.repeat(rng.standard_normal((n // 20, 2)), 20, axis=0)
    e = 0.01 * rng.standard_normal((n, 2))
    x, turned, y, u = np.zeros(7), np.zeros(2), np.zeros((n, 2)), np.zeros((n, 2))
    for t in range(n):
        y[t] = np.asarray(step(x, u[t])[1]) + e[t]
        turned += dt * y[t]
        u[t] = asked[t] - 4.0 * turned
        x = np.asarray(step(x, u[t])[0]) + gain @ e[t]
    data = IOData(u=u, y=y, dt=dt)
    kind, values = recognise(model, data, Innovation(gain))
    wanted = ("bending", "payload", "K[3,0]", "K[4,1]")
    free = np.array([i for i, name in enumerate(kind.names) if any(w in name for w in wanted)])
    assert len(free) == 5
    each, x0 = Record(data.u, data.y, None, jnp.asarray(0)), jnp.zeros(7)

    def residual(chosen):
        e = data.y - kind.respond(values.at[free].set(chosen), each, x0)
        return e, e

    slopes, left = jax.jit(jax.jacfwd(residual, has_aux=True))(values[free])
    np.testing.assert_allclose(left, e, atol=1e-9)
    slopes = np.asarray(slopes).reshape(-1, 5) / 0.01
    information = slopes.T @ slopes
    score = slopes.T @ np.asarray(left).reshape(-1) / 0.01
    missed = np.linalg.solve(information, score)
    assert score @ missed < scipy.stats.chi2.ppf(0.999, 5)
    errors = np.sqrt(np.diag(np.linalg.inv(information)))
    assert np.all(errors[:3] < 0.02 * values[free[:3]]) and np.all(errors[3:] < 0.1)
