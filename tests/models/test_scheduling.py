"""Polynomial bases against NumPy's own polynomials."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpvid.models import Polynomial, polynomial_basis


def test_one_variable_gives_the_powers():
    basis = polynomial_basis([[1.0], [2.0], [5.0]], 3)
    kappa = np.linspace(0.0, 6.0, 7)
    scaled = (kappa - 3.0) / 2.0
    expected = np.polynomial.polynomial.polyvander(scaled, 3)
    np.testing.assert_allclose(basis(kappa[:, None]), expected, rtol=1e-12)
    assert basis.size == 4


def test_two_variables_give_all_monomials_up_to_the_total_degree():
    points = np.array([[0.0, -1.0], [2.0, 3.0], [1.0, 0.0]])
    basis = polynomial_basis(points, 2)
    assert basis.exponents == ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    kappa = np.random.default_rng(0).uniform(-2, 3, size=(4, 5, 2))
    x, y = kappa[..., 0] - 1.0, (kappa[..., 1] - 1.0) / 2.0
    expected = np.stack([np.ones_like(x), x, y, x**2, x * y, y**2], axis=-1)
    np.testing.assert_allclose(basis(kappa), expected, rtol=1e-12, atol=1e-12)


def test_a_variable_that_does_not_vary_is_left_unscaled():
    basis = polynomial_basis([[0.0, 4.0], [1.0, 4.0]], 1)
    np.testing.assert_allclose(basis([0.5, 4.5]), [1.0, 0.0, 0.5])


def test_one_axis_of_points_is_one_variable():
    assert polynomial_basis([0.0, 1.0], 1).exponents == ((0,), (1,))


def test_values_and_derivatives_at_the_centre_are_finite():
    basis = polynomial_basis([0.0, 2.0], 3)
    slope = jax.jacfwd(lambda kappa: basis(kappa))(jnp.array([1.0]))
    np.testing.assert_allclose(slope[:, 0], [0.0, 1.0, 0.0, 0.0])


@pytest.mark.parametrize("degree", [-1, "best"])
def test_impossible_degrees_are_refused(degree):
    with pytest.raises(ValueError, match="degree: a whole number"):
        Polynomial(degree=degree)
