"""When a record has settled: its window of final values, and who has not settled."""

import numpy as np

from lpvid.data import IOData

_BLOCKS = 100
_LEAST_SAMPLES = 20
# Fraction of the record, at its end, that must have settled.
_TAIL = 0.2
# Drift over the tail, as a share of the output's range, up to which a record counts as settled:
# the usual band of 2 %.
_BAND = 0.02
# The deviation of a block mean from the final value is told from noise above this many standard
# deviations, themselves from some twenty blocks: one record in 10⁴ is misjudged.
_SIGNIFICANT = 7.0
_ROUNDING = 1e-13
_PRACTICALLY = 1e-3
# The settled window starts this much later than the last deviation that is told from noise: the
# remainder has then fallen well below it.
_MARGIN = 4.0 / 3.0


class Settling:
    """Settling of one record, in samples from its start.

    Attributes:
        window: where the settled window starts.
        practically: from where all signals keep within a thousandth of their range, or the noise.
        inputs: from where the inputs do.
    """

    def __init__(self, window: int, practically: int, inputs: int):
        self.window, self.practically, self.inputs = window, practically, inputs


def find_onset(u: np.ndarray) -> int:
    """First sample at which an input of a record (time, nu) is not zero."""
    moving = np.any(np.abs(u) > 1e-9 * np.abs(u).max(), axis=1)
    return int(np.argmax(moving))


def check_rest(y: np.ndarray, onset: int, ranges: np.ndarray, names, number: int) -> None:
    """Outputs lie at zero before the inputs move.

    Raises:
        ValueError: naming the output and its resting value.
    """
    if onset < 2:
        return
    before = y[:onset]
    mean = before.mean(axis=0)
    allowed = _BAND * ranges + 5.0 * before.std(axis=0, ddof=1) / np.sqrt(onset)
    for channel in np.flatnonzero(np.abs(mean) > allowed):
        raise ValueError(
            f"Output {names[channel]!r} of record {number} stands at {mean[channel]:.3g} before "
            f"its inputs move: step responses start from rest at zero. Subtract the resting values "
            f"from inputs and outputs."
        )


def find_settling(
    record: IOData, u: np.ndarray, y: np.ndarray, ranges: np.ndarray, number: int, band: float
) -> Settling:
    """Settling of one record that starts with its onset.

    Args:
        record: whose channel names the messages use.
        u: inputs from the onset on, (time, nu).
        y: outputs from the onset on, (time, ny).
        ranges: largest range of each input and output over all records, (nu + ny,).
        number: the record's number, for messages.
        band: drift over the last fifth that is tolerated, as a share of the range.

    Raises:
        ValueError: too few samples; a channel that has not settled, named, with how far from it.
    """
    time = u.shape[0]
    if time < _LEAST_SAMPLES:
        raise ValueError(
            f"Record {number} has {time} samples from the onset of its inputs: {_LEAST_SAMPLES} "
            f"are the least to see it settle; take a longer record or a smaller sample time."
        )
    names = (*record.input_names, *record.output_names)
    size = max(time // _BLOCKS, 1)
    count = time // size
    values = np.concatenate([u, y], axis=1)
    means = values[: count * size].reshape(count, size, -1).mean(axis=1)
    tail = means[-max(int(_TAIL * count), 4) :]
    final, spread = tail.mean(axis=0), tail.std(axis=0, ddof=1)
    _check_tail(tail, ranges, names, u.shape[1], number, band)

    def last_exceeding(share, channels):
        allowed = np.maximum(_SIGNIFICANT * spread, share * ranges)
        outside = np.any((np.abs(means - final) > allowed)[:, channels], axis=1)
        return int((np.flatnonzero(outside)[-1] + 1) * size) if outside.any() else 0

    everything, inputs = slice(None), slice(0, u.shape[1])
    settled = last_exceeding(_ROUNDING, everything)
    latest = max(settled, time - max(int(_TAIL * time), 4))
    moving = np.abs(u - final[: u.shape[1]]) > np.maximum(
        _SIGNIFICANT * np.sqrt(size) * spread[inputs], _PRACTICALLY * ranges[inputs]
    )
    moving = np.flatnonzero(np.any(moving, axis=1))
    return Settling(
        window=min(int(_MARGIN * settled), latest),
        practically=last_exceeding(_PRACTICALLY, everything),
        inputs=int(moving[-1]) + 1 if moving.size else 0,
    )


def _check_tail(tail, ranges, names, nu, number, band):
    blocks = tail.shape[0]
    place = np.arange(blocks) - 0.5 * (blocks - 1)
    slope = place @ tail / np.sum(place**2)
    rest = tail - tail.mean(axis=0) - np.outer(place, slope)
    noise = np.sqrt(np.sum(rest**2, axis=0) / (blocks - 2))
    drift = np.abs(slope) * blocks
    uncertainty = noise * blocks / np.sqrt(np.sum(place**2))
    for channel, name in enumerate(names):
        kind = "Input" if channel < nu else "Output"
        size = max(ranges[channel], np.finfo(float).tiny)
        if drift[channel] > band * size + 4.0 * uncertainty[channel]:
            raise ValueError(
                f"{kind} {name!r} of record {number} has not settled: over the last fifth of the "
                f"record it still moves by {100 * drift[channel] / size:.2g} % of its range, where "
                f"{100 * band:.2g} % is allowed. Record for longer, or use identify() with a rich "
                f"input for a plant that integrates."
            )
        if noise[channel] > 0.2 * size:
            raise ValueError(
                f"{kind} {name!r} of record {number} has not settled: over the last fifth of the "
                f"record it still varies with a standard deviation of "
                f"{100 * noise[channel] / size:.2g} % of its range, an oscillation or nothing but "
                f"noise. Record for longer, take larger steps, or leave it out with data.select."
            )
