"""Triangular factor of past and future data, from its Gram matrix or by reflections."""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, Int

from lpvid.identify._gram import hankel_factor, hankel_gram

Route = Literal["gram", "qr"]

# A pivot of the unit-diagonal Gram matrix is the share of a row that the rows before it do not
# explain. Below this, rounding of the Gram matrix takes more than about six digits of that row.
ILL_CONDITIONED = 1e-9
# Share below which a row counts as a linear combination of the others, by either route.
_RANK_TOLERANCE = 1e-20
_GRAM_FLOOR = 1e-13


class DataFactor(eqx.Module):
    """Blocks of the lower-triangular L in $[U_f; Z; Y_f] = L Q$, Z the instruments.

    The instruments are the past inputs, and the past outputs where the method wants them. Channels
    are scaled to unit RMS.

    Attributes:
        inputs: $L_{11}$.
        instruments_inputs: $L_{21}$.
        instruments: $L_{22}$.
        outputs_inputs: $L_{31}$.
        outputs_instruments: $L_{32}$; its range is that of the observability matrix (MOESP).
        outputs: $L_{33}$.
    """

    inputs: Float[Array, "future_inputs future_inputs"]
    instruments_inputs: Float[Array, "instruments future_inputs"]
    instruments: Float[Array, "instruments instruments"]
    outputs_inputs: Float[Array, "future_outputs future_inputs"]
    outputs_instruments: Float[Array, "future_outputs instruments"]
    outputs: Float[Array, "future_outputs future_outputs"]


class Conditioning(eqx.Module):
    """What the factor says of the data.

    Attributes:
        smallest_pivot: smallest share of a row of inputs and instruments, in squares, that the
            rows before it leave unexplained; NaN where the factorisation broke down.
        excitation_rank: independent rows among future and past inputs; `2 s nu` if they excite
            enough.
    """

    smallest_pivot: Float[Array, ""]
    excitation_rank: Int[Array, ""]


def hankel_rows(block_rows: int, nu: int, ny: int, past_outputs: bool) -> np.ndarray:
    """Delay and channel of every row of the data matrix, integers (row, 2).

    From the top: future inputs, past inputs, past outputs where they are asked for, future outputs.
    """
    past, future = range(block_rows), range(block_rows, 2 * block_rows)
    inputs, outputs = range(nu), range(nu, nu + ny)
    parts = [(future, inputs), (past, inputs)]
    parts += [(past, outputs)] if past_outputs else []
    parts += [(future, outputs)]
    return np.array([(i, c) for delays, channels in parts for i in delays for c in channels])


def data_factor(
    w: Float[Array, "time channel"],
    scale: Float[Array, " channel"],
    lengths: tuple[int, ...],
    *,
    block_rows: int,
    nu: int,
    past_outputs: bool,
    route: Route,
) -> tuple[DataFactor, Conditioning]:
    """Factor the block-Hankel matrix of inputs and outputs.

    Args:
        w: inputs, then outputs, records one after the other, (time, channel).
        scale: what each channel is divided by.
        lengths: samples in each record.
        block_rows: rows of past and of future.
        nu: how many of the channels are inputs.
        past_outputs: whether past outputs are among the instruments.
        route: "gram" for the Cholesky factor of the Gram matrix, "qr" for reflections.

    Returns:
        The factor's blocks, and what the factorisation says of the data.
    """
    ny = w.shape[1] - nu
    rows = hankel_rows(block_rows, nu, ny, past_outputs)
    weight = 1.0 / scale[rows[:, 1]]
    a = block_rows * nu
    b = rows.shape[0] - block_rows * ny
    if route == "qr":
        whole = hankel_factor(w / scale[None, :], lengths, rows)
        leading, below, corner = whole[:b, :b], whole[b:, :b], whole[b:, b:]
        power = jnp.sum(whole * whole, axis=1)
        floor = _RANK_TOLERANCE
    else:
        gram = hankel_gram(w, lengths, rows) * weight[:, None] * weight[None, :]
        power = jnp.diagonal(gram)
        leading = _cholesky(gram[:b, :b])
        below = solve_triangular(leading, gram[:b, b:], lower=True).T
        # Not needed by every method: dropped by the compiler where it is not.
        corner = _cholesky(gram[b:, b:] - below @ below.T)
        floor = _GRAM_FLOOR
    pivots = jnp.diagonal(leading) ** 2 / jnp.maximum(power[:b], jnp.finfo(float).tiny)
    conditioning = Conditioning(
        smallest_pivot=jnp.min(pivots),
        excitation_rank=jnp.sum(pivots[: 2 * a] > floor),
    )
    factor = DataFactor(
        inputs=leading[:a, :a],
        instruments_inputs=leading[a:, :a],
        instruments=leading[a:, a:],
        outputs_inputs=below[:, :a],
        outputs_instruments=below[:, a:],
        outputs=corner,
    )
    return factor, conditioning


def _cholesky(gram):
    """Cholesky factor; where the matrix is singular to rounding, that of a nearby regular one."""

    def factor(shift):
        shifted = gram + shift * jnp.diag(jnp.diagonal(gram))
        return jax.lax.linalg.cholesky(shifted, symmetrize_input=False)

    plain = factor(0.0)
    return jax.lax.cond(
        jnp.all(jnp.isfinite(jnp.diagonal(plain))),
        lambda: plain,
        # Only where the caller could not fall back to reflections, as under `jit`.
        lambda: factor(1e-12),
    )
