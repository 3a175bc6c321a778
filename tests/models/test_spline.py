"""Spline bases against SciPy's splines."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicSpline, make_lsq_spline

from lpvid.models import Polynomial, Spline

KNOTS = np.array([10.0, 11.0, 13.0, 14.5, 18.0])
INSIDE = np.linspace(10.0, 18.0, 23)
RNG = np.random.default_rng(0)
VALUES = RNG.normal(size=5)


def test_natural_splines_hold_the_values_at_the_knots():
    basis = Spline().basis(KNOTS)
    assert basis.size == 5
    np.testing.assert_allclose(basis(KNOTS[:, None]), np.eye(5), atol=1e-12)
    expected = CubicSpline(KNOTS, VALUES, bc_type="natural")
    np.testing.assert_allclose(basis(INSIDE[:, None]) @ VALUES, expected(INSIDE), atol=1e-12)
    # Tangents beyond the ends.
    ends, out = np.array([10.0, 18.0]), np.array([7.0, 20.0])
    tangent = expected(ends) + expected(ends, 1) * (out - ends)
    np.testing.assert_allclose(basis(out[:, None]) @ VALUES, tangent, atol=1e-12)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_least_squares_with_free_ends_is_scipys(degree):
    y = np.sin(INSIDE)
    knots = np.concatenate([[10.0] * (degree + 1), [12.0, 15.0], [18.0] * (degree + 1)])
    expected = make_lsq_spline(INSIDE, y, knots, k=degree)(INSIDE)
    basis = Spline((10.0, 12.0, 15.0, 18.0), degree, natural=False).basis(INSIDE)
    functions = np.asarray(basis(INSIDE[:, None]))
    np.testing.assert_allclose(functions.sum(axis=1), 1.0, rtol=1e-12)
    found = functions @ np.linalg.lstsq(functions, y)[0]
    np.testing.assert_allclose(found, expected, atol=1e-10)


def test_several_variables_give_products():
    spline = Spline(((0.0, 1.0, 2.0), (5.0, 6.0)))
    points = RNG.uniform([-0.5, 4.5], [2.5, 6.5], size=(4, 2))
    first, second = Spline((0.0, 1.0, 2.0)).basis([0.0]), Spline((5.0, 6.0)).basis([0.0])
    expected = np.einsum("pa,pb->pab", first(points[:, :1]), second(points[:, 1:]))
    basis = spline.basis(points)
    assert basis.size == 6
    np.testing.assert_allclose(basis(points), expected.reshape(4, 6), atol=1e-12)


def test_derivatives_are_those_of_finite_differences():
    basis = Spline().basis(KNOTS)
    values = jax.jit(lambda k: jnp.sum(basis(k) @ VALUES))
    for kappa in (9.0, 10.0, 12.3, 14.5, 19.0):
        point, step = jnp.array([kappa]), 1e-6
        slope = jax.jit(jax.grad(values))(point)[0]
        numeric = (values(point + step) - values(point - step)) / (2 * step)
        np.testing.assert_allclose(slope, numeric, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Spline((1.0,)), "two or more rising"),
        (lambda: Spline((1.0, 1.0)), "two or more rising"),
        (lambda: Spline(degree=2), "natural spline is cubic"),
        (lambda: Spline(degree=0, natural=False), "natural=False"),
        (lambda: Spline((0.0, 1.0)).basis([[0.0, 1.0]]), "each of 2 scheduling"),
        (lambda: Spline().basis([1.0, 1.0]), "knots: two or more are needed"),
        (lambda: Polynomial("auto").basis([1.0, 2.0]), "degree: 'auto' is chosen"),
    ],
)
def test_impossible_splines_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
