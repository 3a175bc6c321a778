"""B, D and x0 of every record from their normal equations."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Float

from lpvid.identify._simulation_error import NormalEquations


class LinearFit(eqx.Module):
    """What is linear in the simulation error once A and C are known.

    Attributes:
        B: input matrix.
        D: feedthrough.
        x0: initial state of every record.
        residual: sum of squares of each output's simulation error.
    """

    B: Float[Array, "nx nu"]
    D: Float[Array, "ny nu"]
    x0: Float[Array, "record nx"]
    residual: Float[Array, " ny"]


def solve(equations: NormalEquations, *, nx: int, feedthrough: bool) -> LinearFit:
    """Least squares for B and D, one x0 for each record.

    Args:
        equations: normal equations of every record.
        nx: number of states.
        feedthrough: whether D is estimated; zero otherwise.
    """
    records, ny, entries = equations.right.shape
    nu = entries // (nx + 1) - 1
    place = jnp.asarray(placement(nx, nu, ny, feedthrough))
    matrix = jnp.einsum("kea,rkef,kfb->rab", place, equations.matrix, place)
    right = jnp.einsum("kea,rke->ra", place, equations.right)
    if records == 1:
        theta = solve_positive(matrix[0], right[0][:, None])[:, 0]
        unknowns = theta[None]
    else:
        unknowns = _eliminate_starts(matrix, right, nx)
        theta = unknowns[0]
    D = theta[nu * nx : -nx].reshape(ny, nu) if feedthrough else jnp.zeros((ny, nu))
    of_output = jnp.einsum("kea,ra->rke", place, unknowns)
    explained = jnp.einsum("rkef,rkf->rke", equations.matrix, of_output) - 2.0 * equations.right
    residual = jnp.sum(of_output * explained, axis=(0, 2)) + jnp.sum(equations.power, axis=0)
    return LinearFit(
        B=theta[: nu * nx].reshape(nu, nx).T,
        D=D,
        x0=unknowns[:, -nx:],
        # Rounding may leave a little less than nothing.
        residual=jnp.maximum(residual, 0.0),
    )


def placement(nx: int, nu: int, ny: int, feedthrough: bool) -> np.ndarray:
    """Zeros and ones from the unknowns [B, D, x0] to the entries of each output's equations."""
    n_b, n_d = nu * nx, ny * nu if feedthrough else 0
    place = np.zeros((ny, nu + 1, nx + 1, n_b + n_d + nx))
    states = np.arange(nx)
    for j in range(nu):
        place[:, j, states, j * nx + states] = 1.0
    place[:, nu, states, n_b + n_d + states] = 1.0
    if feedthrough:
        k, j = np.arange(ny)[:, None], np.arange(nu)[None, :]
        place[k, j, nx, n_b + k * nu + j] = 1.0
    return place.reshape(ny, (nu + 1) * (nx + 1), -1)


def _eliminate_starts(matrix: Array, right: Array, nx: int) -> Array:
    """Unknowns of every record, `(record, unknown)`, those before the last nx common to all."""

    def reduce(one):
        square, value = one
        coupling = square[-nx:, :-nx]
        known = jnp.concatenate([coupling, value[-nx:, None]], axis=1)
        solved = solve_positive(square[-nx:, -nx:], known)
        return (
            square[:-nx, :-nx] - coupling.T @ solved[:, :-1],
            (value[:-nx] - coupling.T @ solved[:, -1]),
            solved,
        )

    normal, rhs, solved = jax.lax.map(reduce, (matrix, right))
    shared = solve_positive(jnp.sum(normal, axis=0), jnp.sum(rhs, axis=0)[:, None])[:, 0]
    starts = solved[..., -1] - solved[..., :-1] @ shared
    common = jnp.broadcast_to(shared[None], (starts.shape[0], shared.shape[0]))
    return jnp.concatenate([common, starts], axis=1)


def solve_positive(
    matrix: Float[Array, "row row"], right: Float[Array, "row column"]
) -> Float[Array, "row column"]:
    """Solve a symmetric positive definite system; the least-norm solution where it is singular."""
    diagonal = jnp.diagonal(matrix)
    scale = jnp.where(diagonal > 0.0, jax.lax.rsqrt(jnp.where(diagonal > 0.0, diagonal, 1.0)), 0.0)
    scaled = matrix * scale[:, None] * scale[None, :]
    scaled_right = right * scale[:, None]
    factor = jax.lax.linalg.cholesky(scaled, symmetrize_input=False)

    def least_norm():
        values, vectors = jnp.linalg.eigh(scaled, symmetrize_input=False)
        kept = values > values[-1] * scaled.shape[0] * jnp.finfo(float).eps
        inverse = jnp.where(kept, 1.0 / jnp.where(kept, values, 1.0), 0.0)
        return vectors @ (inverse[:, None] * (vectors.T @ scaled_right))

    solution = jax.lax.cond(
        jnp.all(jnp.isfinite(jnp.diagonal(factor))),
        lambda: cho_solve((factor, True), scaled_right),
        least_norm,
    )
    return solution * scale[:, None]
