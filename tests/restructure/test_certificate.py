"""The non-smooth stage: minima by SciPy, certificates by finite differences and SciPy."""

import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from lpvid._results import Status, is_successful
from lpvid.models import FunctionStructure, ModalStructure, StateSpace
from lpvid.restructure import HinfMatching, restructure

KEY = jax.random.key(1)
BUNDLE_ONLY = HinfMatching(passes=0)

LAG = FunctionStructure(
    lambda p: (-p[:1, None], p[:1, None], p[1:, None]),
    nominal=[1.0, 1.0],
    names=("rate", "gain"),
    lower=[0.0, 0.0],
    upper=[np.inf, 2.0],
)
TWO_LAGS = StateSpace(np.diag([-8.0, -30.0]), [[8.0], [30.0]], [[1.2, -0.5]])
STRONG = StateSpace(np.diag([-8.0, -30.0]), [[8.0], [30.0]], [[3.0, 0.0]])


def response(model, omega):
    A, B, C, D = (np.asarray(m) for m in (model.A, model.B, model.C, model.D))
    return C @ np.linalg.solve(1j * omega * np.eye(len(A)) - A, B) + D


def subgradients(black_box, best):
    """Slopes of the logarithms of the active gains by central differences, in scaled directions."""
    certificate = best.certificate
    scaling = np.asarray(certificate.scaling)
    point = np.asarray(best.parameters)
    rows = []
    for omega in np.asarray(certificate.frequencies)[np.asarray(certificate.active)]:

        def gain(x, omega=omega):
            model = best.structure.matrices(jnp.asarray(point + scaling @ x))
            error = response(model, omega) - response(black_box, omega)
            return np.log(np.linalg.svd(error, compute_uv=False)[0])

        steps = 1e-4 * np.eye(scaling.shape[1])
        rows.append([(gain(step) - gain(-step)) / 2e-4 for step in steps])
    return np.array(rows)


def shortest(rows):
    """Length of the shortest convex combination, by SciPy's non-negative least squares."""
    # Wolfe's trick: a heavy row keeps the sum of the weights at one.
    heavy = 1e4
    matrix = np.concatenate([rows.T, heavy * np.ones((1, len(rows)))])
    weights, _ = scipy.optimize.nnls(matrix, np.append(np.zeros(rows.shape[1]), heavy))
    return np.linalg.norm(rows.T @ (weights / weights.sum()))


@pytest.fixture(scope="module")
def lag():
    return restructure(TWO_LAGS, LAG, starts=0, initial=[8.0, 1.0], method=BUNDLE_ONLY)


def test_the_certificate_is_that_of_finite_differences(lag):
    certificate = lag.certificate
    assert is_successful(lag.status) and certificate.certified
    assert certificate.distance <= certificate.tolerance == BUNDLE_ONLY.tolerance
    rows = subgradients(TWO_LAGS, lag)
    # No single slope is short: it takes several frequencies to balance.
    assert np.linalg.norm(rows, axis=1).min() > 100 * BUNDLE_ONLY.tolerance
    assert shortest(rows) <= 2.0 * BUNDLE_ONLY.tolerance
    np.testing.assert_allclose(certificate.multipliers.sum(), 1.0, rtol=1e-9)


def test_a_minimum_is_scipys(lag):
    omega = np.concatenate([[0.0], np.geomspace(0.01, 1e4, 4000)])
    target = np.array([response(TWO_LAGS, w)[0, 0] for w in omega])

    def norm(p):
        return np.abs(p[0] * p[1] / (1j * omega + p[0]) - target).max()

    found = scipy.optimize.minimize(
        norm, [8.0, 1.0], method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 1e-12}
    )
    np.testing.assert_allclose(norm(np.asarray(lag.parameters)), lag.error_norm, rtol=1e-5)
    assert lag.error_norm <= found.fun * (1.0 + BUNDLE_ONLY.tolerance)
    assert lag.history[-1] == pytest.approx(float(lag.error_norm), rel=1e-8)


def test_a_minimum_may_lie_on_a_bound():
    best = restructure(STRONG, LAG, starts=0, initial=[8.0, 1.0], method=BUNDLE_ONLY)
    assert best.parameters[1] <= 2.0
    np.testing.assert_allclose(best.parameters[1], 2.0, rtol=1e-9)
    # What the bound leaves at rest, whatever the rate.
    np.testing.assert_allclose(best.error_norm, 1.0, rtol=1e-9)
    assert best.certificate.certified
    assert best.certificate.at_bound.tolist() == [False, True]


@pytest.mark.slow
def test_a_point_that_is_no_minimum_is_not_certified():
    quick = HinfMatching(match_steps=1, passes=0, bundle_steps=1)
    best = restructure(TWO_LAGS, LAG, starts=0, initial=[100.0, 0.1], method=quick)
    assert best.status == Status.uncertified
    assert best.certificate.distance > 10 * quick.tolerance
    np.testing.assert_allclose(
        best.certificate.distance, shortest(subgradients(TWO_LAGS, best)), rtol=1e-3
    )


@pytest.mark.slow
def test_fixed_tied_and_bounded_parameters():
    fixed = restructure(
        TWO_LAGS, LAG, starts=0, initial=[8.0, 1.0], fixed={"rate": 4.0}, method=BUNDLE_ONLY
    )
    assert fixed.parameters[0] == 4.0 and fixed.certificate.certified
    assert fixed.structure is LAG and fixed.certificate.scaling.shape == (2, 1)
    tied = restructure(
        TWO_LAGS,
        LAG,
        starts=2,
        key=KEY,
        tied=["*"],
        bounds={"*": (0.5, 1.5)},
        method=BUNDLE_ONLY,
    )
    assert tied.parameters[0] == tied.parameters[1]
    assert 0.5 <= tied.parameters[0] <= 1.5


@pytest.mark.slow
def test_a_weight_is_part_of_the_norm():
    weight = StateSpace([[-1.0]], [[1.0]], [[1.0]])
    options = {"starts": 0, "initial": [8.0, 1.0], "method": BUNDLE_ONLY}
    best = restructure(TWO_LAGS, LAG, weight=weight, **options)
    omega = np.geomspace(1e-3, 1e3, 4000)
    error = best.model.frequency_response(omega) - TWO_LAGS.frequency_response(omega)
    gains = np.abs(np.asarray(error)[:, 0, 0]) / np.abs(1j * omega + 1.0)
    np.testing.assert_allclose(best.error_norm, gains.max(), rtol=1e-4)
    plain = restructure(TWO_LAGS, LAG, **options)
    error = plain.model.frequency_response(omega) - TWO_LAGS.frequency_response(omega)
    assert best.error_norm < (np.abs(np.asarray(error)[:, 0, 0]) / np.abs(1j * omega + 1.0)).max()
    on_grid = restructure(
        TWO_LAGS, LAG, weight=lambda w: 1.0 / jnp.sqrt(1.0 + w**2), omega=omega[::40], **options
    )
    assert on_grid.certificate.certified
    np.testing.assert_allclose(on_grid.error_norm, best.error_norm, rtol=1e-2)


@pytest.mark.slow
def test_a_model_stays_stable():
    # The error of this unstable black box is smallest for an unstable model.
    free = FunctionStructure(
        lambda p: (p[:1, None], jnp.ones((1, 1)), p[1:, None]), nominal=[-1.0, 1.0], spread=0.5
    )
    unstable = StateSpace([[2.0]], [[1.0]], [[3.0]])
    options = {"starts": 0, "initial": [[-1.0, 1.0]], "method": BUNDLE_ONLY}
    best = restructure(unstable, free, stable=True, **options)
    assert best.parameters[0] < 0.0
    # No stable model is better than none: the distance of an unstable pole is its Hankel norm.
    assert best.error_norm >= 3.0 / 4.0 * (1.0 - 1e-9)


@pytest.mark.slow
def test_the_certificate_holds_for_several_channels():
    structure = ModalStructure(1, n_inputs=2, n_outputs=2)
    truth = np.array([np.log(5.0), np.log(0.1), 1.0, 0.5, -0.3, 0.8, 0.4, -0.6])
    weak = StateSpace([[0.0, 9.0], [-9.0, -1.0]], 0.1 * np.eye(2), [[1.0, -0.5], [0.3, 2.0]])
    black_box = structure.matrices(jnp.asarray(truth)) + weak
    best = restructure(black_box, structure, starts=0, initial=truth, method=BUNDLE_ONLY)
    assert best.error_norm < best.history[0]
    # Three peaks, two of them close together, and far from straight along the steps.
    assert best.certificate.certified and is_successful(best.status)
    assert shortest(subgradients(black_box, best)) <= 2.0 * BUNDLE_ONLY.tolerance


def turned(angle):
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


@pytest.mark.slow
def test_the_certificate_holds_where_singular_values_are_equal():
    # One gain for two channels that want 1 and 3, in turned axes: at 2 both errors are 1.
    left, right = turned(0.4), turned(1.1)
    structure = FunctionStructure(
        lambda p: (-p[1] * jnp.eye(2), p[0] * p[1] * jnp.asarray(right), jnp.asarray(left)),
        nominal=[1.0, 1.0],
        names=("gain", "rate"),
    )
    black_box = StateSpace(-np.eye(2), np.diag([1.0, 3.0]) @ right, left)
    options = {"starts": 0, "method": BUNDLE_ONLY}
    best = restructure(black_box, structure, initial=[2.3, 1.2], **options)
    np.testing.assert_allclose(best.error_norm, 1.0, rtol=1e-6)
    np.testing.assert_allclose(best.parameters[0], 2.0, rtol=1e-5)
    # Neither singular vector alone is short: the norm of each falls with the gain.
    assert best.certificate.certified and is_successful(best.status)
    elsewhere = restructure(
        black_box, structure, initial=[2.3, 1.2], fixed={"gain": 2.3}, **options
    )
    np.testing.assert_allclose(elsewhere.error_norm, 1.3, rtol=1e-6)


BENCHMARK = Path(__file__).resolve().parents[2] / "benchmarks" / "restructure.py"


@pytest.fixture(scope="module")
def benchmark():
    spec = importlib.util.spec_from_file_location("benchmark_restructure", BENCHMARK)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.parametrize("numbers", [(2, 9), (3, 10), (6,)], ids=str)
def test_nothing_better_is_found_by_slsqp_or_from_the_truth(benchmark, numbers):
    problems = benchmark.problems(1 + max(numbers))
    for number in numbers:
        row = benchmark.solve(problems[number])
        assert row.above <= 1e-3
        assert row.certified


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fixed": {"mass": 1.0}}, "fixed: no parameter is called 'mass'"),
        ({"fixed": {"*": 1.0}}, "every parameter is fixed"),
        ({"bounds": {"rate": (2.0, 1.0)}}, "2.0 lies above 1.0"),
        ({"bounds": {"rate": (1.0, 2.0)}, "fixed": {"rate": 1.0}}, "that is fixed"),
        ({"bounds": {"rate": (5.0, 9.0)}, "tied": ["*"]}, "no value is left"),
        ({"weight": lambda w: w}, "no exact norm"),
        ({"weight": StateSpace([[1.0]], [[1.0]], [[1.0]])}, "weight: it is unstable"),
        ({"weight": StateSpace([[-1.0]], [[1.0, 1.0]], [[1.0]])}, "1 x 2 channels"),
        ({"weight": lambda w: w[:1], "omega": [1.0, 2.0]}, r"weight: shape \(1,\)"),
    ],
)
def test_impossible_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        restructure(TWO_LAGS, LAG, starts=0, initial=[8.0, 1.0], **options)
