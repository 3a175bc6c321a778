"""Gram matrix of block-Hankel data, without the Hankel matrix."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

# Samples handled at once: large enough for fast products, small enough for the cache.
_CHUNK = 4000
_BLOCK = 20
# Records whose edge corrections are stacked into one product.
_EDGES_AT_ONCE = 16


def lagged_products(
    w: Float[Array, "time channel"], n_lags: int
) -> Float[Array, "lag channel channel"]:
    r"""Sums $R_\tau = \sum_t w_t w_{t+\tau}^\top$ for all lags $\tau$ below `n_lags`.

    Samples beyond the end count as zero. The signal is cut into short blocks, and the products of a
    block with itself and its successors are one matrix product over all blocks, the sums along
    whose diagonals are the lags: $O(N\,\tau c^2)$ operations at the speed of a matrix product, and
    memory independent of N beside the signal itself.
    """
    time, channels = w.shape
    ahead = -(-(n_lags - 1 + _BLOCK - 1) // _BLOCK)
    halo = ahead * _BLOCK
    chunk = -(-min(_CHUNK, time) // _BLOCK) * _BLOCK
    n_chunks = -(-time // chunk)
    padded = jnp.pad(w, ((0, n_chunks * chunk + halo - time), (0, 0)))

    def products(start):
        piece = jax.lax.dynamic_slice_in_dim(padded, start, chunk + halo)
        # Blocks along the last axis of both factors: twice as fast as along the first.
        blocks = piece.reshape(-1, _BLOCK * channels).T
        n_blocks = chunk // _BLOCK
        later = [blocks[:, j : j + n_blocks] for j in range(ahead + 1)]
        return blocks[:, :n_blocks] @ jnp.concatenate(later).T

    if n_chunks == 1:
        total = products(0)
    else:
        total = jax.lax.fori_loop(
            1, n_chunks, lambda k, acc: acc + products(k * chunk), products(0)
        )
    total = total.reshape(_BLOCK, channels, (ahead + 1) * _BLOCK, channels)
    shifted = jnp.stack([total[i, :, i : i + n_lags] for i in range(_BLOCK)])
    return jnp.sum(shifted, axis=0).transpose(1, 0, 2)


class HankelMoments(eqx.Module):
    """All that the Gram matrix of block-Hankel data needs to know of the records.

    Attributes:
        lagged: lagged products summed over records, (lag, channel, channel).
        heads: first samples of every record, one less than there are lags.
        tails: last samples of every record, as many.
        total: sum of every channel over all records.
    """

    lagged: Float[Array, "lag channel channel"]
    heads: Float[Array, "record edge channel"]
    tails: Float[Array, "record edge channel"]
    total: Float[Array, " channel"]


def hankel_moments(
    w: Float[Array, "time channel"], lengths: tuple[int, ...], n_lags: int
) -> HankelMoments:
    """Moments of records one after the other, each at least `n_lags` long.

    Args:
        w: records one after the other, (time, channel).
        lengths: samples in each record.
        n_lags: number of delays in the Hankel matrix.
    """
    gap = jnp.zeros((n_lags, w.shape[1]))
    starts = np.cumsum([0, *lengths])
    # Zeros between the records keep the lagged products of one from reaching into the next.
    pieces = [w[a:b] for a, b in zip(starts[:-1], starts[1:], strict=True)]
    apart = (
        w if len(lengths) == 1 else jnp.concatenate([x for piece in pieces for x in (piece, gap)])
    )
    return HankelMoments(
        lagged=lagged_products(apart, n_lags),
        heads=jnp.stack([w[a : a + n_lags - 1] for a in starts[:-1]]),
        tails=jnp.stack([w[b - n_lags + 1 : b] for b in starts[1:]]),
        total=jnp.sum(w, axis=0),
    )


def hankel_gram(
    moments: HankelMoments, rows: np.ndarray, columns: int, *, constant: bool
) -> Float[Array, "row row"]:
    r"""Gram matrix $\sum_r H_r H_r^\top$ of the block-Hankel matrices of several records.

    Column t of $H$ stacks the samples $w_t, w_{t+1}, \dots$; `rows` says which delay and channel
    each row takes, so past and future, inputs and outputs come out in any order.

    Displacement structure: block (i, j) follows from its upper-left neighbour by a rank-one update
    and downdate, $G_{i+1,j+1} = G_{ij} + w_{i+M} w_{j+M}^\top - w_i w_j^\top$ with M columns.
    Summed along the diagonals that is $G = T - P P^\top$: T block Toeplitz in the lagged products,
    P the samples at the records' two ends. $O(N s c^2 + s^3 c^2)$ operations, memory $O(s^2 c^2)$.

    Args:
        moments: of the records.
        rows: delays and channels, integers (row, 2).
        columns: of the Hankel matrices together.
        constant: whether a row of ones is projected out, $G - m m^\top / M$ with m the row sums.
    """
    channels = moments.lagged.shape[1]
    delay, channel = rows[:, 0], rows[:, 1]
    n_lags = moments.lagged.shape[0]
    # R_{-τ} = R_τᵀ: one table over negative and positive lags.
    table = jnp.concatenate([moments.lagged[:0:-1].transpose(0, 2, 1), moments.lagged])
    shift = delay[None, :] - delay[:, None] + n_lags - 1
    place = (shift * channels + channel[:, None]) * channels + channel[None, :]
    gram = _take(table, place)
    heads, tails = moments.heads, moments.tails
    if constant:
        # Row i misses the samples before i and those from i + M on.
        none = jnp.zeros((1, channels))
        before = jnp.concatenate([none, jnp.cumsum(jnp.sum(heads, axis=0), axis=0)])
        last = jnp.sum(tails, axis=0)
        after = jnp.concatenate([jnp.cumsum(last[::-1], axis=0)[::-1], none])
        sums = _take(moments.total[None] - before - after, delay * channels + channel)
        gram = gram - sums[:, None] * sums[None, :] / columns

    k = np.arange(n_lags - 1)
    before = delay[:, None] - 1 - k[None, :]
    after = delay[:, None] + k[None, :]

    def edges(head, tail):
        ends = jnp.concatenate([head, tail, jnp.zeros((1, channels))])
        # The row of zeros stands for samples outside the record.
        first = np.where(before >= 0, before, 2 * n_lags - 2)
        last = np.where(after < n_lags - 1, after + n_lags - 1, 2 * n_lags - 2)
        return _take(ends, np.concatenate([first, last], axis=1) * channels + channel[:, None])

    if heads.shape[0] <= _EDGES_AT_ONCE:
        ends = [edges(head, tail) for head, tail in zip(heads, tails, strict=True)]
        corners = jnp.concatenate(ends, axis=1)
        return gram - corners @ corners.T

    def subtract(gram, ends):
        corners = edges(*ends)
        return gram - corners @ corners.T, None

    return jax.lax.scan(subtract, gram, (heads, tails))[0]


def _take(values: Array, flat: np.ndarray) -> Array:
    """Entries at known places of the flattened array; the bounds need no check at run time."""
    return values.reshape(-1).at[flat.astype(np.int32)].get(mode="promise_in_bounds")


def hankel_factor(
    w: Float[Array, "time channel"],
    lengths: tuple[int, ...],
    rows: np.ndarray,
    *,
    constant: bool = False,
) -> Float[Array, "row row"]:
    """Lower triangular factor of the block-Hankel matrix, by Householder reflections.

    Twice the digits of the Gram matrix at ten times its cost: the fallback where the Gram matrix is
    ill-conditioned. The Hankel matrix is formed a chunk of columns at a time.

    Args:
        w: records one after the other, (time, channel).
        lengths: samples in each record.
        rows: delays and channels, integers (row, 2).
        constant: whether a row of ones is projected out.
    """
    n_lags = int(rows[:, 0].max()) + 1
    upper = empty_triangle(rows, constant)
    start = 0
    for length in lengths:
        record = w[start : start + length]
        upper = extend_triangle(upper, record, length - n_lags + 1, rows, constant)
        start += length
    return lower_factor(upper, constant)


def empty_triangle(rows: np.ndarray, constant: bool) -> Float[Array, "row row"]:
    """The triangle before any data: a row of ones first where a constant is projected out."""
    n_rows = rows.shape[0] + constant
    return jnp.zeros((n_rows, n_rows))


def extend_triangle(
    upper: Float[Array, "row row"],
    w: Float[Array, "time channel"],
    columns: Int[Array, ""] | int,
    rows: np.ndarray,
    constant: bool,
) -> Float[Array, "row row"]:
    """The upper triangle with the Hankel columns of one more stretch of samples.

    Args:
        upper: the triangle so far.
        w: the samples.
        columns: how many of the Hankel columns count, from the first.
        rows: delays and channels, integers (row, 2).
        constant: whether a row of ones leads.
    """
    n_lags = int(rows[:, 0].max()) + 1
    most = w.shape[0] - n_lags + 1
    # Chunks a few times wider than tall: the triangle on top of each is then little extra work.
    width = min(max(4 * rows.shape[0], 1024), most)
    n_chunks = -(-most // width)
    record = jnp.pad(w, ((0, n_chunks * width - most), (0, 0)))
    index = np.arange(width)

    def update(upper, k):
        first = k * width
        piece = jax.lax.dynamic_slice_in_dim(record, first, width + n_lags - 1)
        formed = piece[index[:, None] + rows[None, :, 0], rows[None, :, 1]]
        if constant:
            formed = jnp.concatenate([jnp.ones((width, 1)), formed], axis=1)
        formed = jnp.where((first + index < columns)[:, None], formed, 0.0)
        return jnp.linalg.qr(jnp.concatenate([upper, formed]), mode="r"), None

    return jax.lax.scan(update, upper, jnp.arange(n_chunks))[0]


def lower_factor(upper: Float[Array, "row row"], constant: bool) -> Float[Array, "kept kept"]:
    """The factor of what is left beside the constant."""
    return upper[constant:, constant:].T
