"""Eigenvalue clips and least squares on the cone against SciPy on Cholesky factors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from lpvid.identify.gray_box._cone import (
    definite_least_squares,
    nearest_semidefinite,
    symmetric_basis,
)

nearest = jax.jit(nearest_semidefinite)
fit = jax.jit(definite_least_squares, static_argnums=(2, 3))


def scipy_minimum(cost, n, starts=4):
    """Smallest cost over X = L Lᵀ by SLSQP from several starts."""
    rows, columns = np.tril_indices(n)

    def of_factor(entries):
        L = np.zeros((n, n))
        L[rows, columns] = entries
        return cost(L @ L.T)

    rng = np.random.default_rng(0)
    found = [
        scipy.optimize.minimize(
            of_factor,
            rng.standard_normal(rows.size),
            method="SLSQP",
            options={"ftol": 1e-14, "maxiter": 2000},
        ).fun
        for _ in range(starts)
    ]
    return min(found)


@pytest.mark.parametrize("n", [2, 3])
def test_clip_is_the_nearest_semidefinite_matrix(n):
    matrix = np.random.default_rng(n).standard_normal((n, n))

    def cost(X):
        return np.sum((X - matrix) ** 2)

    found, clipped = nearest(jnp.asarray(matrix))
    found = np.asarray(found)
    assert bool(clipped)
    assert np.linalg.eigvalsh(found).min() >= -1e-12
    np.testing.assert_allclose(cost(found), scipy_minimum(cost, n), rtol=1e-6)


def test_clip_leaves_a_definite_matrix_alone():
    matrix = jnp.array([[2.0, 1.0], [0.5, 3.0]])
    found, clipped = nearest(matrix)
    assert not bool(clipped)
    np.testing.assert_array_equal(found, [[2.0, 0.75], [0.75, 3.0]])


@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize("definite", [True, False])
def test_least_squares_on_the_cone(n, definite):
    rng = np.random.default_rng(10 * n)
    basis = symmetric_basis(n)
    # Entries of quite different weight, as those of a light and a heavy axis.
    root = rng.standard_normal((3 * len(basis), len(basis))) * np.geomspace(1, 30, len(basis))
    target = np.eye(n) * (2.0 if definite else 0.2)
    target[0, 1] = target[1, 0] = 1.0
    theta = np.einsum("kij,ij->k", basis, target)
    matrix, right = root.T @ root, root.T @ root @ theta

    def cost(X):
        entries = np.einsum("kij,ij->k", basis, X)
        return np.sum((root @ (entries - theta)) ** 2)

    found, active = fit(jnp.asarray(matrix), jnp.asarray(right), n, 1e-9)
    found = np.asarray(found)
    assert bool(active) != definite
    np.testing.assert_allclose(found, found.T, atol=1e-14)
    assert np.linalg.eigvalsh(found).min() > 0.0
    if definite:
        np.testing.assert_allclose(found, target, atol=1e-9)
    else:
        # The floor keeps the matrix a little inside the cone.
        np.testing.assert_allclose(cost(found), scipy_minimum(cost, n), rtol=1e-5)
