"""Structured models: against SciPy, Monte Carlo and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from lpvid._results import Status
from lpvid.models import StructuredModel
from lpvid.refinement import HuberLoss, profile_likelihood, refine
from lpvid.refinement._levenberg_marquardt import Unknowns
from lpvid.refinement._losses import SquaredLoss
from lpvid.refinement._parameterisation import padded_records
from lpvid.refinement._predictors import OutputError
from lpvid.refinement._recognise import recognise
from lpvid.refinement._refine import prepare

from .plants import DT, NAMES, STRUCTURE, TRUTH, structured_record

START = StructuredModel(STRUCTURE, TRUTH * np.array([1.2, 0.7, 0.8, 1.5]))


@pytest.fixture(scope="module")
def record():
    return structured_record()[0]


@pytest.fixture(scope="module")
def fitted(record):
    return refine(START, record)


def scipy_fit(record, start):
    """The same minimum by SciPy: one output, so least squares is maximum likelihood."""

    @jax.jit
    def residual(unknowns):
        model = STRUCTURE.matrices(unknowns[:4])
        return (record.y - model.simulate(u=record.u, dt=DT, x0=unknowns[4:]))[:, 0]

    found = scipy.optimize.least_squares(
        lambda x: np.asarray(residual(jnp.asarray(x))),
        np.concatenate([start, np.zeros(2)]),
        x_scale="jac",
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-14,
    )
    noise = 2.0 * found.cost / (record.n_samples - 6)
    return found, noise * np.linalg.inv(found.jac.T @ found.jac)


def test_the_estimate_and_its_covariance_are_scipys(record, fitted):
    found, covariance = scipy_fit(record, np.asarray(START.parameters))
    assert fitted.status == Status.successful
    errors = np.sqrt(np.diag(covariance))
    # The search stops within 2e-4 standard deviations.
    assert np.max(np.abs(fitted.parameters - found.x[:4]) / errors[:4]) < 5e-4
    assert np.max(np.abs(fitted.x0[0] - found.x[4:]) / errors[4:]) < 5e-4
    np.testing.assert_allclose(fitted.covariance, covariance[:4, :4], rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(
        fitted.noise_covariance.item(), 2 * found.cost / (300 - 6), rtol=1e-6
    )
    assert fitted.parameter_names == NAMES
    assert fitted.residual.shape == (300, 1)
    assert fitted.cost < fitted.initial_cost


def test_the_gradient_is_that_of_finite_differences(record):
    task, chosen = prepare(
        recognise(START, record, OutputError()),
        record,
        OutputError(),
        SquaredLoss(),
        None,
        (),
        (),
        "free",
    )
    problem, _ = task.problem(*padded_records(record), chosen)
    cost = jax.jit(lambda x: problem.cost(x))
    linearise = jax.jit(lambda x: problem.linearise(x, problem.residual(x)))
    at = Unknowns(jnp.array([0.05, -0.02, 0.1, 0.03]), jnp.array([[0.2, 0.1]]))
    equations = linearise(at)

    def slope(shared, own):
        def moved(h):
            return cost(Unknowns(at.shared + h * shared, at.own + h * own))[0].item()

        return (moved(1e-5) - moved(-1e-5)) / 2e-5

    for i in range(4):
        expected = slope(jnp.eye(4)[i], jnp.zeros((1, 2)))
        np.testing.assert_allclose(equations.gradient[i], expected, rtol=1e-6)
    for i in range(2):
        expected = slope(jnp.zeros(4), jnp.eye(2)[i : i + 1])
        np.testing.assert_allclose(equations.own_gradient[0, i], expected, rtol=1e-6)
    assert equations.cost == cost(at)[0]


def monte_carlo(colour, count=150):
    base, clean = structured_record(noise=0.0)
    ys = jnp.stack(
        [jnp.asarray(structured_record(seed=seed, colour=colour)[0].y) for seed in range(count)]
    )

    @jax.jit
    def all_of_them(ys):
        def one(y):
            fit = refine(START, base.replace(y=y))
            return fit.parameters, fit.covariance, fit.robust_covariance, fit.status

        return jax.lax.map(one, ys)

    return all_of_them(ys), clean


@pytest.fixture(scope="module")
def white_noise():
    return monte_carlo(0.0)[0]


@pytest.mark.slow
def test_covariance_is_that_of_many_realisations(white_noise):
    parameters, covariance, robust, status = white_noise
    assert np.all(np.asarray(status == Status.successful))
    spread = np.std(parameters, axis=0, ddof=1)
    # Standard deviation of a standard deviation from 150 draws: 6 %.
    claimed = np.sqrt(np.mean(np.diagonal(covariance, axis1=1, axis2=2), axis=0))
    np.testing.assert_allclose(claimed, spread, rtol=0.2)
    robustly = np.sqrt(np.mean(np.diagonal(robust, axis1=1, axis2=2), axis=0))
    np.testing.assert_allclose(robustly, claimed, rtol=0.1)
    assert np.max(np.abs(np.mean(parameters, axis=0) - TRUTH) / spread) < 4 / np.sqrt(150)


@pytest.mark.slow
def test_robust_covariance_holds_for_coloured_noise():
    (parameters, covariance, robust, _), _ = monte_carlo(0.9)
    spread = np.std(parameters, axis=0, ddof=1)
    claimed, robustly = (
        np.sqrt(np.mean(np.diagonal(each, axis1=1, axis2=2), axis=0))
        for each in (covariance, robust)
    )
    # The white-noise formula is wrong by far for some parameter, the robust one for none.
    assert np.max(np.abs(np.log(claimed / spread))) > np.log(1.5)
    np.testing.assert_allclose(robustly, spread, rtol=0.25)


def test_bounds_are_kept_and_named(record, fitted):
    below = float(fitted.parameters[0]) - 0.2
    with pytest.warns(UserWarning, match="At a bound: stiffness"):
        held = refine(START, record, bounds={"stiff*": (1.0, below)})
    assert held.status == Status.at_bound
    assert held.parameters[0] == below
    assert held.cost > fitted.cost
    # The others are as uncertain as with the stiffness known.
    keep = [1, 2, 3]
    information = np.linalg.inv(np.asarray(fitted.covariance))[np.ix_(keep, keep)]
    expected = np.sqrt(np.diag(np.linalg.inv(information)))
    np.testing.assert_allclose(held.standard_errors[1:], expected, rtol=0.3)
    assert held.standard_errors[0] == 0.0


def test_unused_bounds_change_nothing(record, fitted):
    wide = refine(START, record, bounds={"*": (-100.0, 100.0)})
    np.testing.assert_allclose(wide.parameters, fitted.parameters, rtol=1e-9)
    np.testing.assert_allclose(wide.covariance, fitted.covariance, rtol=1e-9)


def test_an_unstable_start_is_a_status(record):
    start = StructuredModel(STRUCTURE, TRUTH * np.array([1.0, -30.0, 1.0, 1.0]))
    bounds = {"damping": (-100.0, 100.0)}
    with pytest.warns(UserWarning, match="grows without bound"):
        failed = refine(start, record, bounds=bounds, throw=False)
    assert failed.status == Status.overflow
    assert "shooting" in failed.advice
    with pytest.raises(ValueError, match="grows without bound"):
        refine(start, record, bounds=bounds)


def test_confidence_intervals(fitted):
    narrow, wide = fitted.confidence_intervals(0.5), fitted.confidence_intervals()
    np.testing.assert_allclose(wide.mean(axis=1), fitted.parameters, rtol=1e-12)
    np.testing.assert_allclose(
        wide[:, 1] - wide[:, 0], 2 * 1.959964 * fitted.standard_errors, rtol=1e-6
    )
    assert np.all(narrow[:, 0] > wide[:, 0])
    with pytest.raises(ValueError, match="level"):
        fitted.confidence_intervals(95.0)


def test_profile_likelihood_agrees_with_a_parabola(record, fitted):
    points = float(fitted.parameters[2]) + np.array([-2.5, -1.5, 1.5, 2.5]) * float(
        fitted.standard_errors[2]
    )
    profile = profile_likelihood(fitted, record, "gain", points=points)
    # ½ N log(1 + s²/(N−6)) is nearly ½ s² for s standard errors.
    np.testing.assert_allclose(
        profile.increase, 0.5 * np.array([2.5, 1.5, 1.5, 2.5]) ** 2, rtol=0.1
    )
    expected = fitted.confidence_intervals()[2]
    np.testing.assert_allclose(profile.interval(), expected, atol=0.1 * (expected[1] - expected[0]))
    assert np.all(np.isinf(profile.interval(0.9999)))
    with pytest.raises(ValueError, match="no parameter 'mass'"):
        profile_likelihood(fitted, record, "mass")


@pytest.mark.slow
def test_outliers_do_not_carry_a_robust_fit_away(record):
    y = np.array(record.y)
    y[::25] += 5.0
    spoilt = record.replace(y=y)
    plain, robust = refine(START, spoilt), refine(START, spoilt, loss=HuberLoss())
    missed = np.abs(robust.parameters - TRUTH) / robust.standard_errors
    assert np.max(missed) < 4.0
    far, near = (np.linalg.norm(f.parameters / TRUTH - 1.0) for f in (plain, robust))
    assert near < 0.3 * far
    # 4 % outliers cost little: the interval is near that of the clean record, not 10 times wider.
    assert np.max(robust.standard_errors / plain.standard_errors) < 0.3


@pytest.mark.slow
def test_fixed_and_tied_parameters(record):
    start = StructuredModel(STRUCTURE, [3.0, 0.4, 2.0, 0.3])
    fit = refine(start, record, fixed=("damp*",), tied=(("gain", "stiffness"),))
    assert fit.parameters[1] == 0.4
    assert fit.parameters[0] == fit.parameters[2]
    assert fit.standard_errors[1] == 0.0
    assert fit.standard_errors[0] == fit.standard_errors[2] > 0.0
    assert int(fit.stats["degrees_of_freedom"]) == 2 + 2

    def cost(x):
        model = STRUCTURE.matrices(jnp.array([x[0], 0.4, x[0], x[1]]))
        return (record.y - model.simulate(u=record.u, dt=DT, x0=x[2:]))[:, 0]

    compiled = jax.jit(cost)
    found = scipy.optimize.least_squares(
        lambda x: np.asarray(compiled(jnp.asarray(x))), [3.0, 0.3, 0, 0], xtol=1e-12, ftol=1e-14
    )
    np.testing.assert_allclose(fit.parameters[jnp.array([0, 3])], found.x[:2], rtol=1e-5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(fixed=("mass",)), "no parameter is called 'mass'"),
        (dict(fixed=("*",)), "every parameter is fixed"),
        (dict(fixed="gain"), "a sequence of patterns"),
        (dict(fixed=("gain",), tied=(("gain", "damping"),)), "gain is fixed"),
        (dict(bounds={"gain": (2.0, 1.0)}), "lies above"),
        (dict(initial_state="rest"), "'free', 'zero' or known"),
        (dict(initial_state=np.zeros(3)), "is needed"),
        (dict(max_steps=0), "at least 1"),
    ],
)
def test_static_faults_are_named(record, options, message):
    with pytest.raises(ValueError, match=message):
        refine(START, record, **options)
