"""The least error that records allow, where they were made to show it: periods and repeats."""

from typing import NamedTuple

import numpy as np
import scipy.signal

from lpvid.data import IOData

_SAME = 1e-6
"""Mean square difference of two inputs, over the variance, up to which they are one input."""

_OTHER = 0.1
"""The same from which they are not: a period is looked for beyond the first such lag."""

_SETTLING = 0.2
"""Share of each of several equal records that their different starts may be seen in."""

_LEAST = 32
"""Differences that the noise of an output is estimated from at least."""


class NoiseFloor(NamedTuple):
    """Noise that no model can predict from the input.

    Attributes:
        spread: standard deviation of each output (ny,).
        source: how it was found, in words.
    """

    spread: np.ndarray
    source: str


def measured_floor(records: tuple[IOData, ...]) -> NoiseFloor | None:
    """Noise from what the same input gave at different times; `None` where none came twice.

    From whole periods of a periodic input, the first period left out while it settles; else from
    records of the same input, the first fifth left out. The mean over phase of the variance over
    periods or repeats. In closed loop, where the input carries the noise, nothing comes twice.

    Args:
        records: single records of one plant, estimation and held-out data alike.
    """
    spread = _pooled([_over_periods(record) for record in records])
    if spread is not None:
        return NoiseFloor(spread, "measured, from the differences between the input's periods")
    groups: list[list[IOData]] = []
    for record in records:
        for group in groups:
            if _same_input(group[0], record):
                group.append(record)
                break
        else:
            groups.append([record])
    spread = _pooled([_over_repeats(group) for group in groups if len(group) > 1])
    if spread is not None:
        return NoiseFloor(spread, "measured, from the differences between repeated records")
    return None


def _pooled(found: list[tuple[np.ndarray, int] | None]) -> np.ndarray | None:
    """Root of the mean of (sum of squares (ny,), degrees of freedom)."""
    known = [one for one in found if one is not None]
    degrees = sum(count for _, count in known)
    if degrees < _LEAST:
        return None
    return np.sqrt(sum(squares for squares, _ in known) / degrees)


def period_of(u: np.ndarray) -> int | None:
    """Samples after which an input comes again, if it does twice or more.

    Args:
        u: (time, nu).
    """
    samples = u.shape[0]
    longest = samples // 2
    centred = u - u.mean(axis=0)
    power = np.maximum(np.mean(centred**2, axis=0), 1e-300)
    scaled = centred / np.sqrt(power)
    overlaps = samples - np.arange(longest + 1)
    products = sum(
        scipy.signal.correlate(column, column, method="fft")[samples - 1 : samples + longest]
        for column in scaled.T
    )
    squares = np.concatenate([[0.0], np.cumsum(np.sum(scaled**2, axis=1))])
    early, late = squares[overlaps], squares[-1] - squares[: longest + 1]
    difference = (early + late - 2.0 * products) / overlaps / u.shape[1]
    moved = np.flatnonzero(difference > _OTHER)
    if not moved.size:
        return None
    # Products of long records lose digits: what looks the same is looked at again below.
    again = moved[0] + np.flatnonzero(difference[moved[0] :] < 1e2 * _SAME)
    for lag in again:
        if np.all(np.mean((u[lag:] - u[:-lag]) ** 2, axis=0) <= _SAME * power):
            return int(lag)
    return None


def _over_periods(record: IOData) -> tuple[np.ndarray, int] | None:
    y = np.asarray(record.y)
    period = period_of(np.asarray(record.u))
    if period is None or y.shape[0] // period < 3 or _scheduled(record, period):
        return None
    count = y.shape[0] // period
    # From the end, so that what is left over counts as settling too.
    periods = y[-(count - 1) * period :].reshape(count - 1, period, -1)
    return _spread_over(periods)


def _spread_over(repeats: np.ndarray) -> tuple[np.ndarray, int]:
    """Sum of squares over repeats (repeat, phase, ny), and degrees of freedom."""
    off = repeats - repeats.mean(axis=0)
    return np.sum(off**2, axis=(0, 1)), (repeats.shape[0] - 1) * repeats.shape[1]


def _scheduled(record: IOData, period: int) -> bool:
    """Whether the scheduling differs from one period to the next."""
    if record.kappa is None:
        return False
    kappa = np.asarray(record.kappa)
    spread = np.maximum(np.var(kappa, axis=0), 1e-300)
    moved = np.mean((kappa[period:] - kappa[:-period]) ** 2, axis=0)
    return bool(np.any(moved > _SAME * np.maximum(spread, np.mean(kappa**2, axis=0))))


def _same_input(first: IOData, second: IOData) -> bool:
    if first.n_samples != second.n_samples:
        return False
    pairs = [(first.u, second.u)]
    if first.kappa is not None and second.kappa is not None:
        pairs.append((first.kappa, second.kappa))
    for one, other in pairs:
        one, other = np.asarray(one), np.asarray(other)
        size = np.maximum(np.mean(one**2, axis=0), 1e-300)
        if np.any(np.mean((one - other) ** 2, axis=0) > _SAME * size):
            return False
    return True


def _over_repeats(group: list[IOData]) -> tuple[np.ndarray, int]:
    settled = int(_SETTLING * group[0].n_samples)
    return _spread_over(np.stack([np.asarray(one.y)[settled:] for one in group]))
