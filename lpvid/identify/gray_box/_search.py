"""Where τ and i are looked for, and the best of what was found."""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from lpvid.data import IOData
from lpvid.identify._checks import check_varying
from lpvid.identify.gray_box._methods import AbstractContinuousTimeMethod

# τ is looked for from these multiples of 1 / (bandwidth in rad/s).
_TAU_RANGE = (0.2, 3.0)
_TAU_COUNT = 8
_BLOCK_ROWS = (4, 6, 10)
# What rounding of the Gram matrix leaves of a row that others explain.
UNEXCITED = 1e-12
# Share of the largest singular value that rounding of the Gram matrix may leave.
NEGLIGIBLE = 1e-6


class FilterSearch(eqx.Module):
    """All filters that were tried.

    Attributes:
        tau: time constants in s, (candidate,).
        block_rows: numbers of rows, (candidate,).
        fit: simulation fit (BFT) to the identification data in percent, (candidate, ny); NaN where
            the candidate has no finite response.
    """

    tau: Float[Array, " candidate"]
    block_rows: Int[Array, " candidate"]
    fit: Float[Array, "candidate ny"]


def bandwidth(data: IOData) -> float:
    """Frequency in rad/s below which 90 % of the outputs' derivative's power above the noise lies.

    Averages the spectra of all records in narrow bands and takes the top quarter of the frequencies
    for noise.
    """
    longest = max(data.lengths)
    frequency = np.fft.rfftfreq(longest, data.dt) * 2.0 * np.pi
    power = np.zeros(frequency.size)
    total = np.maximum(np.var(np.asarray(data.y), axis=0), np.finfo(float).tiny)
    for record in data.records:
        y = np.asarray(record.y)
        # Without the window the record's ends would look like fast motion.
        windowed = (y - y.mean(axis=0)) * np.hanning(len(y))[:, None]
        power += np.sum(np.abs(np.fft.rfft(windowed, longest, axis=0)) ** 2 / total, axis=1)
    edges = np.unique(np.geomspace(1, frequency.size, 61).astype(int))
    counts = np.diff(edges)
    mean = np.add.reduceat(power, edges[:-1])[: counts.size] / counts
    centre = np.sqrt(frequency[edges[:-1]] * frequency[np.minimum(edges[1:], frequency.size - 1)])
    noise = power[3 * power.size // 4 :].mean()
    moving = np.where(mean > 4.0 * noise, (mean - noise) * counts * centre**2, 0.0)
    if not moving.any():
        return math.pi / (10.0 * data.dt)
    share = np.cumsum(moving) / moving.sum()
    return float(centre[np.searchsorted(share, 0.9)])


def resolve_filters(
    method: AbstractContinuousTimeMethod, data: IOData, order: int | None
) -> tuple[tuple[float, ...], tuple[int, ...]]:
    """Time constants in s and numbers of rows to try.

    Args:
        method: may fix them.
        data: the records.
        order: states needed, if known.

    Raises:
        ValueError: too few samples, an order that the rows cannot carry, τ shorter than a sample or
            longer than a record, τ left open under `jit`.
    """
    least = 2 if order is None else max(2, -(-order // data.ny) + 1)
    if method.block_rows is None:
        wanted = sorted({max(i, least) for i in _BLOCK_ROWS})
        rows = tuple(i for i in wanted if _samples_needed(i, data) <= data.n_samples)
        rows = rows or (least,)
    else:
        rows = method.block_rows
        if min(rows) < least:
            raise ValueError(
                f"block_rows={min(rows)} carries at most {(min(rows) - 1) * data.ny} states with "
                f"{data.ny} outputs, fewer than {order}: raise block_rows to {least} or more."
            )
    needed = _samples_needed(max(rows), data)
    if data.n_samples < needed:
        raise ValueError(
            f"The data have {data.n_samples} samples, but block_rows={max(rows)} with {data.nu} "
            f"inputs and {data.ny} outputs in {len(data.lengths)} record(s) needs at least "
            f"{needed}: take more samples" + (" or lower block_rows." if max(rows) > least else ".")
        )
    return _time_constants(method, data), rows


def _time_constants(method, data):
    duration = max(data.lengths) * data.dt
    if method.tau is not None:
        for tau in method.tau:
            if not 0.5 * data.dt <= tau <= 0.5 * duration:
                raise ValueError(
                    f"tau={tau} s lies outside [dt/2, duration/2] = [{0.5 * data.dt:.3g}, "
                    f"{0.5 * duration:.3g}] s of the data: give tau in seconds, near the period of "
                    f"the fastest mode over 2 pi, or None for a search."
                )
        return method.tau
    if isinstance(data.y, Tracer):
        raise ValueError(
            "tau=None looks at the records and cannot run under jit, vmap or lax.map: give tau, "
            "one or several."
        )
    centre = 1.0 / bandwidth(data)
    # A filter faster than two samples sees the hold, one slower than the record nothing.
    low = min(max(_TAU_RANGE[0] * centre, 2.0 * data.dt), 0.02 * duration)
    high = max(min(_TAU_RANGE[1] * centre, 0.05 * duration), 1.5 * low)
    return tuple(np.geomspace(low, high, _TAU_COUNT).tolist())


def _samples_needed(block_rows: int, data: IOData) -> int:
    """Twice as many samples as unknown directions, transients included."""
    return 2 * (2 * block_rows * (data.nu + data.ny) + 2 * block_rows * len(data.lengths))


def check_excitation(data: IOData, found: tuple, block_rows: int) -> None:
    """Look whether every channel moved, and the inputs enough at some filter.

    Raises:
        ValueError: naming a constant channel, or saying that the inputs do not move independently.
    """
    check_varying(data)
    if max(np.max(np.asarray(pivots)) for _, _, pivots in found) > UNEXCITED:
        return
    names = ", ".join(data.input_names)
    raise ValueError(
        f"The inputs {names} excite too little for block_rows={block_rows}: after filtering one is "
        f"a combination of the others. Excite every input by its own random steps, binary sequence "
        f"or noise, or lower block_rows."
    )


@jax.jit
def unit_rms(
    u: Float[Array, "time nu"], y: Float[Array, "time ny"]
) -> tuple[
    Float[Array, "time nu"], Float[Array, "time ny"], Float[Array, " nu"], Float[Array, " ny"]
]:
    """Inputs and outputs of unit RMS, and what each channel was divided by."""

    def scale(signal):
        power = jnp.sqrt(jnp.mean(signal * signal, axis=0))
        return jnp.where(power > 0.0, power, 1.0)

    u_scale, y_scale = scale(u), scale(y)
    return u / u_scale[None, :], y / y_scale[None, :], u_scale, y_scale


def best(candidates: dict[str, Array]) -> Array:
    """Index of the candidate whose outputs' residuals have the least product.

    That is the likelihood of noises of unknown size. NaN candidates lose.
    """
    residual = candidates["residual"]
    cost = jnp.sum(jnp.log(residual + jnp.finfo(float).tiny), axis=1)
    return jnp.argmin(jnp.where(jnp.isfinite(cost), cost, jnp.inf))


def search_table(
    taus: Float[Array, " tau"],
    rows: tuple[int, ...],
    residual: Float[Array, "candidate ny"],
    y: Float[Array, "time ny"],
    lengths: tuple[int, ...],
) -> FilterSearch:
    """Normalised fit of each candidate in percent, at least 0, from sums of squared errors.

    Candidates are ordered by number of rows, then by τ.
    """
    moved, start = jnp.zeros(y.shape[1]), 0
    for length in lengths:
        record = y[start : start + length]
        moved += jnp.sum((record - jnp.mean(record, axis=0, keepdims=True)) ** 2, axis=0)
        start += length
    return FilterSearch(
        tau=jnp.tile(taus, len(rows)),
        block_rows=jnp.repeat(jnp.asarray(rows), taus.shape[0]),
        fit=100.0 * jnp.maximum(1.0 - jnp.sqrt(residual / moved[None, :]), 0.0),
    )


class FilterFacts(NamedTuple):
    """What the data said at one filter.

    Attributes:
        pivot: smallest share of a filtered input that the others do not explain, in squares.
        singular_values: with zeros behind those of fewer rows than the most.
    """

    pivot: Float[Array, ""]
    singular_values: Float[Array, " row"]


def describe_filters(found: tuple, index: Array, n_taus: int) -> FilterFacts:
    """Pivot and singular values of `ranges` at one candidate."""
    which_rows, which_tau = index // n_taus, index % n_taus
    longest = max(values.shape[1] for _, values, _ in found)
    padded = [jnp.pad(values, ((0, 0), (0, longest - values.shape[1]))) for _, values, _ in found]
    return FilterFacts(
        pivot=jnp.stack([pivots for _, _, pivots in found])[which_rows, which_tau],
        singular_values=jnp.stack(padded)[which_rows, which_tau],
    )
