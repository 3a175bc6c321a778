"""Interpolation: exact on polynomials, honest about what the points cannot tell."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpvid._results import Status
from lpvid.analysis import parameter_fit
from lpvid.interpolate import (
    interpolate,
    interpolate_balanced,
    interpolation_fit,
    leave_one_out,
)
from lpvid.models import FreeStructure, ModalStructure, Polynomial, StateSpace
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
        (LOCAL[:2], KAPPAS[:2], {}, "degree: 2 needs 3 distinct points"),
        (LOCAL[:3], [0.0, 0.0, 1.0], {}, "degree: 2 needs 3 distinct points"),
        (FREE, [[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]], {"method": Polynomial(1)}, "not all on"),
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
        ([m.discretise(0.1) for m in FREE], [0, 1, 2], {}, "continuous-time models"),
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
