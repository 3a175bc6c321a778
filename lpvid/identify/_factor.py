"""Triangular factor of past and future data, from its Gram matrix or by reflections."""

from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, Int

Route = Literal["gram", "qr"]

# A pivot of the unit-diagonal Gram matrix is the share of a row that the rows before it do not
# explain. Below this, rounding of the Gram matrix takes more than about six digits of that row.
ILL_CONDITIONED = 1e-9
# Share below which a row counts as a linear combination of the others, by either route.
RANK_TOLERANCE = {"gram": 1e-13, "qr": 1e-20}
# Diagonal of a triangle, relative to its row, below which it is inverted as a singular matrix.
_SINGULAR = 1e-8
_PSEUDO_INVERSE_CUT = 1e-10


class Layout(NamedTuple):
    """Rows of the data matrix: future inputs, past inputs, past outputs, future outputs.

    Attributes:
        block_rows: s, rows of past and of future.
        nu: inputs.
        ny: outputs.
        past_inputs: whether past inputs are there.
        past_outputs: whether past outputs are there.
    """

    block_rows: int
    nu: int
    ny: int
    past_inputs: bool
    past_outputs: bool

    @property
    def future(self) -> int:
        """Delay of the first future sample: how many past samples there are."""
        return self.block_rows if self.past_inputs or self.past_outputs else 0

    @property
    def n_lags(self) -> int:
        """Samples that a column spans."""
        return self.future + self.block_rows

    @property
    def future_inputs(self) -> int:
        """Rows of future inputs."""
        return self.block_rows * self.nu

    @property
    def input_rows(self) -> int:
        """Rows of inputs, future and past."""
        return self.future_inputs * (2 if self.past_inputs else 1)

    @property
    def known_rows(self) -> int:
        """Rows above the future outputs."""
        return self.input_rows + (self.block_rows * self.ny if self.past_outputs else 0)

    def rows(self) -> np.ndarray:
        """Delay and channel of every row, integers (row, 2)."""
        future = range(self.future, self.future + self.block_rows)
        past = range(self.future)
        inputs, outputs = range(self.nu), range(self.nu, self.nu + self.ny)
        parts = [(future, inputs)]
        parts += [(past, inputs)] if self.past_inputs else []
        parts += [(past, outputs)] if self.past_outputs else []
        parts += [(future, outputs)]
        return np.array([(i, c) for delays, channels in parts for i in delays for c in channels])

    def columns(self, lengths: tuple[int, ...]) -> int:
        """Columns of the Hankel matrices of records of these lengths; 0 if one is too short."""
        if min(lengths) < self.n_lags:
            return 0
        return sum(n - self.n_lags + 1 for n in lengths)


class DataFactor(eqx.Module):
    r"""Blocks of the lower-triangular L in $[U_f; Z; Y_f] = L Q$, Z the instruments.

    The instruments are the past inputs, and the past outputs where the method wants them. Channels
    are scaled to unit RMS and L by the square root of the number of columns: covariances.

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

    def future_root(self) -> Float[Array, "future_outputs future_outputs"]:
        """Lower triangular root of the future outputs' covariance, freed of the future inputs."""
        both = jnp.concatenate([self.outputs_instruments, self.outputs], axis=1)
        return jnp.linalg.qr(both.T, mode="r").T


class Conditioning(eqx.Module):
    """What the factor says of the data.

    Attributes:
        smallest_pivot: smallest share of a row of inputs and instruments, in squares, that the
            rows before it leave unexplained; NaN where the factorisation broke down.
        excitation_pivot: the same among the inputs alone.
        excitation_rank: independent rows among the inputs, future and past.
    """

    smallest_pivot: Float[Array, ""]
    excitation_pivot: Float[Array, ""]
    excitation_rank: Int[Array, ""]


class Factored(NamedTuple):
    """A factor, with what else came out.

    Attributes:
        factor: the blocks.
        outputs_now: first ny columns of $L_{33}$, the present outputs' own part.
        conditioning: what the factor says of the data.
    """

    factor: DataFactor
    outputs_now: Float[Array, "future_outputs ny"]
    conditioning: Conditioning


def factor_of_gram(gram: Float[Array, "row row"], layout: Layout) -> Factored:
    """Factor by Cholesky, from the Gram matrix of scaled data over the number of columns."""
    b, ny = layout.known_rows, layout.ny
    leading = _cholesky(gram[:b, :b])
    below = solve_triangular(leading, gram[:b, b:], lower=True).T
    rest = gram[b:, b:] - below @ below.T
    # Neither is needed by every method: dropped by the compiler where it is not.
    corner = _cholesky(rest)
    first = _cholesky(rest[:ny, :ny])
    now = solve_triangular(first, rest[:ny], lower=True).T
    conditioning = _conditioning(leading, jnp.diagonal(gram)[:b], layout, "gram")
    return Factored(_blocks(leading, below, corner, layout), now, conditioning)


def factor_of_triangle(whole: Float[Array, "row row"], layout: Layout) -> Factored:
    """Factor from the lower triangle that reflections gave, over the root of the columns."""
    b = layout.known_rows
    leading, below, corner = whole[:b, :b], whole[b:, :b], whole[b:, b:]
    conditioning = _conditioning(leading, jnp.sum(whole * whole, axis=1)[:b], layout, "qr")
    return Factored(_blocks(leading, below, corner, layout), corner[:, : layout.ny], conditioning)


def _blocks(leading, below, corner, layout):
    a = layout.future_inputs
    return DataFactor(
        inputs=leading[:a, :a],
        instruments_inputs=leading[a:, :a],
        instruments=leading[a:, a:],
        outputs_inputs=below[:, :a],
        outputs_instruments=below[:, a:],
        outputs=corner,
    )


def _conditioning(leading, power, layout, route):
    pivots = jnp.diagonal(leading) ** 2 / jnp.maximum(power, jnp.finfo(float).tiny)
    inputs = pivots[: layout.input_rows]
    return Conditioning(
        smallest_pivot=jnp.min(pivots),
        excitation_pivot=jnp.min(inputs),
        excitation_rank=jnp.sum(inputs > RANK_TOLERANCE[route]),
    )


def solve_lower(
    lower: Float[Array, "row row"], right: Float[Array, "row column"]
) -> Float[Array, "row column"]:
    """Solve with a lower triangle; the least-norm solution where it is singular to rounding."""
    size = jnp.linalg.norm(lower, axis=1)
    regular = jnp.all(jnp.abs(jnp.diagonal(lower)) > _SINGULAR * size)
    return jax.lax.cond(
        regular,
        lambda: solve_triangular(lower, right, lower=True),
        lambda: jnp.linalg.pinv(lower, rtol=_PSEUDO_INVERSE_CUT) @ right,
    )


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
