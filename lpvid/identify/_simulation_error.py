r"""Normal equations of B, D and x0 in the simulation error, without the regressors.

With A and C known, $y_k(t) = C_k A^t x_0 + \sum_j r_{kj}(t) B_j + \sum_j D_{kj} u_j(t)$ is linear
in the rest, the regressors filtered: $r_{kj}(t+1) = r_{kj}(t) A + C_k u_j(t)$. They are never
formed: within a block of L samples they are linear in its inputs and in the regressors at its
start, so the normal equations follow from the Gram matrix of those over all blocks, contracted with
matrices that A and C alone fix. x0 is one more input channel, an impulse before the record.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# Blocks whose Gram matrix is summed before the next are looked at: memory is flat in N.
_BLOCKS_AT_ONCE = 1024
# Blocks whose start states are found by one product.
_RADIX = 8


class NormalEquations(eqx.Module):
    """Normal equations for each output k, in the entries (channel, coefficient).

    Channels are the inputs, then x0. Coefficients are the nx entries of a column of B (or of x0),
    then the entry of D (nothing for x0).

    Attributes:
        matrix: (ny, entry, entry) with (nu + 1) (nx + 1) entries; records in front.
        right: (ny, entry).
        power: sum of squares of the outputs, (ny,).
    """

    matrix: Float[Array, "*record ny entry entry"]
    right: Float[Array, "*record ny entry"]
    power: Float[Array, "*record ny"]


def block_size(nx: int, nu: int, ny: int) -> int:
    """Samples in a block: balances the products over blocks against those within."""
    best = (nu + 1) * ny * nx / math.sqrt(nu * (nu + ny))
    return int(min(max(4 * round(best / 4), 8), 48))


def normal_equations(
    A: Float[Array, "nx nx"],
    C: Float[Array, "ny nx"],
    u: Float[Array, "time nu"],
    y: Float[Array, "time ny"],
) -> NormalEquations:
    """Normal equations of one record. Memory is flat in the record's length."""
    return continued_equations(A, C, u, y, first_regressors(C, u.shape[1]))[0]


def first_regressors(C: Float[Array, "ny nx"], nu: int) -> Float[Array, "lane nx"]:
    """Regressors at a record's first sample: none of the inputs', C those of x0."""
    return jnp.concatenate([jnp.zeros((nu * C.shape[0], C.shape[1])), C])


def continued_equations(
    A: Float[Array, "nx nx"],
    C: Float[Array, "ny nx"],
    u: Float[Array, "time nu"],
    y: Float[Array, "time ny"],
    start: Float[Array, "lane nx"],
) -> tuple[NormalEquations, Float[Array, "lane nx"]]:
    """Normal equations of a stretch of a record, from the regressors at its first sample.

    Returns:
        The equations, and the regressors after the last sample; these hold where the stretch is a
        whole number of blocks long (`block_size`).
    """
    (time, nu), (ny, nx) = u.shape, C.shape
    size = min(block_size(nx, nu, ny), time)
    n_blocks = -(-time // size)
    at_once = min(_BLOCKS_AT_ONCE, n_blocks)
    n_chunks, leftover = divmod(n_blocks, at_once)
    surplus = n_blocks * size - time
    padded = [jnp.pad(signal, ((0, surplus), (0, 0))) for signal in (u, y)]

    powers = _powers(A, size + 1)
    impulse = jnp.einsum("kx,txa->tka", C, powers[:size])
    # What an input sample adds to the regressors at the block's end.
    advance = impulse[::-1].reshape(size, ny * nx)
    jumps = _powers(powers[size], _RADIX + 1)

    def piece(states, first, count):
        """Gram matrix over `count` blocks from sample `first`, the states in the last and after."""
        ub, yb = (
            jax.lax.dynamic_slice_in_dim(signal, first, count * size).reshape(count, size, -1)
            for signal in padded
        )
        # Blocks along the last axis of what is multiplied at the end: twice as fast.
        ub, yb = ub.transpose(2, 1, 0), yb.transpose(1, 2, 0)
        e = ub.transpose(0, 2, 1).reshape(nu * count, size) @ advance
        e = e.reshape(nu, count, ny, nx).transpose(0, 2, 1, 3).reshape(nu * ny, count, nx)
        e = jnp.pad(e, ((0, ny), (1, 0), (0, 0))).at[:, 0].set(states)
        s = _prefix(e, jumps)
        begin = s[:, :-1].transpose(0, 2, 1).reshape((nu + 1) * ny * nx, count)
        left = jnp.concatenate([ub.reshape(nu * size, count), begin])
        right = jnp.concatenate([left, yb.reshape(size * ny, count)])
        return left @ right.T, left[:, -1], s[:, -1]

    gram, last, states = piece(start, 0, at_once)
    if n_chunks > 1:

        def body(k, carry):
            more, last, states = piece(carry[2], k * at_once * size, at_once)
            return carry[0] + more, last, states

        gram, last, states = jax.lax.fori_loop(1, n_chunks, body, (gram, last, states))
    if leftover:
        more, last, states = piece(states, n_chunks * at_once * size, leftover)
        gram = gram + more

    within = _within(impulse, powers[:size])
    matrix, right = _contract(within, gram, nu)
    if surplus:
        # In the samples that fill up the last block, u and y are zero but the regressors ring on.
        rows = _rows(nu, ny, nx, size)
        entries = jnp.concatenate([last, jnp.zeros(1)])[rows].reshape(ny, nu + 1, size + nx)
        end = jnp.einsum("kjp,kpa->kja", entries, within[:, size - surplus, :, :nx])
        ringing = jnp.einsum("kjx,txa->tkja", end, powers[:surplus])
        ringing = jnp.pad(ringing, ((0, 0), (0, 0), (0, 0), (0, 1))).reshape(surplus, ny, -1)
        matrix = matrix - jnp.einsum("tka,tkb->kab", ringing, ringing)
    power = jnp.sum(y * y, axis=0)
    return NormalEquations(matrix=matrix, right=right, power=power), states


def record_equations(
    A: Float[Array, "nx nx"],
    C: Float[Array, "ny nx"],
    u: Float[Array, "time nu"],
    y: Float[Array, "time ny"],
    lengths: tuple[int, ...],
) -> NormalEquations:
    """Normal equations of every record, stacked along a leading axis."""
    if len(lengths) == 1:
        return jax.tree.map(lambda x: x[None], normal_equations(A, C, u, y))
    starts = np.cumsum([0, *lengths])
    groups, order = [], []
    for length in dict.fromkeys(lengths):
        members = [r for r, n in enumerate(lengths) if n == length]
        pairs = tuple(
            jnp.stack([signal[starts[r] : starts[r] + length] for r in members])
            for signal in (u, y)
        )
        groups.append(jax.lax.map(lambda pair: normal_equations(A, C, *pair), pairs))
        order += members
    place = np.argsort(order)
    return jax.tree.map(lambda *parts: jnp.concatenate(parts)[place], *groups)


def _powers(matrix: Array, count: int) -> Array:
    """Powers 0 … `count` − 1; a loop, since compiling costs more than the products."""
    nx = matrix.shape[0]
    return jax.lax.scan(lambda p, _: (p @ matrix, p), jnp.eye(nx), length=count)[1]


def _within(impulse: Array, powers: Array) -> Array:
    """From [inputs of the block, regressors at its start] to [regressors, input] at each sample.

    `(ny, L, L + nx, nx + 1)`: output, sample, source, coefficient.
    """
    size, ny, nx = impulse.shape
    t, i = np.arange(size)[:, None], np.arange(size)[None, :]
    silent = jnp.concatenate([impulse, jnp.zeros((1, ny, nx))])
    delayed = silent[np.where(i < t, t - 1 - i, size)].transpose(2, 0, 1, 3)
    start = jnp.broadcast_to(powers[None], (ny, size, nx, nx))
    regressors = jnp.concatenate([delayed, start], axis=2)
    itself = np.broadcast_to(np.eye(size, size + nx)[None, :, :, None], (*regressors.shape[:3], 1))
    return jnp.concatenate([regressors, jnp.asarray(itself)], axis=3)


def _rows(nu: int, ny: int, nx: int, size: int) -> np.ndarray:
    """Where the sources of output k and channel j lie in [inputs, states]: `(ny, (nu+1) (L+nx))`.

    x0 has no inputs of its own: those point one past the end, to a zero.
    """
    k, j = np.arange(ny)[:, None, None], np.arange(nu + 1)[None, :, None]
    n_inputs, n_states = nu * size, (nu + 1) * ny * nx
    inputs = np.where(j < nu, j * size + np.arange(size), n_inputs + n_states)
    states = n_inputs + (j * ny + k) * nx + np.arange(nx)
    inputs = np.broadcast_to(inputs, (ny, nu + 1, size))
    return np.concatenate([inputs, states], axis=2).reshape(ny, -1)


def _contract(within: Array, gram: Array, nu: int) -> tuple[Array, Array]:
    """Normal equations from the Gram matrix of [inputs, states] against [inputs, states, y]."""
    ny, size, sources, coefficients = within.shape
    channels = nu + 1
    rows = _rows(nu, ny, sources - size, size)
    known = gram.shape[0]
    outputs = known + np.arange(size)[None, :] * ny + np.arange(ny)[:, None]
    columns = np.concatenate([np.where(rows < known, rows, gram.shape[1]), outputs], axis=1)
    bordered = jnp.pad(gram, ((0, 1), (0, 1)))
    flat = (rows[:, :, None] * (gram.shape[1] + 1) + columns[:, None, :]).astype(np.int32)
    sorted_out = bordered.reshape(-1).at[flat].get(mode="promise_in_bounds")
    square, with_outputs = jnp.split(sorted_out, [channels * sources], axis=2)

    # Sums over samples t and both sources; the first product makes the second one small.
    once = jnp.einsum("kqjp,ktpa->kjaqt", square.reshape(ny, -1, channels, sources), within)
    once = once.reshape(ny, channels * coefficients, channels, sources, size)
    matrix = jnp.einsum("kzjpt,ktpb->kzjb", once, within)
    right = jnp.einsum("kjpt,ktpa->kja", with_outputs.reshape(ny, channels, sources, size), within)
    entries = channels * coefficients
    return matrix.reshape(ny, entries, entries), right.reshape(ny, entries)


def _prefix(increments: Array, powers: Array) -> Array:
    """States s_b = Σ_{m ≤ b} e_m F^{b−m} for `(lane, block, nx)` increments e and powers of F.

    A few blocks at once by one product with a block Toeplitz matrix; what those groups hand over
    by doubling: s ← s + F^{2^i} s shifted by 2^i.
    """
    lanes, blocks, nx = increments.shape
    groups = -(-blocks // _RADIX)
    padded = jnp.pad(increments, ((0, 0), (0, groups * _RADIX - blocks), (0, 0)))
    i, j = np.arange(_RADIX)[:, None], np.arange(_RADIX)[None, :]
    lagged = powers.at[_RADIX].set(0.0)[np.where(j >= i, j - i, _RADIX)]
    toeplitz = lagged.transpose(0, 2, 1, 3).reshape(_RADIX * nx, _RADIX * nx)
    local = padded.reshape(lanes * groups, _RADIX * nx) @ toeplitz
    local = local.reshape(lanes, groups, _RADIX, nx)

    def double(i, carry):
        ends, jump = carry
        shift = 2**i
        earlier = jnp.roll(ends, shift, axis=1)
        valid = (jnp.arange(groups) >= shift)[None, :, None]
        return ends + jnp.where(valid, earlier, 0.0) @ jump, jump @ jump

    steps = max(groups - 1, 0).bit_length()
    ends, _ = jax.lax.fori_loop(0, steps, double, (local[:, :, -1], powers[_RADIX]))
    handed = jnp.pad(ends[:, :-1], ((0, 0), (1, 0), (0, 0))).reshape(lanes * groups, nx)
    carried = handed @ powers[1:].transpose(1, 0, 2).reshape(nx, _RADIX * nx)
    total = local + carried.reshape(lanes, groups, _RADIX, nx)
    return total.reshape(lanes, groups * _RADIX, nx)[:, :blocks]
