"""Records cut into windows of several lengths, reduced to factors that do not grow with them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from lpvid.data import IOData

# Samples of a window on its own time grid.
_SAMPLES = 24
_MOST_SCALES = 6
# Windows that a sample is in.
OVERLAP = 6
_LEAST_WINDOWS = 10
# Values of κ that a schedule is sorted into: within a window it is taken for constant.
_BINS = 8


class Windows(NamedTuple):
    """The windows of one length, sorted by κ and reduced to triangular factors.

    A window is `samples` outputs, `step` seconds apart, and what the inputs did between them: mean
    and slope over each step. With the windows as columns of Z = [Y; U; 1], the factor L has
    L Lᵀ = Z Zᵀ, so sums of squares over all windows are those over the columns of L.

    Attributes:
        step: s between samples.
        samples: outputs in a window.
        kappas: (bin, nk).
        outputs: rows of L for the outputs, (bin, samples * ny, column).
        inputs: rows for means and slopes, (bin, samples * 2 nu, column).
        constant: the row of a constant 1, (bin, column).
        number: how many windows there are.
    """

    step: float
    samples: int
    kappas: Float[np.ndarray, "bin nk"]
    outputs: Float[np.ndarray, "bin row column"]
    inputs: Float[np.ndarray, "bin row2 column"]
    constant: Float[np.ndarray, "bin column"]
    number: int


def windows_of(data: IOData, states: int) -> list[Windows]:
    """Windows of up to six lengths, from one sample a step to a tenth of the record.

    Args:
        data: one or several records.
        states: how many the model has; a window must say more than its start.

    Raises:
        ValueError: the records are too short for a single length.
    """
    least = -(-3 * (states + data.nu) // data.ny) + 4
    samples = max(_SAMPLES, least)
    longest = max(data.lengths)
    hop = samples // OVERLAP
    total = sum(data.lengths)
    last = max(min(longest // samples, total // (samples * _LEAST_WINDOWS)), 1)
    number = min(_MOST_SCALES, 1 + int(np.log(last) / np.log(2.0)))
    strides = np.unique(np.round(np.geomspace(1, last, number)).astype(int))
    found = [_windows(data, int(stride), samples, hop) for stride in strides]
    found = [entry for entry in found if entry is not None]
    if not found:
        raise ValueError(
            f"data: the longest record has {longest} samples, {samples + 1} or more are needed for "
            f"a model of {states} states; give a longer record."
        )
    return found


def _windows(data: IOData, stride: int, samples: int, hop: int) -> Windows | None:
    u, y = np.asarray(data.u), np.asarray(data.y)
    kappa = np.zeros((len(u), 0)) if data.kappa is None else np.asarray(data.kappa)
    # The line with the step's mean and first moment of the held inputs.
    steepness = 6.0 * (np.arange(stride) - (stride - 1) / 2.0) / stride**2
    columns, places = [], []
    first = 0
    for length in data.lengths:
        record = slice(first, first + length)
        first += length
        inputs, outputs, schedule = (_smooth(part[record], stride) for part in (u, y, kappa))
        steps = (len(inputs) - 1) // stride
        if steps + 1 >= samples:
            blocks = inputs[: steps * stride].reshape(steps, stride, -1)
            mean = blocks.mean(axis=1)
            slope = np.einsum("ksj,s->kj", blocks, steepness)
            held = np.concatenate([mean, slope], axis=1)
            held = np.concatenate([held, np.zeros((1, held.shape[1]))])
            sampled, places_of = outputs[::stride], schedule[::stride]
            for start in range(0, steps + 2 - samples, hop):
                span = slice(start, start + samples)
                columns.append(np.concatenate([sampled[span].ravel(), held[span].ravel(), [1.0]]))
                places.append(places_of[span].mean(axis=0))
    if not columns:
        return None
    stacked, where = np.array(columns), np.array(places)
    bins = _bins(where)
    size = stacked.shape[1]
    factors, kappas = [], []
    for number in range(bins.max() + 1):
        part = stacked[bins == number]
        reduced = np.linalg.qr(part, mode="r") if len(part) > size else part
        factors.append(np.pad(reduced, ((0, size - len(reduced)), (0, 0))).T)
        kappas.append(where[bins == number].mean(axis=0))
    factor = np.array(factors)
    rows = samples * data.ny
    return Windows(
        step=stride * data.dt,
        samples=samples,
        kappas=np.array(kappas),
        outputs=factor[:, :rows],
        inputs=factor[:, rows:-1],
        constant=factor[:, -1],
        number=len(columns),
    )


def _smooth(signal: Float[np.ndarray, "time channel"], stride: int) -> np.ndarray:
    """Averaged three times over a step, ends cut: inputs and outputs alike, so that a linear model
    holds as before, while an input between two samples is nearly a line."""
    if stride == 1 or len(signal) <= 3 * stride:
        return signal if stride == 1 else signal[:0]
    centre = signal.mean(axis=0)
    smooth = signal - centre
    for _ in range(3):
        sums = np.concatenate([np.zeros((1, signal.shape[1])), np.cumsum(smooth, axis=0)])
        smooth = (sums[stride:] - sums[:-stride]) / stride
    return smooth + centre


def _bins(where: Float[np.ndarray, "window nk"]) -> np.ndarray:
    """Which of a few groups of neighbouring κ each window belongs to."""
    nothing = np.zeros(len(where), int)
    if where.shape[1] == 0:
        return nothing
    spread = where.std(axis=0)
    if not spread.max() > 1e-9 * max(np.abs(where).max(), 1e-300):
        return nothing
    # Sorted along the direction in which κ moves most.
    scaled = (where - where.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
    along = scaled @ np.linalg.svd(scaled, full_matrices=False)[2][0]
    width = np.ptp(along) / _BINS
    numbers = np.minimum(((along - along.min()) / width).astype(int), _BINS - 1)
    return np.unique(numbers, return_inverse=True)[1].reshape(-1)
