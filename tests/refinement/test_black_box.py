"""Black boxes in local coordinates: bases, several records, innovation models."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.stats

from lpvid._results import Status
from lpvid.data import IOData
from lpvid.models import StateSpace
from lpvid.refinement import Innovation, refine

from .plants import DT, black_box, black_box_record

T = np.array([[1.0, 0.4, 0.0], [-0.3, 2.0, 0.1], [0.0, 0.5, 0.5]])


def perturbed(seed=0):
    model, rng = black_box(), np.random.default_rng(seed)
    parts = (m * (1 + 0.05 * rng.standard_normal(m.shape)) for m in (model.A, model.B, model.C))
    return StateSpace(*parts, model.D, dt=DT)


@pytest.fixture(scope="module")
def record():
    return black_box_record()


@pytest.fixture(scope="module")
def fitted(record):
    return refine(perturbed(), record)


def markov(model, count=8):
    parts, state = [model.D], model.B
    for _ in range(count):
        parts.append(model.C @ state)
        state = model.A @ state
    return jnp.stack(parts)


def responses(fit):
    """Markov parameters and their standard errors, which no basis changes."""

    def of(parameters):
        return markov(fit.model_at(parameters)).reshape(-1)

    slope = jax.jit(jax.jacfwd(of))(fit.parameters)
    variance = jnp.einsum("ip,pq,iq->i", slope, fit.covariance, slope)
    return of(fit.parameters), jnp.sqrt(variance)


def test_the_fit_is_better_than_the_truth_and_near_it(record, fitted):
    assert fitted.status == Status.successful
    assert fitted.x0.shape == (2, 3) and fitted.residual.shape == (320, 2)
    truth = black_box()
    states = [np.array([2.0, -1.0, 1.0]) * (1 + k) for k in range(2)]
    parts = [
        r.y - truth.simulate(u=r.u, x0=x0) for r, x0 in zip(record.records, states, strict=True)
    ]
    true_residual = np.concatenate(parts)
    determinant = np.linalg.det(true_residual.T @ true_residual)
    assert np.linalg.det(fitted.residual.T @ fitted.residual) < determinant
    # Twice the gain in likelihood is χ² with as many degrees of freedom as unknowns.
    unknowns = 3 * (2 + 2) + 4 + 6
    assert int(fitted.stats["degrees_of_freedom"]) == unknowns
    gain = 320 * np.log(
        determinant / np.linalg.det(np.asarray(fitted.residual.T @ fitted.residual))
    )
    assert scipy.stats.chi2.ppf(1e-4, unknowns) < gain < scipy.stats.chi2.ppf(1 - 1e-4, unknowns)
    np.testing.assert_allclose(
        np.sqrt(np.diag(fitted.noise_covariance)), [0.2, 2.0], rtol=4 / np.sqrt(2 * 320)
    )


def test_the_basis_of_the_start_does_not_matter(record, fitted):
    other = refine(perturbed().transform(T), record)
    values, errors = responses(fitted)
    others, other_errors = responses(other)
    assert np.max(np.abs(values - others) / errors) < 1e-3
    np.testing.assert_allclose(errors, other_errors, rtol=1e-4)
    rank = np.linalg.matrix_rank(np.asarray(fitted.covariance), tol=1e-14)
    assert rank <= 3 * (2 + 2) + 4


@pytest.mark.slow
def test_errors_of_the_response_are_what_they_claim(record):
    base = record

    @jax.jit
    def all_of_them(ys):
        def one(y):
            fit = refine(perturbed(), base.replace(y=y))
            return fit.parameters, fit.covariance

        return jax.lax.map(one, ys)

    count = 60
    ys = jnp.stack([black_box_record(seed=seed).y for seed in range(count)])
    parameters, covariance = all_of_them(ys)
    truth = markov(black_box()).reshape(-1)

    @jax.jit
    @jax.vmap
    def standardised(parameters, covariance):
        def of(p):
            return markov(build(p)).reshape(-1)

        slope = jax.jacfwd(of)(parameters)
        return (of(parameters) - truth) / jnp.sqrt(
            jnp.einsum("ip,pq,iq->i", slope, covariance, slope)
        )

    def build(p):
        A, B, C, D = jnp.split(p, [9, 15, 21])
        return StateSpace(A.reshape(3, 3), B.reshape(3, 2), C.reshape(2, 3), D.reshape(2, 2), dt=DT)

    z = np.asarray(standardised(parameters, covariance))
    # 36 responses from about 16 independent ones in 60 runs.
    assert 0.9 < np.sqrt(np.mean(z**2)) < 1.1
    assert 0.92 < np.mean(np.abs(z) < 1.96) < 0.98


@pytest.mark.slow
def test_no_feedthrough_where_the_start_has_none(record):
    start = perturbed()
    # The plant has a feedthrough, so that the fit without is poor.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        without = refine(StateSpace(start.A, start.B, start.C, dt=DT), record)
    assert not np.any(np.asarray(without.model.D))
    assert "D[0,0]" not in without.parameter_names


def test_entries_have_no_bounds(record):
    with pytest.raises(ValueError, match="black box"):
        refine(perturbed(), record, bounds={"A[0,0]": (0.0, 1.0)})


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (StateSpace([[0.5]], [[1.0]], [[1.0]], dt=DT), "1 inputs and 1 outputs"),
        (StateSpace(np.eye(2), np.eye(2), np.eye(2), dt=2 * DT), "dt=0.2"),
        (StateSpace(np.eye(2)[None], np.eye(2), np.eye(2), dt=DT), "batch"),
        ("model", "cannot be refined"),
    ],
)
def test_models_that_do_not_fit_the_data(record, model, message):
    with pytest.raises(ValueError, match=message):
        refine(model, record)


A_ARX, C_NOISE = 0.8, 0.3


def armax(seed=0, n=600, pole=A_ARX):
    """y(t) = a y(t−1) + u(t−1) + e(t) + c e(t−1): an innovation model with K = a + c."""
    rng = np.random.default_rng(seed)
    u, e = rng.standard_normal(n), 0.5 * rng.standard_normal(n)
    y, x = np.zeros(n), 0.0
    for t in range(n):
        y[t] = x + e[t]
        x = pole * x + u[t] + (pole + C_NOISE) * e[t]
    return IOData(u=u, y=y, dt=1.0)


@pytest.mark.slow
def test_innovation_model():
    record = armax()
    start = StateSpace([[0.6]], [[0.8]], [[1.0]], dt=1.0)
    fit = refine(start, record, predictor=Innovation())
    assert fit.status == Status.successful

    @jax.jit
    def residual(p):
        def step(x, sample):
            u, y = sample
            e = y - x
            return p[0] * x + p[1] * u + p[2] * e, e

        return jax.lax.scan(step, p[3], (record.u[:, 0], record.y[:, 0]))[1]

    found = scipy.optimize.least_squares(
        lambda p: np.asarray(residual(jnp.asarray(p))), [0.6, 0.8, 0.5, 0.0], xtol=1e-12, ftol=1e-14
    )
    model, K = fit.model, fit.innovation_gain
    covariance = 2 * found.cost / (600 - 4) * np.linalg.inv(found.jac.T @ found.jac)
    errors = np.sqrt(np.diag(covariance))
    invariant = [model.A[0, 0], (model.C @ model.B)[0, 0], (model.C @ K)[0, 0]]
    assert np.max(np.abs(np.array(invariant) - found.x[:3]) / errors[:3]) < 1e-3
    assert np.max(np.abs(found.x[:3] - [A_ARX, 1.0, A_ARX + C_NOISE]) / errors[:3]) < 4
    at = fit.parameter_names.index("A[0,0]")
    np.testing.assert_allclose(fit.standard_errors[at], errors[0], rtol=1e-3)


@pytest.mark.slow
def test_innovation_refines_an_unstable_plant():
    record = armax(pole=1.02, n=600)
    start = StateSpace([[1.0]], [[0.9]], [[1.0]], dt=1.0)
    fit = refine(start, record, predictor=Innovation(gain=[[0.8]]))
    assert fit.status == Status.successful
    at = fit.parameter_names.index("A[0,0]")
    assert abs(fit.model.A.item() - 1.02) < 4 * fit.standard_errors[at] + 1e-4
