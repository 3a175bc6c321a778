"""Symmetric positive (semi)definite matrices: the nearest one, and least squares over them."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

_MOST_STEPS = 20_000
_TOLERANCE = 1e-13


def nearest_semidefinite(
    matrix: Float[Array, "n n"], floor: float = 0.0
) -> tuple[Float[Array, "n n"], Bool[Array, ""]]:
    """The symmetric matrix nearest in the Frobenius norm whose eigenvalues are not below a floor.

    It is the symmetric part with its eigenvalues clipped, so no solver is needed for equations 23
    and 24 of 000.

    Args:
        matrix: square matrix.
        floor: smallest eigenvalue allowed, as a share of the largest one's size.

    Returns:
        The matrix, and whether an eigenvalue had to be clipped.
    """
    symmetric = 0.5 * (matrix + matrix.T)
    values, vectors = jnp.linalg.eigh(symmetric)
    least = floor * jnp.max(jnp.abs(values))
    clipped = (vectors * jnp.maximum(values, least)[None, :]) @ vectors.T
    met = jnp.any(values < least)
    return jnp.where(met, 0.5 * (clipped + clipped.T), symmetric), met


def symmetric_basis(n: int) -> Float[np.ndarray, "entry n n"]:
    """Orthonormal basis of the symmetric matrices, so that projections keep their meaning."""
    rows, columns = np.tril_indices(n)
    basis = np.zeros((rows.size, n, n))
    weight = np.where(rows == columns, 0.5, np.sqrt(0.5))
    entry = np.arange(rows.size)
    np.add.at(basis, (entry, rows, columns), weight)
    np.add.at(basis, (entry, columns, rows), weight)
    return basis


def definite_least_squares(
    matrix: Float[Array, "entry entry"], right: Float[Array, " entry"], n: int, floor: float
) -> tuple[Float[Array, "n n"], Bool[Array, ""]]:
    """Minimise ½ θᵀ H θ − gᵀ θ over X = Σ θ_k E_k symmetric positive definite.

    Nesterov's accelerated projected gradient with restarts; the projection is an eigenvalue clip.
    Where the solution without the constraint is positive definite it is returned as it is.

    Args:
        matrix: H, positive definite, in the coordinates of `symmetric_basis`.
        right: g.
        n: rows of X.
        floor: smallest eigenvalue of X, as a share of the largest of the unconstrained solution.

    Returns:
        X, and whether the constraint was active.
    """
    basis = jnp.asarray(symmetric_basis(n))
    free = jnp.linalg.solve(matrix, right)
    values = jnp.linalg.eigvalsh(jnp.einsum("k,kij->ij", free, basis))
    least = floor * jnp.max(jnp.abs(values))
    step = 1.0 / jnp.linalg.norm(matrix, 2)

    def project(theta):
        values, vectors = jnp.linalg.eigh(jnp.einsum("k,kij->ij", theta, basis))
        clipped = (vectors * jnp.maximum(values, least)[None, :]) @ vectors.T
        return jnp.einsum("kij,ij->k", basis, clipped)

    def advance(carry):
        theta, ahead, momentum, _, count = carry
        new = project(ahead - step * (matrix @ ahead - right))
        change = new - theta
        # Momentum that points uphill is dropped.
        uphill = jnp.sum((ahead - new) * change) > 0.0
        momentum = jnp.where(uphill, 1.0, momentum)
        following = 0.5 * (1.0 + jnp.sqrt(1.0 + 4.0 * momentum**2))
        ahead = new + jnp.where(uphill, 0.0, (momentum - 1.0) / following) * change
        moved = jnp.linalg.norm(change) / jnp.maximum(jnp.linalg.norm(new), 1e-300)
        return new, ahead, following, moved, count + 1

    def unfinished(carry):
        return (carry[3] > _TOLERANCE) & (carry[4] < _MOST_STEPS)

    active = values[0] < least
    start = project(free)
    # Nothing to do where the free solution is allowed.
    distance = jnp.where(active, jnp.inf, 0.0)
    solved = jax.lax.while_loop(
        unfinished, advance, (start, start, jnp.asarray(1.0), distance, jnp.asarray(0))
    )[0]
    return jnp.einsum("k,kij->ij", jnp.where(active, solved, free), basis), active
