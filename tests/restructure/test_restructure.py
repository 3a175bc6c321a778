"""Restructuring: known truths from random bases, norms by SLICOT, minima by SciPy."""

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from lpvid._results import Status, is_successful
from lpvid.mechanics import OPERATING_POINTS, reference_two_link_arm, two_link_arm_structure
from lpvid.models import (
    AbstractStructure,
    FreeStructure,
    FunctionStructure,
    ModalStructure,
    StateSpace,
)
from lpvid.restructure import HinfMatching, restructure, restructure_along

ARM = reference_two_link_arm()
ARM_STRUCTURE = two_link_arm_structure(lengths=(0.35, 0.30))
KEY = jax.random.key(1)
# Compiling is what these tests cost: no surrogate stage where it is not what is tested.
MATCH_ONLY = HinfMatching(passes=0, bundle_steps=0)
SMOOTH_ONLY = HinfMatching(passes=2, bundle_steps=0)


def in_random_basis(model, seed):
    T = np.random.default_rng(seed).normal(size=(model.nx, model.nx)) + 2.0 * np.eye(model.nx)
    return model.transform(T)


def linf(first, second):
    """‖first − second‖ by SLICOT."""
    parts = [control.ss(*(np.asarray(m) for m in (s.A, s.B, s.C, s.D))) for s in (first, second)]
    return control.linfnorm(parts[0] - parts[1])[0]


# --- the arm


@pytest.fixture(scope="module", params=[0, 3, 6], ids=lambda i: f"point {i + 1}")
def arm_point(request):
    theta2 = OPERATING_POINTS[request.param]
    black_box = in_random_basis(ARM.linearised(theta2), request.param)
    method = HinfMatching(bundle_steps=0)
    return theta2, restructure(black_box, ARM_STRUCTURE, starts=24, key=KEY, method=method)


@pytest.mark.slow
def test_the_arm_is_recovered_without_a_nominal(arm_point):
    theta2, best = arm_point
    truth = np.asarray(ARM.structured_parameters(theta2)).reshape(4, 4)
    found = np.asarray(best.parameters).reshape(4, 4)
    scale = np.linalg.norm(truth, axis=1, keepdims=True)
    np.testing.assert_allclose(found / scale, truth / scale, atol=1e-6)
    assert is_successful(best.status)
    assert 1 <= best.hits <= 24
    # The next minimum costs many orders more than rounding.
    assert best.margin > 1e6
    assert best.match_costs.shape == (24,)
    assert np.all(np.diff(best.match_costs) >= 0)


# --- one mode for two: a problem whose least-squares and minimax solutions differ

TWO_MODES = StateSpace(
    [[0.0, 4.0, 0, 0], [-4.0, -0.8, 0, 0], [0, 0, 0, 9.0], [0, 0, -9.0, -2.7]],
    [[0.0], [1.0], [0.0], [1.0]],
    [[4.0, 0.0, 5.0, 0.5]],
)
ONE_MODE = ModalStructure(1, n_inputs=1, n_outputs=1)


@pytest.fixture(scope="module")
def reduced():
    return restructure(
        in_random_basis(TWO_MODES, 5), ONE_MODE, starts=8, key=KEY, method=SMOOTH_ONLY
    )


@pytest.fixture(scope="module")
def dense_errors():
    """‖G(ϑ) − G_i‖ over a dense grid, for SciPy."""
    omega = np.concatenate([[0.0], np.geomspace(0.05, 100.0, 3000)])
    A, B, C = (np.asarray(m) for m in (TWO_MODES.A, TWO_MODES.B, TWO_MODES.C))
    target = np.array([(C @ np.linalg.solve(1j * w * np.eye(4) - A, B))[0, 0] for w in omega])

    def error(parameters):
        frequency, damping = np.exp(parameters[:2])
        s = 1j * omega
        numerator = parameters[2] * frequency + parameters[3] * s
        response = numerator / (s**2 + 2 * damping * frequency * s + frequency**2)
        return np.abs(response - target)

    return error


def test_the_error_norm_is_slycots(reduced):
    model = reduced.model
    np.testing.assert_allclose(reduced.error_norm, linf(model, TWO_MODES), rtol=1e-8)
    np.testing.assert_allclose(reduced.cost, reduced.error_norm**2)
    at_peak = (model - TWO_MODES).frequency_response(reduced.peak_frequency)
    np.testing.assert_allclose(np.abs(at_peak[0, 0, 0]), reduced.error_norm, rtol=1e-8)


def test_the_surrogate_stage_lowers_the_norm_and_never_raises_it(reduced):
    history = np.asarray(reduced.history)
    assert history.shape == (1 + SMOOTH_ONLY.passes,)
    assert np.all(np.diff(history) <= 0)
    # Least squares and minimax are different problems here.
    assert history[-1] < 0.9 * history[0]
    assert history[-1] == reduced.error_norm


def test_the_minimax_solution_is_scipys(reduced, dense_errors):
    rng = np.random.default_rng(0)
    centre = np.asarray(reduced.parameters)
    found = []
    for trial in range(6):
        start = centre + (0.0 if trial == 0 else 0.3) * rng.normal(size=4)
        result = scipy.optimize.minimize(
            lambda p: np.max(dense_errors(p)),
            start,
            method="Nelder-Mead",
            options={"maxiter": 2000, "xatol": 1e-9, "fatol": 1e-10, "adaptive": True},
        )
        found.append(result.fun)
    np.testing.assert_allclose(dense_errors(centre).max(), reduced.error_norm, rtol=1e-4)
    assert float(reduced.error_norm) <= 1.02 * min(found)


def test_without_passes_the_match_is_left_as_it_is(reduced):
    black_box = in_random_basis(TWO_MODES, 5)
    matched = restructure(black_box, ONE_MODE, starts=8, key=KEY, method=MATCH_ONLY)
    np.testing.assert_allclose(matched.error_norm, reduced.history[0], rtol=1e-6)
    np.testing.assert_allclose(matched.match_costs[0], reduced.match_costs[0], rtol=1e-6)


# --- other structures and targets


@pytest.mark.slow
def test_a_modal_model_is_recovered_from_a_random_basis():
    structure = ModalStructure(2, n_inputs=1, n_outputs=1)
    truth = structure.parameters_of(TWO_MODES)
    best = restructure(
        in_random_basis(TWO_MODES, 3), structure, starts=2, key=KEY, method=MATCH_ONLY
    )
    np.testing.assert_allclose(best.parameters, truth, rtol=1e-6, atol=1e-6)
    assert best.error_norm < 1e-8


@pytest.mark.slow
def test_black_boxes_of_another_order_are_matched():
    # One second-order plant, seen as one of order 3 with a weak real pole.
    plant = ONE_MODE.matrices(jnp.array([np.log(5.0), np.log(0.2), 1.0, 0.5]))
    black_box = in_random_basis(plant + StateSpace([[-20.0]], [[1e-3]], [[1.0]]), 2)
    best = restructure(black_box, ONE_MODE, starts=2, key=KEY, method=MATCH_ONLY)
    assert best.model.nx == 2
    # What the weak pole adds, which is half of it at best.
    assert best.error_norm < 1e-3 / 20.0
    np.testing.assert_allclose(best.error_norm, linf(best.model, black_box), rtol=1e-6)


@pytest.fixture(scope="module")
def lag():
    """A first-order lag with bounds: gain at most 2, rate from 0."""
    return FunctionStructure(
        lambda p: (-p[:1, None], p[:1, None], p[1:, None]),
        nominal=[1.0, 1.0],
        names=("rate", "gain"),
        lower=[0.0, 0.0],
        upper=[np.inf, 2.0],
    )


FAST_LAG = StateSpace([[-8.0]], [[4.0]], [[3.0]])


def test_discrete_black_boxes_are_converted(lag):
    best = restructure(FAST_LAG.discretise(0.01), lag, starts=4, key=KEY, method=MATCH_ONLY)
    np.testing.assert_allclose(best.parameters, [8.0, 1.5], rtol=1e-6)


def test_bounds_hold(lag):
    strong = StateSpace([[-8.0]], [[8.0]], [[3.0]])
    best = restructure(strong, lag, starts=4, key=KEY, method=SMOOTH_ONLY)
    assert best.parameters[1] <= 2.0
    # The best that the bound leaves is the error 1 at rest, whatever the rate.
    np.testing.assert_allclose(best.error_norm, 1.0, rtol=2e-3)


def test_a_grid_of_frequencies_is_the_whole_target(lag):
    omega = np.array([1.0, 5.0, 20.0])
    slow = StateSpace(np.diag([-8.0, -0.01]), [[4.0], [0.01]], [[3.0, 1.0]])
    best = restructure(slow, lag, starts=4, key=KEY, omega=omega, method=MATCH_ONLY)
    error = best.model.frequency_response(omega) - slow.frequency_response(omega)
    gains = np.abs(np.asarray(error)[:, 0, 0])
    np.testing.assert_allclose(best.error_norm, gains.max(), rtol=1e-9)
    assert best.peak_frequency == omega[np.argmax(gains)]
    # The slow mode below the grid does not count: its gain at rest is 1.
    assert best.error_norm < 0.05 < np.abs(best.model.dc_gain() - slow.dc_gain()).item()


def test_a_discrete_black_box_on_a_grid_is_met_at_its_own_response(lag):
    omega = [1.0, 5.0, 20.0]
    sampled = FAST_LAG.discretise(0.1)
    best = restructure(sampled, lag, starts=4, key=KEY, omega=omega, method=MATCH_ONLY)
    error = best.model.frequency_response(omega) - sampled.frequency_response(omega)
    np.testing.assert_allclose(best.error_norm, np.abs(error).max(), rtol=1e-9)
    # The hold's delay is in the target; no continuous lag has it.
    assert best.error_norm > 0.05


def test_given_starts_take_part(lag):
    four = np.array([[7.0, 1.0], [9.0, 1.0], [5.0, 1.5], [10.0, 0.5]])
    best = restructure(FAST_LAG, lag, starts=0, initial=four, method=MATCH_ONLY)
    np.testing.assert_allclose(best.parameters, [8.0, 1.5], rtol=1e-6)
    assert best.match_costs.shape == (4,) and best.hits == 4 and np.isinf(best.margin)
    both = restructure(FAST_LAG, lag, starts=2, key=KEY, initial=four[:2], method=MATCH_ONLY)
    assert both.match_costs.shape == (4,)


def test_a_free_structure_gives_the_black_box_back():
    best = restructure(FAST_LAG, FreeStructure(1, 1, 1), starts=1, key=KEY, method=MATCH_ONLY)
    assert best.error_norm < 1e-12


@pytest.mark.slow
def test_jit_and_vmap_over_black_boxes(lag):
    quick = HinfMatching(frequencies=20, match_steps=20, descent_steps=5, passes=1, bundle_steps=10)

    def gains(C):
        black_box = StateSpace(FAST_LAG.A, FAST_LAG.B, C)
        return restructure(black_box, lag, starts=2, key=KEY, method=quick)

    batch = jax.jit(jax.vmap(gains))(jnp.array([[[3.0]], [[2.0]]]))
    np.testing.assert_allclose(batch.parameters, [[8.0, 1.5], [8.0, 1.0]], rtol=1e-6)
    assert batch.model.A.shape == (2, 1, 1)
    assert batch.history.shape == (2, 3)
    assert np.all(batch.certificate.certified)
    assert np.all(is_successful(batch.status))


class Spring(AbstractStructure):
    """A lightly damped spring of unknown frequency; its start rule fails close to 5 rad/s."""

    @property
    def parameter_names(self):
        return ("frequency",)

    def matrices(self, parameters):
        A = jnp.zeros((2, 2)).at[0, 1].set(1.0).at[1, 1].set(-0.2)
        A = A.at[1, 0].set(-(parameters[0] ** 2))
        return StateSpace(A, jnp.eye(2)[:, 1:], jnp.eye(2)[:1])

    def starts(self, key, count, black_box):
        frequency = jnp.max(jnp.abs(black_box.poles()))
        return jnp.full((count, 1), jnp.where(jnp.abs(frequency - 5.0) < 0.01, 1e4, frequency))


@pytest.mark.slow
def test_neighbours_replace_a_poor_minimum():
    structure, frequencies = Spring(), [4.9, 5.0, 5.1]
    boxes = [structure.matrices(jnp.array([f])) for f in frequencies]
    options = {"starts": 2, "key": KEY, "method": MATCH_ONLY}
    alone = restructure(boxes[1], structure, **options)
    assert alone.error_norm > 0.5
    along = restructure_along(boxes, structure, **options)
    found = [best.parameters[0] for best in along]
    np.testing.assert_allclose(found, frequencies, rtol=1e-6)


# --- faults


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"starts": 2}, "key: the start rule is random"),
        ({"starts": 0}, "starts: none left"),
        ({"starts": 0, "initial": [1.0]}, "initial: vectors of 2 parameters are needed"),
        ({"starts": 0, "initial": [np.nan, 1.0]}, "initial: it holds NaN"),
        ({"black_box": StateSpace(-np.eye(2), np.eye(2), np.eye(2))}, "1 outputs and 1 inputs"),
        ({"black_box": StateSpace([[np.nan]], [[1.0]], [[1.0]])}, "black_box: it holds NaN"),
        ({"black_box": StateSpace([[[-1.0]]], [[1.0]], [[1.0]])}, r"a batch of shape \(1,\)"),
        (
            {"black_box": StateSpace([[-0.5]], [[1.0]], [[1.0]], dt=0.1)},
            "no continuous-time model",
        ),
        ({"omega": [-1.0]}, "omega: frequencies from 0"),
        ({"omega": [[1.0]]}, "omega: frequencies from 0"),
        (
            {"black_box": FAST_LAG.discretise(0.1), "omega": [10.0, 40.0]},
            r"Nyquist frequency \(31.42",
        ),
    ],
)
def test_impossible_problems_are_refused(lag, options, message):
    arguments = {"black_box": FAST_LAG, "structure": lag, "initial": None} | options
    if "starts" not in options:
        arguments["key"] = KEY
    with pytest.raises(ValueError, match=message):
        restructure(**arguments)


@pytest.mark.parametrize(
    "options",
    [
        {"frequencies": 0},
        {"match_steps": 0},
        {"descent_steps": 0},
        {"passes": -1},
        {"bundle_steps": -1},
        {"tolerance": 0.5},
        {"log2_powers": ()},
    ],
)
def test_impossible_methods_are_refused(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        HinfMatching(**options)


# --- what the status says, and families of models


@pytest.mark.slow
def test_a_useless_match_and_an_unstable_black_box_are_not_called_successful():
    unstable = StateSpace([[0.0, 4.0], [-4.0, 0.04]], [[0.0], [1.0]], [[4.0, 0.0]])
    best = restructure(unstable, ONE_MODE, starts=8, key=KEY, method=MATCH_ONLY)
    assert best.status in (Status.poor_match, Status.l_infinity)
    if best.error_norm >= 100.0:
        assert best.status == Status.poor_match


@pytest.mark.slow
def test_modes_that_cross_keep_their_places():
    structure = ModalStructure(2, n_inputs=1, n_outputs=1)
    kappas = np.linspace(0.0, 1.0, 5)

    def exact(kappa):
        modes = [
            [np.log(10 + 6 * kappa), -3.0, 1.0, 0.2],
            [np.log(14 - 4 * kappa), -2.0, -2.0, 0.5],
        ]
        return np.concatenate(modes)

    black_boxes = [structure.matrices(jnp.asarray(exact(kappa))) for kappa in kappas]
    local = restructure_along(black_boxes, structure, starts=2, key=KEY, method=MATCH_ONLY)
    for kappa, found in zip(kappas, local, strict=True):
        np.testing.assert_allclose(found.parameters, exact(kappa), rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_the_number_of_a_failing_black_box_is_said():
    broken = StateSpace(TWO_MODES.A * np.nan, TWO_MODES.B, TWO_MODES.C)
    with pytest.raises(ValueError, match=r"black_boxes\[1\]: black_box"):
        restructure_along([TWO_MODES, broken], ONE_MODE, starts=2, key=KEY, method=MATCH_ONLY)
