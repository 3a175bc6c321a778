"""Innovation fits of LPV models: noise that enters the plant, feedback, unstable plants."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from lpvid._results import Status
from lpvid.analysis import horizon_errors, predict
from lpvid.data import IOData, join
from lpvid.models import (
    FunctionStructure,
    GrayBoxLPV,
    LPVStateSpace,
    StateSpace,
    StructuredModel,
    polynomial_basis,
)
from lpvid.refinement import Innovation, refine
from lpvid.refinement._modules import ModuleParameterisation
from lpvid.refinement._parameterisation import Record
from lpvid.refinement._recognise import recognise

from .plants import DT

NOISE = 0.1
GAIN = np.array([[0.9], [0.6]])
COEFFICIENTS = jnp.array([[4.0, 0.5], [1.5, 0.2]])
STRUCTURE = FunctionStructure(
    lambda p: (jnp.array([[0.0, 1.0], [-p[0], -p[1]]]), jnp.eye(2)[:, 1:], jnp.eye(2)[:1]),
    nominal=[4.0, 0.5],
    names=("stiffness", "damping"),
)
BASIS = polynomial_basis([0.0, 1.0], 1)


def oscillator(coefficients):
    return LPVStateSpace(STRUCTURE, BASIS, coefficients, jnp.zeros(1), jnp.ones(1))


def frozen(p, kappa):
    row = jnp.stack([-p[0] - p[1] * kappa[0], -p[2]])
    A = jnp.array([[0.0, 1.0], [0.0, 0.0]]).at[1].set(row)
    return StateSpace(A, jnp.array([[0.0], [1.0]]), jnp.array([[1.0, 0.0]]))


def gray_box(parameters):
    names = ("stiffness", "hardening", "damping")
    return GrayBoxLPV(frozen, parameters, names, kappa_low=0.0, kappa_high=1.0)


def swept(n):
    return 0.5 - 0.5 * np.cos(np.arange(n) * 0.05)


def record(model, kappa, seed, *, gain=GAIN, size=1.0, feedback=0.0):
    """x⁺ = A x + B u + K e, y = C x + e: the innovation form itself."""
    rng = np.random.default_rng(seed)
    n = len(kappa)
    u, e = size * rng.standard_normal((n, 1)), NOISE * rng.standard_normal((n, 1))
    sampled = model.at(kappa).discretise(DT)
    A, B, C = (np.asarray(matrix) for matrix in (sampled.A, sampled.B, sampled.C))
    x, y = np.zeros(2), np.zeros((n, 1))
    for t in range(n):
        y[t] = C[t] @ x + e[t]
        change = y[t] - y[max(t - 1, 0)]
        u[t] -= feedback * (y[t] + 0.4 * change / DT)
        x = A[t] @ x + B[t] @ u[t] + gain @ e[t]
    return IOData(u=u, y=y, dt=DT, kappa=kappa)


def white(residual):
    """Whether ten autocorrelations are those of white noise, at 0.1 %."""
    r = np.asarray(residual)[:, 0]
    n = len(r)
    share = np.array([np.sum(r[k:] * r[:-k]) for k in range(1, 11)]) / np.sum(r**2)
    statistic = n * (n + 2) * np.sum(share**2 / (n - np.arange(1, 11)))
    return statistic < scipy.stats.chi2.ppf(0.999, 10)


def predicted(model, gain, data, x0):
    """The recursion, sample by sample."""
    sampled = model.at(data.kappa).discretise(DT)
    A, B, C = (np.asarray(matrix) for matrix in (sampled.A, sampled.B, sampled.C))
    u, y, x, found = np.asarray(data.u), np.asarray(data.y), x0, []
    for t in range(len(y)):
        found.append(C[t] @ x)
        x = A[t] @ x + B[t] @ u[t] + gain @ (y[t] - found[-1])
    return np.array(found)


START = np.array([0.3, -0.2])
MOVING = record(oscillator(COEFFICIENTS), swept(60), 0)
RESTING = IOData(u=MOVING.u, y=MOVING.y, dt=DT, kappa=np.full(60, 0.4))


def responds(kind, values, data):
    each, x0 = Record(data.u, data.y, data.kappa, jnp.asarray(0)), jnp.asarray(START)
    return jax.jit(lambda v: kind.respond(v, each, x0))(jnp.asarray(values))


@pytest.mark.parametrize(
    ("model", "data"),
    [(oscillator(COEFFICIENTS), MOVING), (gray_box([4.0, 1.5, 0.5]), RESTING)],
    ids=["moving", "resting"],
)
def test_the_prediction_is_that_of_the_recursion(model, data):
    kind, values = recognise(model, data, Innovation(GAIN))
    assert isinstance(kind, ModuleParameterisation)
    expected = predicted(model, GAIN, data, START)
    assert kind.schedules == ("moving" if data is MOVING else "still")
    np.testing.assert_allclose(responds(kind, values, data), expected, atol=1e-11)
    if data is RESTING:
        mixed = replace(kind, schedules="mixed")
        np.testing.assert_allclose(responds(mixed, values, data), expected, atol=1e-11)
    assert kind.names[-2:] == ("K[0,0]", "K[1,0]")
    np.testing.assert_array_equal(kind.innovation_gain(values), GAIN)
    ahead = predict(model, u=data.u, y=data.y, gain=GAIN, kappa=data.kappa, dt=DT, x0=START)
    np.testing.assert_allclose(ahead, expected, atol=1e-11)


def test_without_dependence_on_the_schedule_it_is_the_linear_predictor():
    still = oscillator(COEFFICIENTS.at[1].set(0.0))
    lpv, values = recognise(still, MOVING, Innovation(GAIN))
    linear, same = recognise(StructuredModel(STRUCTURE, [4.0, 0.5]), MOVING, Innovation(GAIN))
    each = Record(MOVING.u, MOVING.y, MOVING.kappa, jnp.asarray(0))

    def respond(kind):
        def function(v):
            y = kind.respond(kind.prepare(v), each, jnp.asarray(START))
            return y, y

        return jax.jit(jax.jacfwd(function, has_aux=True))

    slopes, y = respond(lpv)(values)
    expected_slopes, expected = respond(linear)(same)
    np.testing.assert_allclose(y, expected, atol=1e-12)
    # Without the coefficients of κ: offset, offset, K, K.
    np.testing.assert_allclose(slopes[..., [0, 1, 4, 5]], expected_slopes, atol=1e-11)
    h = 1e-6
    moved = jax.jit(jax.vmap(lambda v: lpv.respond(v, each, jnp.asarray(START))))
    steps = h * jnp.eye(len(values))
    difference = (moved(values[None] + steps) - moved(values[None] - steps)) / (2 * h)
    np.testing.assert_allclose(np.moveaxis(difference, 0, -1), slopes, atol=1e-7)


@pytest.mark.parametrize("horizon", [5, 100])
def test_prediction_over_a_horizon(horizon):
    model = oscillator(COEFFICIENTS)
    sampled = model.at(MOVING.kappa).discretise(DT)
    A, B, C = (np.asarray(matrix) for matrix in (sampled.A, sampled.B, sampled.C))
    u, y, states = np.asarray(MOVING.u), np.asarray(MOVING.y), [START]
    for t in range(59):
        x = states[-1]
        states.append(A[t] @ x + B[t] @ u[t] + GAIN @ (y[t] - C[t] @ x))
    expected = []
    for t in range(60):
        begin = max(t - horizon + 1, 0)
        x = states[begin]
        for s in range(begin, t):
            x = A[s] @ x + B[s] @ u[s]
        expected.append(C[t] @ x)
    along = {"u": u, "kappa": MOVING.kappa, "dt": DT, "x0": START}
    found = predict(model, y=y, gain=GAIN, horizon=horizon, **along)
    np.testing.assert_allclose(found, expected, atol=1e-11)
    if horizon == 5:
        errors = horizon_errors(model, y=y, gain=GAIN, horizons=[1, 5], **along)
        np.testing.assert_allclose(errors.rmse[1], np.sqrt(np.mean((y - found) ** 2)))
        np.testing.assert_allclose(
            errors.rmse[2], np.sqrt(np.mean((y - model.simulate(**along)) ** 2))
        )


def test_what_cannot_be_predicted():
    model = oscillator(COEFFICIENTS)
    with pytest.raises(ValueError, match="its gain has shape"):
        refine(model, MOVING, predictor=Innovation([[1.0]]))
    with pytest.raises(ValueError, match="kappa: an LPV model needs"):
        predict(model, u=MOVING.u, y=MOVING.y, gain=GAIN, dt=DT)
    with pytest.raises(ValueError, match="y has shape"):
        two = np.zeros((60, 2))
        predict(model, u=MOVING.u, y=two, gain=np.eye(2), kappa=MOVING.kappa, dt=DT)
    with pytest.raises(ValueError, match="dt: the model is in continuous time"):
        predict(model, u=MOVING.u, y=MOVING.y, gain=GAIN, kappa=MOVING.kappa)
    with pytest.raises(ValueError, match="kappa: 60 samples"):
        predict(model, u=MOVING.u, y=MOVING.y, gain=GAIN, kappa=MOVING.kappa[:5], dt=DT)


@pytest.mark.slow
def test_innovation_reaches_the_bound_and_output_error_does_not():
    """All in units of the innovation fit's covariance, which is the bound: 99.9 % of χ²."""
    data = record(oscillator(COEFFICIENTS), swept(800), 10)
    start = oscillator(0.85 * COEFFICIENTS)
    fit, other = refine(start, data, predictor=Innovation()), refine(start, data)
    assert fit.status == other.status == Status.successful
    truth = np.concatenate([np.asarray(COEFFICIENTS).reshape(-1), GAIN[:, 0]])
    assert np.max(np.abs(fit.parameters - truth) / fit.standard_errors) < 4.0
    assert white(fit.residual) and not white(other.residual)
    np.testing.assert_allclose(fit.noise_covariance.item(), NOISE**2, rtol=0.2)

    def distance(parameters):
        error = np.asarray(parameters)[:4] - truth[:4]
        return error @ np.linalg.solve(np.asarray(fit.covariance)[:4, :4], error)

    limit = scipy.stats.chi2.ppf(0.999, 4)
    assert distance(fit.parameters) < limit < distance(other.parameters)
    along = {"u": data.u, "kappa": data.kappa, "dt": DT, "x0": fit.x0}
    ahead = predict(fit.model, y=data.y, gain=fit.innovation_gain, **along)
    np.testing.assert_allclose(data.y - ahead, fit.residual, atol=1e-10)


@pytest.mark.slow
def test_physical_parameters_from_resting_and_moving_records():
    truth = np.array([4.0, 1.5, 0.5])
    plant = gray_box(truth)
    schedules = (np.full(200, 0.2), swept(200))
    data = join([record(plant, kappa, 20 + i) for i, kappa in enumerate(schedules)])
    fit = refine(gray_box(1.2 * truth), data, predictor=Innovation())
    assert fit.status == Status.successful
    missed = np.abs(fit.parameters - np.concatenate([truth, GAIN[:, 0]])) / fit.standard_errors
    assert np.max(missed) < 4.0
    assert fit.parameter_names == ("stiffness", "hardening", "damping", "K[0,0]", "K[1,0]")
    along = {"u": data.u, "kappa": data.kappa, "dt": DT, "x0": fit.x0, "lengths": data.lengths}
    ahead = predict(fit.model, y=data.y, gain=fit.innovation_gain, **along)
    np.testing.assert_allclose(data.y - ahead, fit.residual, atol=1e-9)
    # A fit is a start, with its K.
    np.testing.assert_allclose(recognise(fit, data, Innovation()).values, fit.parameters)


@pytest.mark.slow
def test_an_unstable_plant_in_closed_loop():
    """Stiffness −2 to −0.5: the model topples, its predictor with a gain of one half does not."""
    coefficients = jnp.array([[-2.0, 0.5], [1.5, 0.2]])
    data = record(oscillator(coefficients), swept(800), 30, feedback=8.0, size=4.0)
    start = oscillator(jnp.array([[-1.0, 0.2], [0.5, 0.0]]))
    fit = refine(start, data, predictor=Innovation([[0.5], [0.5]]))
    assert fit.status == Status.successful
    truth = np.concatenate([np.asarray(coefficients).reshape(-1), GAIN[:, 0]])
    assert np.max(np.abs(fit.parameters - truth) / fit.standard_errors) < 4.0
    assert white(fit.residual)
