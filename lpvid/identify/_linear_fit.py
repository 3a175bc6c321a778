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
        offset: constant of each output, zero where none is estimated.
        residual: sum of squares of each output's simulation error.
    """

    B: Float[Array, "nx nu"]
    D: Float[Array, "ny nu"]
    x0: Float[Array, "record nx"]
    offset: Float[Array, " ny"]
    residual: Float[Array, " ny"]


class LinearCovariance(eqx.Module):
    """Covariance of the linear unknowns.

    Attributes:
        shared: of the columns of B, the rows of D, the offsets, (unknown, unknown).
        x0: of every record's initial state.
    """

    shared: Float[Array, "unknown unknown"]
    x0: Float[Array, "record nx nx"]


def solve(
    equations: NormalEquations, *, nx: int, feedthrough: bool, offset: bool = False
) -> LinearFit:
    """Least squares for B and D, one x0 for each record.

    Args:
        equations: normal equations of every record.
        nx: number of states.
        feedthrough: whether D is estimated; zero otherwise.
        offset: whether the last input is a row of ones, whose entries in D are the offsets.
    """
    records, ny, entries = equations.right.shape
    nu = entries // (nx + 1) - 1 - offset
    place = jnp.asarray(placement(nx, nu, ny, feedthrough, offset))
    matrix = jnp.einsum("kea,rkef,kfb->rab", place, equations.matrix, place)
    right = jnp.einsum("kea,rke->ra", place, equations.right)
    if records == 1:
        theta = solve_positive(matrix[0], right[0][:, None])[:, 0]
        unknowns = theta[None]
    else:
        unknowns = _eliminate_starts(matrix, right, nx)
        theta = unknowns[0]
    n_d = ny * nu if feedthrough else 0
    D = theta[nu * nx :][:n_d].reshape(ny, nu) if feedthrough else jnp.zeros((ny, nu))
    constant = theta[nu * nx + n_d :][:ny] if offset else jnp.zeros(ny)
    of_output = jnp.einsum("kea,ra->rke", place, unknowns)
    explained = jnp.einsum("rkef,rkf->rke", equations.matrix, of_output) - 2.0 * equations.right
    residual = jnp.sum(of_output * explained, axis=(0, 2)) + jnp.sum(equations.power, axis=0)
    return LinearFit(
        B=theta[: nu * nx].reshape(nu, nx).T,
        D=D,
        x0=unknowns[:, -nx:],
        offset=constant,
        # Rounding may leave a little less than nothing.
        residual=jnp.maximum(residual, 0.0),
    )


def placement(nx: int, nu: int, ny: int, feedthrough: bool, offset: bool = False) -> np.ndarray:
    """Zeros and ones from the unknowns [B, D, offset, x0] to the entries of each output."""
    n_b, n_d = nu * nx, ny * nu if feedthrough else 0
    shared = n_b + n_d + (ny if offset else 0)
    place = np.zeros((ny, nu + offset + 1, nx + 1, shared + nx))
    states, k = np.arange(nx), np.arange(ny)
    for j in range(nu):
        place[:, j, states, j * nx + states] = 1.0
    place[:, nu + offset, states, shared + states] = 1.0
    if feedthrough:
        j = np.arange(nu)[None, :]
        place[k[:, None], j, nx, n_b + k[:, None] * nu + j] = 1.0
    if offset:
        place[k, nu, nx, n_b + n_d + k] = 1.0
    return place.reshape(ny, (nu + offset + 1) * (nx + 1), -1)


def covariance(
    matrix: Float[Array, "record ny entry entry"],
    variance: Float[Array, " ny"],
    *,
    nx: int,
    feedthrough: bool,
    offset: bool,
) -> LinearCovariance:
    """Covariance of the least-squares solution for white noise, independent between outputs.

    Args:
        matrix: of the normal equations of every record.
        variance: of each output's noise.
        nx: number of states.
        feedthrough: as for `solve`.
        offset: as for `solve`.
    """
    ny, entries = matrix.shape[1:3]
    place = jnp.asarray(placement(nx, entries // (nx + 1) - 1 - offset, ny, feedthrough, offset))
    n_shared = place.shape[2] - nx

    def contracted(one, weights):
        return jnp.einsum("kea,kef,kfb,k->ab", place, one, place, weights)

    def reduce(one):
        information = contracted(one, jnp.ones(ny))
        spread = contracted(one, variance)
        identity = jnp.eye(nx)
        inverse = solve_positive(information[n_shared:, n_shared:], identity)
        # What is left of a record's scores for the shared unknowns once its x0 is solved for.
        coupling = information[n_shared:, :n_shared]
        left = jnp.concatenate([jnp.eye(n_shared), -coupling.T @ inverse], axis=1)
        normal = information[:n_shared, :n_shared] - coupling.T @ inverse @ coupling
        return (
            normal,
            left @ spread @ left.T,
            left @ spread[:, n_shared:],
            coupling,
            inverse,
            spread,
        )

    normal, spread, cross, coupling, inverse, whole = jax.lax.map(reduce, matrix)
    bread = solve_positive(jnp.sum(normal, axis=0), jnp.eye(n_shared))
    shared = bread @ jnp.sum(spread, axis=0) @ bread

    def start(one):
        cross, coupling, inverse, whole = one
        mixed = coupling @ bread @ cross
        middle = whole[n_shared:, n_shared:] - mixed - mixed.T + coupling @ shared @ coupling.T
        return inverse @ middle @ inverse

    return LinearCovariance(shared, jax.lax.map(start, (cross, coupling, inverse, whole)))


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
