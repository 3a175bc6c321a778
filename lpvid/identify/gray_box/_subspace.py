"""A and C in continuous time from filtered signals, for several filters and numbers of rows."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.identify._realise import left_range, realise
from lpvid.identify.gray_box._filters import AbstractFilterBasis, laguerre_signals
from lpvid.identify.gray_box._methods import AbstractContinuousTimeMethod, FilteredFactor

# Relative to unit diagonal: keeps the Gram matrix of records without noise positive definite.
_ROUNDING = 1e-14


def filtered_gram(
    u: Float[Array, "time nu"],
    y: Float[Array, "time ny"],
    tau: Float[Array, ""],
    lengths: tuple[int, ...],
    count: int,
) -> Float[Array, "row row"]:
    """Gram matrix of the signals [unfiltered, ℓ_0, …, ℓ_(count−1)] of every channel.

    What the initial state of each record can have contributed is projected out: it lies in the
    span of the filters' impulse responses.

    Args:
        u: inputs, records one after the other.
        y: outputs.
        tau: time constant in samples.
        lengths: samples in each record.
        count: number of filters.

    Returns:
        Rows (signal, channel), inputs before outputs.
    """
    starts = np.cumsum([0, *lengths])
    rows = (count + 1) * (u.shape[1] + y.shape[1])
    total = jnp.zeros((rows, rows))
    for length in dict.fromkeys(lengths):
        members = [starts[r] for r, n in enumerate(lengths) if n == length]
        records = tuple(jnp.stack([signal[a : a + length] for a in members]) for signal in (u, y))
        total += jnp.sum(jax.lax.map(lambda r: _record_gram(r[0], r[1], tau, count), records), 0)
    return total


def _record_gram(u, y, tau, count):
    filtered, transients = laguerre_signals(u, y, tau, count)
    plain = jnp.concatenate([u, y], axis=1)[:, :, None]
    signals = jnp.concatenate([plain, filtered], axis=2)
    rows = signals.transpose(0, 2, 1).reshape(u.shape[0], -1)
    known, cross = transients.T @ transients, transients.T @ rows
    # In a short record the last responses may not have begun.
    slight = _ROUNDING * jnp.trace(known) * jnp.eye(count)
    return rows.T @ rows - cross.T @ jnp.linalg.solve(known + slight, cross)


def filtered_factor(
    root: Float[Array, "signal channel column"],
    basis: AbstractFilterBasis,
    *,
    block_rows: int,
    nu: int,
) -> tuple[FilteredFactor, Float[Array, ""]]:
    """Blocks of L in [U_f; U_p; Y_p; Y_f] = L Q.

    Args:
        root: of the Gram matrix of `filtered_gram`, for 2 `block_rows` filters.
        basis: which combinations of the signals are rows.
        block_rows: i, rows of future and of past.
        nu: inputs.

    Returns:
        The blocks, and the smallest share of a row of inputs, in squares, that the rows before it
        leave unexplained.
    """
    ny, columns = root.shape[1] - nu, root.shape[2]
    rows = jnp.einsum("rs,scx->rcx", jnp.asarray(basis.combinations(block_rows)), root)
    # The most filtered row stands for the oldest sample and comes first.
    future, past = rows[:block_rows][::-1], rows[block_rows:][::-1]
    parts = [future[:, :nu], past[:, :nu], past[:, nu:], future[:, nu:]]
    stacked = jnp.concatenate([part.reshape(-1, columns) for part in parts])
    triangle = jnp.linalg.qr(stacked.T, mode="r").T
    a, b = block_rows * nu, block_rows * (2 * nu + ny)
    of_inputs = triangle[: 2 * a]
    power = jnp.maximum(jnp.sum(of_inputs**2, axis=1), jnp.finfo(float).tiny)
    factor = FilteredFactor(
        instruments_inputs=triangle[a:b, :a],
        instruments=triangle[a:b, a:b],
        outputs_instruments=triangle[b:, a:b],
        outputs=triangle[b:, b:],
    )
    return factor, jnp.min(jnp.diagonal(of_inputs) ** 2 / power)


@functools.partial(jax.jit, static_argnames=("method", "block_rows", "lengths"))
def ranges(u, y, taus, *, method: AbstractContinuousTimeMethod, block_rows, lengths):
    """Left singular vectors, singular values and smallest pivot at every τ, for every i.

    One filtering and one Gram matrix for a τ serve every i: the Laguerre signals are nested.

    Args:
        u: inputs of unit RMS.
        y: outputs of unit RMS.
        taus: time constants in samples, (tau,).
        method: whose weights.
        block_rows: all i that are asked for.
        lengths: samples in each record.

    Returns:
        One triple (vectors, values, pivot) with a leading axis over τ for each i.
    """
    nu, channels = u.shape[1], u.shape[1] + y.shape[1]

    def at(tau):
        gram = filtered_gram(u, y, tau, lengths, 2 * max(block_rows)) / sum(lengths)
        size = jnp.sqrt(jnp.maximum(jnp.diagonal(gram), jnp.finfo(float).tiny))
        scaled = gram / size[:, None] / size[None, :]
        root = jnp.linalg.cholesky(scaled + _ROUNDING * jnp.eye(size.shape[0])) * size[:, None]
        found = []
        for i in block_rows:
            rows = (2 * i + 1) * channels
            leading = root[:rows, :rows].reshape(2 * i + 1, channels, rows)
            factor, pivot = filtered_factor(leading, method.filters, block_rows=i, nu=nu)
            matrix, weight = method.project(factor)
            vectors, values = left_range(matrix, squared=False)
            if weight is not None:
                vectors = weight @ vectors
            found.append((vectors, values, pivot))
        return tuple(found)

    return jax.lax.map(at, taus)


@functools.partial(jax.jit, static_argnames=("filters", "order", "ny"))
def dynamics(found, taus, *, filters: AbstractFilterBasis, order, ny):
    """A (i, tau, nx, nx), in units of one sample, and C (i, tau, ny, nx) of `ranges`."""

    def one(vectors, values, tau):
        observability = vectors[:, :order] * jnp.sqrt(values[:order])[None, :]
        shift, C = realise(observability, ny)
        return filters.continuous(shift, tau), C

    pairs = [jax.vmap(one)(vectors, values, taus) for vectors, values, _ in found]
    return tuple(jnp.stack(parts) for parts in zip(*pairs, strict=True))
