"""The lifted (blocked) simulation of constant discrete-time matrices."""

import math
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lpvid._linalg import batched


def matrix_powers(
    matrix: Float[Array, "nx nx"], count: int
) -> tuple[Float[Array, "count nx nx"], Float[Array, "nx nx"]]:
    """The powers 0 … count − 1 of a square matrix, and the power `count`, by doubling.

    Args:
        matrix: square matrix.
        count: number of powers, at least one.
    """
    powers = jnp.eye(matrix.shape[0], dtype=matrix.dtype)[None]
    square = matrix
    while 2 * powers.shape[0] <= count:
        powers = jnp.concatenate([powers, powers @ square])
        square = square @ square
    missing = count - powers.shape[0]
    if missing:
        powers = jnp.concatenate([powers, powers[:missing] @ square])
    return powers, powers[-1] @ matrix


def block_toeplitz(
    blocks: Float[Array, "count ny nu"],
) -> Float[Array, "count ny count nu"]:
    """Lower block-triangular Toeplitz matrix of a response: entry [i, :, j, :] is block i − j.

    Built by repeating and reshaping one row: a gather would cost a scatter in reverse mode.
    """
    count, ny, nu = blocks.shape
    row = jnp.concatenate([blocks, jnp.zeros((count, ny, nu), blocks.dtype)])
    repeated = jnp.broadcast_to(row[None], (count, 2 * count, ny, nu))
    # Rows of length 2L, read again with length 2L − 1, move one step to the right each.
    repeated = repeated.reshape(2 * count * count, ny, nu)[: count * (2 * count - 1)]
    columns = repeated.reshape(count, 2 * count - 1, ny, nu)[:, :count]
    return columns.transpose(1, 2, 0, 3)


def _boundary_states(
    transition: Float[Array, "nx nx"], forcing: Float[Array, "block nx"]
) -> Float[Array, "block nx"]:
    """All states of x⁺ = F x + w from x = 0, in log2(blocks) products (Kogge–Stone doubling)."""
    states, step = forcing, 1
    while step < states.shape[0]:
        carried = states[:-step] @ transition.T
        states = states + jnp.pad(carried, ((step, 0), (0, 0)))
        step *= 2
        if step < states.shape[0]:
            transition = transition @ transition
    return states


def default_block(n_samples: int, nx: int, nu: int, ny: int) -> int:
    """Block length of the lifted simulation, from the sizes alone."""
    # The Toeplitz product costs L·ny·nu a sample, the boundary states nx²·log2(N)/L: the cost is
    # flat around the best, measured at 16 to 32 for 6 states and 2 × 2 channels.
    best = round(6 * nx / math.sqrt(max(nu * ny, 1)))
    return max(1, min(max(best, 16), 64, math.isqrt(n_samples)))


def _lifted(
    A: Float[Array, "nx nx"],
    B: Float[Array, "nx nu"],
    C: Float[Array, "ny nx"],
    D: Float[Array, "ny nu"],
    u: Float[Array, "time nu"],
    x0: Float[Array, " nx"],
    block: int,
) -> Float[Array, "time ny"]:
    n_samples, nu = u.shape
    ny, nx = C.shape
    n_blocks = -(-n_samples // block)
    lifted_u = jnp.pad(u, ((0, n_blocks * block - n_samples), (0, 0)))
    lifted_u = lifted_u.reshape(n_blocks, block * nu)

    powers, transition = matrix_powers(A, block)
    reachability = (powers[::-1] @ B).transpose(1, 0, 2).reshape(nx, block * nu)
    observability = C @ powers
    markov = jnp.concatenate([D[None], observability[:-1] @ B])
    toeplitz = block_toeplitz(markov).reshape(block * ny, block * nu)

    forcing = jnp.concatenate([x0[None], lifted_u[:-1] @ reachability.T])
    states = _boundary_states(transition, forcing)
    y = states @ observability.reshape(block * ny, nx).T + lifted_u @ toeplitz.T
    return y.reshape(n_blocks * block, ny)[:n_samples]


@jax.jit
def simulate_lti(
    A: Float[Array, "*#batch nx nx"],
    B: Float[Array, "*#batch nx nu"],
    C: Float[Array, "*#batch ny nx"],
    D: Float[Array, "*#batch ny nu"],
    *,
    u: Float[Array, "*#batch time nu"],
    x0: Float[Array, "*#batch nx"],
) -> Float[Array, "*batch time ny"]:
    """Output of x⁺ = A x + B u, y = C x + D u, by blocks of samples.

    In a block of L samples y = O x + T u and the next block starts from A^L x + R u, with O the
    extended observability, R the reversed reachability and T the block-Toeplitz matrix of Markov
    parameters: the work is a few matrix products, the recursion runs over block starts only, and
    there by doubling. Differentiates forward and in reverse, any order. Leading axes broadcast.

    Args:
        A: state matrix, with any leading axes; B, C, D the others.
        B: input matrix.
        C: output matrix.
        D: feedthrough.
        u: input, time-major.
        x0: first state.
    """
    block = default_block(u.shape[-2], A.shape[-1], B.shape[-1], C.shape[-2])
    kernel = batched(partial(_lifted, block=block), "(n,n),(n,m),(p,n),(p,m),(t,m),(n)->(t,p)")
    return kernel(A, B, C, D, u, x0)
