import jax.numpy as jnp
import numpy as np
import pytest

from lpvid.identify._realise import left_range, move_inside, realise, spectral_radius

from .helpers import sorted_poles, three_modes


@pytest.mark.parametrize("squared", [True, False])
def test_range_is_that_of_the_singular_vectors(squared):
    matrix = np.random.default_rng(0).standard_normal((5, 9))
    U, s, _ = np.linalg.svd(matrix)
    vectors, values = left_range(jnp.asarray(matrix), squared=squared)
    np.testing.assert_allclose(values, s, rtol=1e-10)
    np.testing.assert_allclose(np.abs(U.T @ np.asarray(vectors)), np.eye(5), atol=1e-9)


def test_narrow_matrices_get_zero_singular_values():
    matrix = jnp.asarray(np.random.default_rng(1).standard_normal((5, 2)))
    assert left_range(matrix, squared=False)[1][2:].tolist() == [0.0, 0.0, 0.0]


def test_shift_gives_back_the_system():
    A, _, C, _ = three_modes()
    observability = np.concatenate([C @ np.linalg.matrix_power(A, i) for i in range(6)])
    A_hat, C_hat = realise(jnp.asarray(observability), 2)
    np.testing.assert_allclose(A_hat, A, atol=1e-11)
    np.testing.assert_allclose(C_hat, C)


@pytest.mark.parametrize(
    "A",
    [
        three_modes()[0],
        np.array([[1.0, 1.0], [0.0, 1.0]]),
        np.array([[0.0, 1.0], [0.0, 0.0]]),
        np.zeros((3, 3)),
        1.00002 * np.eye(2),
        30.0 * np.random.default_rng(2).standard_normal((8, 8)),
    ],
)
def test_spectral_radius(A):
    radius = spectral_radius(jnp.asarray(A))
    np.testing.assert_allclose(radius, np.abs(np.linalg.eigvals(A)).max(), rtol=3e-8)


def test_spectral_radius_of_nonsense_is_nonsense():
    assert np.isnan(spectral_radius(jnp.full((2, 2), jnp.nan)))


def test_only_eigenvalues_outside_are_moved_and_only_their_modulus():
    rng = np.random.default_rng(5)
    basis = rng.standard_normal((3, 3))
    block = 1.00002 * np.array([[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]])
    core = np.block([[block, np.zeros((2, 1))], [np.zeros((1, 2)), 0.5 * np.ones((1, 1))]])
    moved, count = move_inside(jnp.asarray(basis @ core @ np.linalg.inv(basis)), 0.9999)
    expected = np.sort_complex([0.5, 0.9999 * np.exp(0.3j), 0.9999 * np.exp(-0.3j)])
    np.testing.assert_allclose(sorted_poles(moved), expected, atol=1e-12)
    assert int(count) == 2
    inside = jnp.asarray(three_modes()[0])
    unmoved, none = move_inside(inside, 0.9999)
    np.testing.assert_array_equal(unmoved, inside)
    assert int(none) == 0
