r"""B, D and x0 from the simulation error, linear in all three once A and C are known.

$y_k(t) = C_k A^t x_0 + \sum_j r_{kj}(t) B_j + \sum_j D_{kj} u_j(t)$ with the regressors filtered,
$r_{kj}(t+1) = r_{kj}(t) A + C_k u_j(t)$. They are never formed: within a block of L samples they
are linear in the block's inputs and in the regressors at its start, so the normal equations follow
from the Gram matrix of those over all blocks, contracted with fixed matrices.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Float

# Blocks whose Gram matrix is summed before the next are looked at: memory is flat in N.
_BLOCKS_AT_ONCE = 4096
# Blocks whose start states are found by one product.
_RADIX = 8


class NormalEquations(eqx.Module):
    """Normal equations of one record, for each output k; x0 counts as one more input channel.

    Attributes:
        states: between the columns of B, then x0: `(ny, (nu+1) nx, (nu+1) nx)`.
        states_inputs: between those and the row of D, `(ny, (nu+1) nx, nu)`.
        inputs: between the entries of a row of D, `(nu, nu)`.
        states_outputs: right-hand side for B and x0, `(ny, (nu+1) nx)`.
        inputs_outputs: right-hand side for D, `(ny, nu)`.
        outputs: sum of squares, `(ny,)`.
    """

    states: Float[Array, "*record ny q q"]
    states_inputs: Float[Array, "*record ny q nu"]
    inputs: Float[Array, "*record nu nu"]
    states_outputs: Float[Array, "*record ny q"]
    inputs_outputs: Float[Array, "*record ny nu"]
    outputs: Float[Array, "*record ny"]


class _Lifted(eqx.Module):
    """What a block of L samples does to the regressors: fixed by A and C."""

    power: Float[Array, "nx nx"]  # A^L
    advance: Float[Array, "L ny nx"]  # input sample to the regressors at the block's end
    within: Float[Array, "ny L p nx"]  # [inputs of the block, start] to the regressors in it


def _lift(A: Array, C: Array, size: int) -> _Lifted:
    nx = A.shape[0]
    powers = jnp.eye(nx)[None]
    ahead = A
    while powers.shape[0] < size:
        powers = jnp.concatenate([powers, powers @ ahead])
        ahead = ahead @ ahead
    powers = powers[:size]
    impulse = jnp.einsum("kx,txa->tka", C, powers)
    t, i = np.arange(size)[:, None], np.arange(size)[None, :]
    delayed = jnp.concatenate([impulse, jnp.zeros_like(impulse[:1])])[
        np.where(i < t, t - 1 - i, size)
    ]
    start = jnp.broadcast_to(powers[None], (C.shape[0], size, nx, nx))
    return _Lifted(
        power=powers[-1] @ A,
        advance=impulse[::-1],
        within=jnp.concatenate([delayed.transpose(2, 0, 1, 3), start], axis=2),
    )


def _prefix(increments: Array, power: Array) -> Array:
    """States s_b = Σ_{m ≤ b} e_m F^{b−m} for `(lane, block, nx)` increments e and F = `power`."""
    lanes, blocks, nx = increments.shape
    if blocks <= 1:
        return increments
    groups = -(-blocks // _RADIX)
    padded = jnp.pad(increments, ((0, 0), (0, groups * _RADIX - blocks), (0, 0)))
    powers = [jnp.eye(nx)]
    for _ in range(_RADIX):
        powers.append(powers[-1] @ power)
    zero = jnp.zeros((nx, nx))
    lower = [[powers[j - i] if j >= i else zero for j in range(_RADIX)] for i in range(_RADIX)]
    local = (padded.reshape(lanes * groups, _RADIX * nx) @ jnp.block(lower)).reshape(
        lanes, groups, _RADIX, nx
    )
    # What the groups before hand over, by the same rule one level up.
    ends = _prefix(local[:, :, -1], powers[-1])
    handed = jnp.pad(ends[:, :-1], ((0, 0), (1, 0), (0, 0)))
    carried = handed.reshape(lanes * groups, nx) @ jnp.concatenate(powers[1:], axis=1)
    total = local + carried.reshape(lanes, groups, _RADIX, nx)
    return total.reshape(lanes, groups * _RADIX, nx)[:, :blocks]


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
    """Normal equations of one record for B, D and x0. Memory is flat in the record's length."""
    time, nu = u.shape
    ny, nx = C.shape
    size = min(block_size(nx, nu, ny), time)
    lifted = _lift(A, C, size)
    n_blocks = time // size
    at_once = min(_BLOCKS_AT_ONCE, n_blocks)

    def piece(states, first, count):
        """Gram matrix over `count` blocks from sample `first`, and the states after them."""
        ub = jax.lax.dynamic_slice_in_dim(u, first, count * size).reshape(count, size, nu)
        yb = jax.lax.dynamic_slice_in_dim(y, first, count * size).reshape(count, size * ny)
        advance = lifted.advance.reshape(size, ny * nx)
        e = (ub.transpose(2, 0, 1).reshape(nu * count, size) @ advance).reshape(nu, count, ny, nx)
        e = jnp.pad(e.transpose(0, 2, 1, 3), ((0, 1), (0, 0), (0, 0), (0, 0)))
        e = jnp.concatenate([states[:, None], e.reshape((nu + 1) * ny, count, nx)], axis=1)
        s = _prefix(e, lifted.power)
        begin = s[:, :-1].transpose(1, 0, 2).reshape(count, (nu + 1) * ny * nx)
        # Inputs by channel, as the contraction below wants them.
        left = jnp.concatenate([ub.transpose(0, 2, 1).reshape(count, nu * size), begin], axis=1)
        return left.T @ jnp.concatenate([left, yb], axis=1), s[:, -1]

    states = jnp.concatenate([jnp.zeros((nu * ny, nx)), C])
    gram, states = piece(states, 0, at_once)
    n_chunks, leftover = divmod(n_blocks, at_once)
    if n_chunks > 1:

        def body(k, carry):
            more, states = piece(carry[1], k * at_once * size, at_once)
            return carry[0] + more, states

        gram, states = jax.lax.fori_loop(1, n_chunks, body, (gram, states))
    if leftover:
        more, states = piece(states, n_chunks * at_once * size, leftover)
        gram = gram + more
    power = jnp.sum(y * y, axis=0)
    whole = _contract(lifted.within, gram, nu, power)
    rest = time - n_blocks * size
    if rest == 0:
        return whole
    ut, yt = u[n_blocks * size :], y[n_blocks * size :]
    padded = jnp.pad(ut.T, ((0, 0), (0, size - rest))).reshape(nu * size)
    left = jnp.concatenate([padded, states.reshape((nu + 1) * ny * nx)])
    right = jnp.concatenate([left, jnp.pad(yt, ((0, size - rest), (0, 0))).reshape(size * ny)])
    last = left[:, None] * right[None, :]
    tail = _contract(lifted.within[:, :rest], last, nu, jnp.zeros_like(power))
    return jax.tree.map(jnp.add, whole, tail)


def _contract(within: Array, gram: Array, nu: int, power: Array) -> NormalEquations:
    """Normal equations from the Gram matrix of [inputs, states] against [inputs, states, y]."""
    # Fewer steps than the block has samples: a record's end, padded to a block.
    ny, steps, p, nx = within.shape
    size = p - nx
    n_u, n_s = nu * size, (nu + 1) * ny * nx

    def per_output(block):
        """`(rows of [u, s], ...)` to `(ny, nu+1, p, ...)`; x0 has no inputs of its own."""
        shape = block.shape[1:]
        inputs = block[:n_u].reshape(nu, size, *shape)
        inputs = jnp.concatenate([inputs, jnp.zeros((1, size, *shape))])
        inputs = jnp.broadcast_to(inputs[None], (ny, *inputs.shape))
        starts = jnp.moveaxis(block[n_u:].reshape(nu + 1, ny, nx, *shape), 1, 0)
        return jnp.concatenate([inputs, starts], axis=2)

    square = per_output(gram[:, : n_u + n_s])  # ny, j, p, columns
    # The same for the columns, output by output.
    square = jnp.stack(
        [per_output(square[k].reshape(-1, n_u + n_s).T)[k] for k in range(ny)]
    ).reshape(ny, (nu + 1) * p, nu + 1, p)  # k, (J, P), j, p (symmetric)
    flat = within.transpose(0, 2, 1, 3).reshape(ny, p, steps * nx)
    once = jnp.einsum("kqjp,kpz->kqjz", square, flat)
    once = once.reshape(ny, nu + 1, p, nu + 1, steps, nx).transpose(0, 1, 3, 5, 4, 2)
    states = jnp.einsum(
        "kqz,kzb->kqb",
        once.reshape(ny, (nu + 1) * (nu + 1) * nx, steps * p),
        within.reshape(ny, steps * p, nx),
    ).reshape(ny, nu + 1, nu + 1, nx, nx)  # J, j, a (of j), b (of J)
    q = (nu + 1) * nx
    states = states.transpose(0, 2, 3, 1, 4).reshape(ny, q, q)

    columns = gram[:, :n_u].reshape(-1, nu, size)[:, :, :steps]
    with_inputs = per_output(columns)  # ny, j, p, J, t
    states_inputs = jnp.einsum("ktpa,kjpJt->kjaJ", within, with_inputs).reshape(ny, q, nu)
    with_outputs = per_output(gram[:, n_u + n_s :].reshape(-1, size, ny)[:, :steps])
    states_outputs = jnp.einsum("ktpa,kjptk->kja", within, with_outputs).reshape(ny, q)
    among = gram[:n_u, :n_u].reshape(nu, size, nu, size)
    inputs = jnp.einsum("jtJt->jJ", among[:, :steps, :, :steps])
    across = gram[:n_u, n_u + n_s :].reshape(nu, size, size, ny)
    inputs_outputs = jnp.einsum("jttk->kj", across[:, :steps, :steps])
    return NormalEquations(
        states=states,
        states_inputs=states_inputs,
        inputs=inputs,
        states_outputs=states_outputs,
        inputs_outputs=inputs_outputs,
        outputs=power,
    )


def record_equations(
    A: Float[Array, "nx nx"],
    C: Float[Array, "ny nx"],
    u: Float[Array, "time nu"],
    y: Float[Array, "time ny"],
    lengths: tuple[int, ...],
) -> NormalEquations:
    """Normal equations of every record, stacked along a leading axis."""
    starts = np.cumsum([0, *lengths])
    pieces: list = [None] * len(lengths)
    for length in dict.fromkeys(lengths):
        members = [r for r, n in enumerate(lengths) if n == length]
        us = jnp.stack([u[starts[r] : starts[r] + length] for r in members])
        ys = jnp.stack([y[starts[r] : starts[r] + length] for r in members])
        if len(members) == 1:
            group = jax.tree.map(lambda x: x[None], normal_equations(A, C, us[0], ys[0]))
        else:
            group = jax.lax.map(lambda uy: normal_equations(A, C, *uy), (us, ys))
        for position, r in enumerate(members):
            pieces[r] = (group, position)
    if len(set(lengths)) == 1:
        return pieces[0][0]
    chosen = [jax.tree.map(lambda x, i=i: x[i], group) for group, i in pieces]
    return jax.tree.map(lambda *x: jnp.stack(x), *chosen)


class LinearFit(eqx.Module):
    """B, D, x0 of every record, and the residual's sum of squares for each output."""

    B: Float[Array, "nx nu"]
    D: Float[Array, "ny nu"]
    x0: Float[Array, "record nx"]
    residual: Float[Array, " ny"]


def solve(equations: NormalEquations, *, feedthrough: bool) -> LinearFit:
    """Least squares for B and D, one x0 for each record."""
    records, ny, q, _ = equations.states.shape
    nu = equations.inputs.shape[-1]
    nx = q // (nu + 1)
    b = nu * nx
    # Unknowns [B, x0] of all outputs, then the rows of D; x0 of each record is eliminated first.
    pooled = jnp.sum(equations.states, axis=1)
    right = jnp.sum(equations.states_outputs, axis=1)
    n_d = ny * nu if feedthrough else 0
    shared = equations.states_inputs.transpose(0, 2, 1, 3).reshape(records, q, ny * nu)[..., :n_d]
    diagonal = jnp.kron(jnp.eye(ny), jnp.sum(equations.inputs, axis=0))[:n_d, :n_d]
    top = jnp.sum(pooled[:, :b, :b], axis=0)
    side = jnp.sum(shared[:, :b], axis=0)
    known = jnp.concatenate([side.T, diagonal], axis=1)
    normal = jnp.concatenate([jnp.concatenate([top, side], axis=1), known])
    rhs = jnp.concatenate(
        [
            jnp.sum(right[:, :b], axis=0),
            jnp.sum(equations.inputs_outputs, axis=0).reshape(ny * nu)[:n_d],
        ]
    )
    coupling = jnp.concatenate([pooled[:, b:, :b], shared[:, b:]], axis=2)

    def eliminate(one):
        block, cross, value = one
        return solve_positive(block, jnp.concatenate([cross, value[:, None]], axis=1))

    parts = (pooled[:, b:, b:], coupling, right[:, b:])
    if records == 1:
        solved = eliminate(jax.tree.map(lambda x: x[0], parts))[None]
    else:
        solved = jax.lax.map(eliminate, parts)
    normal = normal - jnp.einsum("rxa,rxb->ab", coupling, solved[..., :-1])
    rhs = rhs - jnp.einsum("rxa,rx->a", coupling, solved[..., -1])
    theta = solve_positive(normal, rhs[:, None])[:, 0]
    x0 = solved[..., -1] - jnp.einsum("rxa,a->rx", solved[..., :-1], theta)
    D = theta[b:].reshape(ny, nu) if feedthrough else jnp.zeros((ny, nu))
    return LinearFit(
        B=theta[:b].reshape(nu, nx).T,
        D=D,
        x0=x0,
        residual=residual_power(equations, theta[:b], D, x0),
    )


def residual_power(
    equations: NormalEquations,
    b: Float[Array, " entry"],
    D: Float[Array, "ny nu"],
    x0: Float[Array, "record nx"],
) -> Float[Array, " ny"]:
    """Sum of squares of what B, D and x0 leave of each output."""
    entries = jnp.concatenate([jnp.broadcast_to(b[None], (x0.shape[0], b.shape[0])), x0], axis=1)
    quadratic = jnp.einsum("ra,rkab,rb->k", entries, equations.states, entries)
    quadratic += 2.0 * jnp.einsum("ra,rkaj,kj->k", entries, equations.states_inputs, D)
    quadratic += jnp.einsum("ki,rij,kj->k", D, equations.inputs, D)
    linear = jnp.einsum("ra,rka->k", entries, equations.states_outputs)
    linear += jnp.einsum("kj,rkj->k", D, equations.inputs_outputs)
    return jnp.maximum(quadratic - 2.0 * linear + jnp.sum(equations.outputs, axis=0), 0.0)


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
        values, vectors = jnp.linalg.eigh(scaled)
        kept = values > values[-1] * scaled.shape[0] * jnp.finfo(float).eps
        inverse = jnp.where(kept, 1.0 / jnp.where(kept, values, 1.0), 0.0)
        return vectors @ (inverse[:, None] * (vectors.T @ scaled_right))

    solution = jax.lax.cond(
        jnp.all(jnp.isfinite(jnp.diagonal(factor))),
        lambda: cho_solve((factor, True), scaled_right),
        least_norm,
    )
    return solution * scale[:, None]
