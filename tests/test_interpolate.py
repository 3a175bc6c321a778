"""Interpolation: exact on polynomials, honest about what the points cannot tell."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from lpvid._results import Status
from lpvid.analysis import parameter_fit
from lpvid.interpolate import (
    interpolate,
    interpolate_balanced,
    interpolation_fit,
    leave_one_out,
    left_out_error,
)
from lpvid.interpolate._leave_one_out import left_out
from lpvid.models import (
    FreeStructure,
    ModalStructure,
    Polynomial,
    Spline,
    StateSpace,
    StructuredModel,
)
from lpvid.restructure import Restructured

KAPPAS = np.linspace(-1.0, 2.0, 7)
STRUCTURE = ModalStructure(2, n_inputs=1, n_outputs=2)
RNG = np.random.default_rng(0)


def restructured(structure, parameters):
    """A result that says so, without a search."""
    nothing = jnp.zeros(())
    return Restructured(
        structure=structure,
        parameters=jnp.asarray(parameters),
        error_norm=nothing,
        peak_frequency=nothing,
        match_costs=jnp.zeros(1),
        hits=jnp.asarray(1),
        margin=nothing,
        history=jnp.zeros(1),
        status=Status.successful,
    )


def polynomial(degree, seed=1):
    """ϑ(κ) as a function, frequencies and dampings in a sensible range."""
    rng = np.random.default_rng(seed)
    coefficients = 0.4 * rng.normal(size=(degree + 1, STRUCTURE.n_parameters))
    coefficients[0, [0, 6]] += np.log([20.0, 80.0])
    coefficients[0, [1, 7]] += np.log(0.05)
    return lambda kappa: np.polynomial.polynomial.polyval(np.asarray(kappa), coefficients).T


QUADRATIC = polynomial(2)
LOCAL = [restructured(STRUCTURE, row) for row in QUADRATIC(KAPPAS)]


def test_a_polynomial_is_recovered_between_and_at_the_points():
    lpv = interpolate(LOCAL, KAPPAS, Polynomial(degree=2))
    between = np.linspace(-1.0, 2.0, 20)
    np.testing.assert_allclose(lpv.parameters(between), QUADRATIC(between), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(lpv.at(0.3).A, STRUCTURE.matrices(jnp.asarray(QUADRATIC(0.3))).A)
    np.testing.assert_array_equal([lpv.kappa_low[0], lpv.kappa_high[0]], [-1.0, 2.0])
    np.testing.assert_allclose(interpolation_fit(lpv, LOCAL, KAPPAS), 100.0, atol=1e-6)


def test_too_low_a_degree_is_numpys_least_squares():
    lpv = interpolate(LOCAL, KAPPAS, Polynomial(degree=1))
    expected = np.polynomial.polynomial.polyfit(KAPPAS, QUADRATIC(KAPPAS), 1)
    fitted = np.polynomial.polynomial.polyval(KAPPAS, expected).T
    np.testing.assert_allclose(lpv.parameters(KAPPAS), fitted, rtol=1e-9, atol=1e-9)


def test_interpolation_fit_is_equation_36():
    lpv = interpolate(LOCAL, KAPPAS, Polynomial(degree=1))
    entries = [[], []]
    for kappa, best in zip(KAPPAS, LOCAL, strict=True):
        for rows, model in zip(entries, (best.model, lpv.at(kappa)), strict=True):
            rows.append(np.concatenate([np.ravel(model.A), np.ravel(model.B)]))
    expected = parameter_fit(np.ravel(entries[0]), np.ravel(entries[1]))
    np.testing.assert_allclose(interpolation_fit(lpv, LOCAL, KAPPAS), expected, rtol=1e-9)
    assert 10.0 < expected < 99.9


def test_state_space_models_are_interpolated_entry_by_entry():
    A0, A1 = RNG.normal(size=(2, 3, 3))
    models = [StateSpace(A0 + k * A1, np.ones((3, 1)), np.eye(3)[:1]) for k in KAPPAS]
    lpv = interpolate(models, KAPPAS, Polynomial(degree=1))
    assert isinstance(lpv.structure, FreeStructure)
    np.testing.assert_allclose(lpv.at(0.77).A, A0 + 0.77 * A1, atol=1e-12)


def test_several_scheduling_variables():
    points = RNG.uniform(-1, 1, size=(12, 2))
    base, slope_x, slope_y, mixed = 0.3 * RNG.normal(size=(4, 9))

    def truth(x, y):
        return base + x * slope_x + y * slope_y + x * y * mixed

    structure = FreeStructure(2, 1, 1)
    models = [structure.matrices(jnp.asarray(truth(*point))) for point in points]
    lpv = interpolate(models, points, Polynomial(degree=2))
    inside = np.array([0.2, -0.1])
    np.testing.assert_allclose(lpv.parameters(inside), truth(*inside), atol=1e-10)


def test_weights_tell_which_points_to_trust():
    rows = QUADRATIC(KAPPAS)
    rows[3] += 1.0
    local = [restructured(STRUCTURE, row) for row in rows]
    weights = np.ones(7)
    weights[3] = 0.04
    lpv = interpolate(local, KAPPAS, Polynomial(degree=2), weights=weights)
    expected = np.polynomial.polynomial.polyfit(KAPPAS, rows, 2, w=np.sqrt(weights))
    fitted = np.polynomial.polynomial.polyval(KAPPAS, expected).T
    np.testing.assert_allclose(lpv.parameters(KAPPAS), fitted, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_leaving_one_out_finds_the_degree(degree):
    rows = polynomial(degree, seed=4)(KAPPAS) + np.zeros((7, STRUCTURE.n_parameters))
    local = [restructured(STRUCTURE, row) for row in rows]
    errors = leave_one_out(local, KAPPAS)
    assert list(errors) == [0, 1, 2, 3, 4, 5]
    assert all(errors[d] < 1e-8 for d in range(degree, 6))
    assert all(errors[d] > 1e-2 for d in range(degree))
    # Higher degrees are as exact; there is no reason to take them.
    assert interpolate(local, KAPPAS, Polynomial("auto")).basis.size == degree + 1


def test_leaving_one_out_stops_at_degrees_that_the_rest_cannot_tell():
    assert list(leave_one_out(LOCAL[:4], KAPPAS[:4])) == [0, 1, 2]
    assert list(leave_one_out(LOCAL[:4], KAPPAS[:4], highest=1)) == [0, 1]


def covariances_of(count, width, seed=7):
    """Full covariances of parameters of very different sizes, one point far better known."""
    rng = np.random.default_rng(seed)
    factors = rng.normal(size=(count, width, width)) * 10.0 ** rng.uniform(-2, 2, size=width)
    factors[2] *= 1e-2
    return factors @ np.moveaxis(factors, 1, 2)


def test_full_covariances_give_generalised_least_squares():
    rows = RNG.normal(size=(7, 4))
    local = [StructuredModel(FreeStructure(1, 1, 1), row) for row in rows]
    covariances = covariances_of(7, 4)
    lpv = interpolate(local, KAPPAS, Polynomial(degree=2), covariances=covariances)
    design = np.kron(np.polynomial.polynomial.polyvander(KAPPAS, 2), np.eye(4))
    information = np.zeros((28, 28))
    for k in range(7):
        information[4 * k : 4 * k + 4, 4 * k : 4 * k + 4] = np.linalg.inv(covariances[k])
    normal = design.T @ information @ design
    expected = np.linalg.solve(normal, design.T @ information @ rows.reshape(-1)).reshape(3, 4)
    fitted = np.polynomial.polynomial.polyval(KAPPAS, expected).T
    np.testing.assert_allclose(lpv.parameters(KAPPAS), fitted, rtol=1e-6, atol=1e-8)


def test_equal_variances_and_fixed_parameters_count_as_without_weights():
    rows = RNG.normal(size=(7, 4))
    local = [StructuredModel(FreeStructure(1, 1, 1), row) for row in rows]
    # The third parameter was fixed everywhere, and not told by the records at one point.
    covariances = np.tile(np.diag([1e-4, 4.0, 0.0, 1e-10]), (7, 1, 1))
    found = interpolate(local, KAPPAS, Polynomial(1), covariances=list(covariances))
    expected = interpolate(local, KAPPAS, Polynomial(1))
    np.testing.assert_allclose(found.coefficients, expected.coefficients, rtol=1e-9, atol=1e-12)

    @jax.jit
    @jax.grad
    def slope(scale):
        lpv = interpolate(local, KAPPAS, Polynomial(1), covariances=scale * covariances)
        return jnp.sum(lpv.coefficients**2)

    # One factor for all changes nothing; repeated eigenvalues leave the derivative finite.
    np.testing.assert_allclose(slope(3.0), 0.0, atol=1e-9)


@pytest.mark.slow
def test_covariances_bring_the_curve_nearer_to_the_truth():
    """Points known to different precision: the weighted curve is better, in most of 20 draws."""
    covariances = 1e-4 * covariances_of(7, 4)
    factors = np.linalg.cholesky(covariances)
    truth = np.polynomial.polynomial.polyval(KAPPAS, RNG.normal(size=(3, 4))).T
    mean_square = np.zeros(2)
    for seed in range(20):
        noise = np.random.default_rng(seed).normal(size=(7, 4, 1))
        rows = truth + (factors @ noise)[..., 0]
        local = [StructuredModel(FreeStructure(1, 1, 1), row) for row in rows]
        for place, options in enumerate(({"covariances": covariances}, {})):
            lpv = interpolate(local, KAPPAS, Polynomial(2), **options)
            errors = np.asarray(lpv.parameters(KAPPAS)) - truth
            mean_square[place] += np.sum(errors**2 / covariances.mean(axis=0).diagonal())
    assert mean_square[0] < mean_square[1]


@pytest.mark.slow
def test_a_point_without_weight_neither_bends_nor_judges_the_curve():
    rows = polynomial(1, seed=4)(KAPPAS)
    rows[3] += 0.5
    local = [restructured(STRUCTURE, row) for row in rows]
    weights = np.ones(7)
    weights[3] = 1e-14
    errors = leave_one_out(local, KAPPAS, highest=2, weights=weights)
    assert errors[0] > 0.01 and errors[1] < 1e-5
    assert leave_one_out(local, KAPPAS, highest=1)[1] > 0.05
    covariances = 1e-6 * np.eye(12) / weights[:, None, None]
    errors = leave_one_out(local, KAPPAS, highest=2, covariances=covariances)
    assert errors[0] > 0.01 and errors[1] < 1e-4


def test_edges_of_a_grid_may_be_left_out_its_corners_not():
    grid = np.stack(np.meshgrid([0.0, 1.0, 2.0], [0.0, 1.0, 2.0]), axis=-1).reshape(9, 2)
    np.testing.assert_array_equal(left_out(grid), [1, 3, 4, 5, 7])
    np.testing.assert_array_equal(left_out(KAPPAS[:, None]), [1, 2, 3, 4, 5])


def test_splines_pass_through_the_points_and_follow_what_polynomials_cannot():
    rows = QUADRATIC(KAPPAS) + 0.3 * np.abs(KAPPAS)[:, None]
    local = [restructured(STRUCTURE, row) for row in rows]
    lpv = interpolate(local, KAPPAS, Spline())
    np.testing.assert_allclose(lpv.parameters(KAPPAS), rows, atol=1e-9)
    between = np.linspace(-1.0, 2.0, 20)
    expected = CubicSpline(KAPPAS, rows, bc_type="natural")(between)
    np.testing.assert_allclose(lpv.parameters(between), expected, atol=1e-9)
    error = left_out_error(local, KAPPAS, Spline())
    assert error < left_out_error(local, KAPPAS, Polynomial(1))
    with pytest.raises(ValueError, match="do not determine"):
        left_out_error(local, KAPPAS, Polynomial(6))


def test_discrete_models_give_a_discrete_model():
    models = [model.discretise(0.1) for model in FREE]
    lpv = interpolate(models, [0, 1, 2], Polynomial(2))
    assert lpv.dt == 0.1
    np.testing.assert_allclose(lpv.at(1.0).A, models[1].A, rtol=1e-12)
    u = RNG.normal(size=8)
    expected = models[1].simulate(u=u)
    np.testing.assert_allclose(lpv.simulate(u=u, kappa=np.ones(8)), expected, atol=1e-12)
    assert left_out_error(models, [0, 1, 2], Polynomial(1)) < 0.1


def test_the_hull_of_the_points_is_kept():
    points = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    lpv = interpolate(FREE, points, Polynomial(1))
    np.testing.assert_array_equal(lpv.is_inside([[0.3, 0.3], [0.9, 0.9]]), [True, False])


def balanced_family():
    """A family that has coherent balanced bases, seen through random ones."""
    models = []
    for seed, kappa in enumerate(KAPPAS):
        rate = np.array([1.0 + 0.2 * kappa, 6.0 + kappa])
        model = StateSpace(
            np.diag(-rate), [[2.0], [1.0 + 0.1 * kappa]], [[2.0, -0.5 * (1 + 0.1 * kappa)]]
        )
        T = np.random.default_rng(seed).normal(size=(2, 2)) + 2.0 * np.eye(2)
        models.append(model.transform(T))
    return models


def test_balanced_models_are_made_coherent_by_signs():
    models = balanced_family()
    lpv = interpolate_balanced(models, KAPPAS, Polynomial(degree=3))
    omega = np.geomspace(0.01, 100.0, 30)
    for kappa, model in zip(KAPPAS, models, strict=True):
        error = lpv.at(kappa).frequency_response(omega) - model.frequency_response(omega)
        assert np.abs(error).max() < 0.02 * np.abs(model.frequency_response(omega)).max()
    naive = interpolate(models, KAPPAS, Polynomial(degree=3))
    error = naive.at(0.0).frequency_response(omega) - models[2].frequency_response(omega)
    assert np.abs(error).max() > 0.05


def test_interpolation_is_differentiable():
    rows = jnp.asarray(QUADRATIC(KAPPAS))

    @jax.jit
    def middle(rows, weights):
        local = [eqx.tree_at(lambda m: m.parameters, LOCAL[i], rows[i]) for i in range(7)]
        lpv = interpolate(local, KAPPAS, Polynomial(degree=1), weights=weights)
        return jnp.sum(lpv.at(0.2).A ** 2)

    arguments = rows, jnp.linspace(1.0, 2.0, 7)
    gradients = jax.grad(middle, argnums=(0, 1))(*arguments)
    for index, gradient in enumerate(gradients):
        direction = RNG.normal(size=gradient.shape)
        ahead, behind = (
            middle(
                *(a + s * 1e-6 * direction if i == index else a for i, a in enumerate(arguments))
            )
            for s in (1.0, -1.0)
        )
        np.testing.assert_allclose(np.sum(gradient * direction), (ahead - behind) / 2e-6, rtol=1e-5)


FREE = [StateSpace(-np.eye(1) * k, np.ones((1, 1)), np.ones((1, 1))) for k in (1.0, 2.0, 3.0)]


@pytest.mark.parametrize(
    ("models", "kappas", "options", "message"),
    [
        ([], [], {}, "models: none given"),
        (LOCAL, KAPPAS[:-1], {}, "kappas: one row for each of the 7 models"),
        (LOCAL[:2], KAPPAS[:2], {}, "has 3 functions"),
        (LOCAL[:3], [0.0, 0.0, 1.0], {}, "has 3 functions"),
        (FREE, [[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]], {"method": Polynomial(1)}, "all on one curve"),
        (LOCAL, KAPPAS, {"weights": np.zeros(7)}, "weights: 7 positive numbers"),
        (LOCAL, KAPPAS, {"weights": np.ones(6)}, "weights: 7 positive numbers"),
        ([*FREE, LOCAL[0]], KAPPAS[:4], {}, "do not mix"),
        (
            [LOCAL[0], restructured(FreeStructure(2, 1, 1), np.ones(9))],
            [0, 1],
            {},
            "same structure",
        ),
        (
            [*FREE[:2], StateSpace(-np.eye(2), np.ones((2, 1)), np.ones((1, 2)))],
            [0, 1, 2],
            {},
            "of one size",
        ),
        ([*FREE[:2], FREE[2].discretise(0.1)], [0, 1, 2], {}, "of one size and sample time"),
        (FREE, [0, 1, 2], {"weights": np.ones(3), "covariances": np.ones((3, 4, 4))}, "not both"),
        (FREE, [0, 1, 2], {"covariances": np.ones((3, 3, 3))}, r"covariances: one of shape \(4, 4"),
        (FREE, [0, 1, 2], {"covariances": -np.eye(4) * np.ones((3, 1, 1))}, "point 0 is not fin"),
        (FREE, [0, 1, 2], {"method": Spline((0.0, 0.5, 1.0, 2.0))}, "has 4 functions"),
        (
            [LOCAL[0], restructured(STRUCTURE, np.full(12, np.nan)), LOCAL[2]],
            [0, 1, 2],
            {},
            r"point\(s\) \[1\]",
        ),
    ],
)
def test_impossible_interpolations_are_refused(models, kappas, options, message):
    with pytest.raises(ValueError, match=message):
        interpolate(models, kappas, **options)


def test_one_point_cannot_be_left_out():
    with pytest.raises(ValueError, match="at least two points"):
        leave_one_out(LOCAL[:1], KAPPAS[:1])


def test_unstable_models_have_no_balanced_form():
    with pytest.raises(ValueError, match=r"point\(s\) \[0\]"):
        interpolate_balanced([StateSpace([[1.0]], [[1.0]], [[1.0]]), *FREE], [0, 1, 2, 3])


def test_integrators_are_judged_where_their_response_is_finite():
    models = [StateSpace([[0.0]], [[k]], [[1.0]]) for k in (1.0, 2.0, 3.0, 4.0)]
    errors = leave_one_out(models, [1.0, 2.0, 3.0, 4.0])
    assert all(np.isfinite(error) for error in errors.values())
    assert errors[1] < 1e-9 < errors[0]


def test_points_that_are_no_numbers_are_refused():
    models = [StateSpace([[-k]], [[1.0]], [[1.0]]) for k in (1.0, 2.0)]
    with pytest.raises(ValueError, match="NaN or infinity among"):
        interpolate(models, [0.0, np.nan], Polynomial(degree=1))
