"""Multiple shooting: plants that grow or drift over the record, and the same fit as without it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpvid._results import Status
from lpvid.data import IOData
from lpvid.models import (
    FunctionStructure,
    LPVStateSpace,
    StateSpace,
    StructuredModel,
    polynomial_basis,
)
from lpvid.refinement import OutputError, refine
from lpvid.refinement._chain import ChainEquations, eliminate

from .plants import DT, black_box, black_box_record, inputs

SHOOTING = OutputError(shooting=25)


def pendulum(p):
    """ẍ = stiffness x − damping ẋ + gain u: toppling, drifting or swinging by the first sign."""
    A, B = jnp.array([[0.0, 1.0], [p[0], -p[1]]]), jnp.array([[0.0], [1.0]]) * p[2]
    return A, B, jnp.eye(2)[:1]


STRUCTURE = FunctionStructure(
    pendulum, nominal=[1.0, 0.5, 1.0], names=("stiffness", "damping", "gain")
)
POOR = StructuredModel(STRUCTURE, [4.0, 0.0, 0.5])


def recorded(truth, lengths=(400,), feedback=(0.0, 0.0), noise=0.05, seed=0):
    """Records under feedback of the true state, so that the measurement's noise is not fed back."""
    model = STRUCTURE.matrices(jnp.asarray(truth)).discretise(DT)
    A, B = np.asarray(model.A), np.asarray(model.B)[:, 0]
    rng = np.random.default_rng(seed)
    us, ys = [], []
    for n in lengths:
        x, states, u = np.zeros(2), [], rng.standard_normal(n)
        for t in range(n):
            u[t] -= np.dot(feedback, x)
            states.append(x[0])
            x = A @ x + B * u[t]
        us.append(u)
        ys.append(np.array(states) + noise * rng.standard_normal(n))
    growth = float(np.max(np.abs(np.linalg.eigvals(A)))) ** max(lengths)
    return IOData(u=us, y=ys, dt=DT), growth


def check(fit, truth, noise=0.05):
    assert fit.status == Status.successful
    assert float(fit.stats["largest_gap"]) < 1e-8
    assert np.max(np.abs(fit.parameters - np.asarray(truth)) / fit.standard_errors) < 4.0
    samples = fit.residual.shape[0]
    np.testing.assert_allclose(
        np.sqrt(fit.noise_covariance.item()), noise, rtol=4 / np.sqrt(2 * samples)
    )


def test_an_unstable_plant_held_by_feedback():
    """Open loop it grows 10¹³ times over the record, and the start is poor."""
    truth = (1.0, 0.5, 1.0)
    data, growth = recorded(truth, feedback=(2.0, 2.0))
    assert growth > 1e13
    fit = refine(POOR, data, predictor=SHOOTING)
    check(fit, truth)
    # An integrating plant, by the same compiled search.
    truth = (0.0, 0.5, 1.0)
    data, growth = recorded(truth)
    assert growth == pytest.approx(1.0, abs=1e-6)
    check(refine(POOR, data, predictor=SHOOTING), truth)


@pytest.mark.slow
def test_an_unstable_plant_that_runs_away():
    truth = (0.15, 0.02, 1.0)
    data, growth = recorded(truth)
    assert growth > 1e6 and np.max(np.abs(data.y)) > 1e4
    fit = refine(StructuredModel(STRUCTURE, [0.3, 0.1, 0.5]), data, predictor=SHOOTING)
    check(fit, truth)


@pytest.mark.slow
def test_errors_are_what_they_claim_on_an_unstable_plant():
    truth = (1.0, 0.5, 1.0)
    base, _ = recorded(truth, feedback=(2.0, 2.0), noise=0.0)
    noise = 0.05 * np.random.default_rng(7).standard_normal((100, 400, 1))

    @jax.jit
    def all_of_them(ys):
        def one(y):
            fit = refine(POOR, base.replace(y=y), predictor=SHOOTING)
            return fit.parameters, fit.standard_errors, fit.status

        return jax.lax.map(one, ys)

    found, errors, status = all_of_them(base.y[None] + jnp.asarray(noise))
    assert np.all(np.asarray(status == Status.successful))
    ratio = np.std(found, axis=0, ddof=1) / np.mean(errors, axis=0)
    # Standard deviation of a standard deviation from 100 draws: 7 %.
    assert np.all((ratio > 0.79) & (ratio < 1.21))


@pytest.mark.slow
def test_the_same_as_single_shooting_on_a_stable_plant():
    """Records of different lengths, so that pieces without samples are among them."""
    truth = (-4.0, 0.5, 2.0)
    data, _ = recorded(truth, lengths=(300, 210))
    start = StructuredModel(STRUCTURE, [-3.5, 0.7, 1.5])
    single = refine(start, data)
    pieces = refine(start, data, predictor=SHOOTING)
    check(pieces, truth)
    np.testing.assert_allclose(pieces.parameters, single.parameters, rtol=1e-6)
    np.testing.assert_allclose(pieces.x0, single.x0, atol=1e-6)
    np.testing.assert_allclose(pieces.covariance, single.covariance, rtol=1e-4)
    np.testing.assert_allclose(pieces.robust_covariance, single.robust_covariance, rtol=1e-3)
    np.testing.assert_allclose(pieces.cost, single.cost, atol=1e-6)
    assert pieces.stats["degrees_of_freedom"] == single.stats["degrees_of_freedom"]


@pytest.mark.slow
@pytest.mark.parametrize("initial_state", ["free", "zero"])
def test_a_black_box_is_the_same_too(initial_state):
    data, model, rng = black_box_record(), black_box(), np.random.default_rng(0)
    A, B, C = (m * (1 + 0.05 * rng.standard_normal(m.shape)) for m in (model.A, model.B, model.C))
    start = StateSpace(A, B, C, model.D, dt=DT)
    single = refine(start, data, initial_state=initial_state)
    pieces = refine(start, data, predictor=SHOOTING, initial_state=initial_state)
    assert pieces.status == Status.successful
    np.testing.assert_allclose(pieces.cost, single.cost, atol=1e-6)
    omega = jnp.linspace(0.1, 30.0, 20)
    np.testing.assert_allclose(
        pieces.model.frequency_response(omega),
        single.model.frequency_response(omega),
        rtol=1e-5,
        atol=1e-5,
    )
    # Each search stops within 1.5e-4 standard deviations.
    noise = jnp.array([0.2, 2.0])[None]
    np.testing.assert_allclose(pieces.residual / noise, single.residual / noise, atol=3e-4)


@pytest.mark.slow
def test_an_lpv_model_that_is_unstable_along_its_schedule():
    basis = polynomial_basis([0.0, 1.0], 1)
    coefficients = jnp.array([[-1.0, 0.5, 1.0], [2.0, 0.2, 0.5]])
    truth = LPVStateSpace(STRUCTURE, basis, coefficients, jnp.zeros(1), jnp.ones(1))
    n = 400
    u, kappa = inputs(n, seed=3), 0.5 - 0.5 * np.cos(np.arange(n) * 0.05)
    clean = np.asarray(truth.simulate(u=u, kappa=kappa, dt=DT, x0=[0.3, 0.0]))
    y = clean + 0.05 * np.random.default_rng(1).standard_normal(clean.shape)
    start = LPVStateSpace(STRUCTURE, basis, 0.8 * coefficients, jnp.zeros(1), jnp.ones(1))
    fit = refine(start, IOData(u=u, y=y, dt=DT, kappa=kappa), predictor=SHOOTING)
    check(fit, np.asarray(coefficients).reshape(-1))


def test_elimination_is_the_least_squares_solution():
    rng = np.random.default_rng(0)
    pieces, nx, shared, rows = 4, 2, 3, 7
    each = rng.standard_normal((1, pieces, rows, nx + shared + 1))
    joints = rng.standard_normal((1, pieces, nx, 2 * nx + shared + 1))
    joints[:, -1] = 0.0
    full = np.zeros((pieces * (rows + nx), pieces * nx + shared + 1))
    for k in range(pieces):
        at = slice(k * rows, (k + 1) * rows)
        full[at, k * nx : (k + 1) * nx] = each[0, k, :, :nx]
        full[at, pieces * nx :] = each[0, k, :, nx:]
        at = slice(pieces * rows + k * nx, pieces * rows + (k + 1) * nx)
        if k < pieces - 1:
            full[at, k * nx : (k + 2) * nx] = joints[0, k, :, : 2 * nx]
            full[at, pieces * nx :] = joints[0, k, :, 2 * nx :]
    expected = np.linalg.lstsq(full[:, :-1], -full[:, -1])[0]
    equations = ChainEquations(
        jnp.zeros(()), jnp.zeros(shared), jnp.asarray(each), jnp.asarray(joints), jnp.zeros(nx)
    )
    step = equations.step(jnp.asarray(0.0), jnp.zeros(shared, bool))
    np.testing.assert_allclose(step.own[0], expected[: pieces * nx], rtol=1e-9)
    np.testing.assert_allclose(step.shared, expected[pieces * nx :], rtol=1e-9)
    gained = 0.5 * (full[:, -1] @ full[:, -1] - np.sum((full @ np.append(expected, 1.0)) ** 2))
    np.testing.assert_allclose(equations.gain(step), gained, rtol=1e-9)
    rest = eliminate(jnp.asarray(each), jnp.asarray(joints), jnp.zeros(nx)).rest[0]
    schur = np.linalg.inv(np.linalg.inv(full[:, :-1].T @ full[:, :-1])[-shared:, -shared:])
    np.testing.assert_allclose(rest[:, :shared].T @ rest[:, :shared], schur, rtol=1e-9)


def test_pieces_that_do_not_meet_are_told():
    data, _ = recorded((1.0, 0.5, 1.0), feedback=(2.0, 2.0))
    with pytest.warns(UserWarning, match="do not meet"):
        fit = refine(POOR, data, predictor=SHOOTING, max_steps=3)
    assert fit.status == Status.discontinuous


def test_too_short_pieces():
    with pytest.raises(ValueError, match="at least 2"):
        OutputError(shooting=1)
