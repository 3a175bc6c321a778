"""From named columns to `IOData`: what every reader shares."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

import numpy as np

from lpvid.data._errors import DataError
from lpvid.data._io_data import IOData

# A column's name, or its number from 1 in a file without header.
Columns: TypeAlias = str | int | Sequence[str | int]

# Steps may differ by this much of one step: time stamps are rounded when they are written.
_JITTER = 1e-3


@dataclasses.dataclass(frozen=True)
class Request:
    """Which columns play which part, and how the sample time is found."""

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    scheduling: tuple[str, ...]
    time: str | None
    dt: float | None
    resample: bool

    @property
    def columns(self) -> tuple[str, ...]:
        """Every column asked for, once."""
        time = () if self.time is None else (self.time,)
        return tuple(dict.fromkeys((*self.inputs, *self.outputs, *self.scheduling, *time)))


def make_request(
    source: str,
    inputs: Columns,
    outputs: Columns,
    scheduling: Columns,
    time: str | int | None,
    dt: float | None,
    resample: bool,
) -> Request:
    """Check the reader's arguments before any file is touched.

    Raises:
        DataError: no column for inputs or outputs, neither or both of `time` and `dt`, a sample
            time that is not positive and finite, or `resample` without `time`.
    """
    request = Request(
        _names(inputs),
        _names(outputs),
        _names(scheduling),
        None if time is None else str(time),
        None if dt is None else float(dt),
        resample,
    )
    for argument, chosen in (("inputs", request.inputs), ("outputs", request.outputs)):
        if not chosen:
            raise DataError(f"{source}: {argument} is empty: name at least one column.")
    if request.time is None and request.dt is None:
        raise DataError(
            f"{source}: the sample time is unknown: name the time column (time='t'), or give "
            f"dt= in seconds."
        )
    if request.time is not None and request.dt is not None:
        raise DataError(f"{source}: time and dt are both given: give one of them.")
    if request.dt is not None and not (math.isfinite(request.dt) and request.dt > 0):
        raise DataError(f"{source}: dt is {request.dt}: give seconds, positive and finite.")
    if resample and request.time is None:
        raise DataError(f"{source}: resample=True needs the time column: give time=.")
    return request


def missing_column(source: str, name: str, available: Sequence[str]) -> DataError:
    """The error for a column that is not there, listing those that are."""
    listed = ", ".join(available) if available else "none"
    return DataError(f"{source}: no column {name!r}. Available columns: {listed}.")


def assemble(
    source: str,
    request: Request,
    columns: Mapping[str, Mapping[str, np.ndarray]],
    place: Callable[[int], str],
) -> IOData:
    """One record from columns of numbers, once they are known to be sound.

    Args:
        source: what the columns come from, for messages.
        request: which columns play which part.
        columns: for each requested name its labelled vectors (time,).
        place: where a row is, counted from 0, such as "line 17", for messages.

    Raises:
        DataError: unequal lengths, samples that are not finite, fewer than two rows, or a time
            column that is several, does not increase, or is not uniform and not to be resampled.
    """
    vectors = {label: v for name in request.columns for label, v in columns[name].items()}
    _check_lengths(source, vectors)
    for label, vector in vectors.items():
        _check_finite(source, label, vector, place)
    if len(next(iter(vectors.values()))) < 2:
        raise DataError(f"{source}: only one row of samples; a record needs 2 or more.")
    if request.time is None:
        step = request.dt
    else:
        if len(columns[request.time]) > 1:
            raise DataError(
                f"{source}: time {request.time!r} has {len(columns[request.time])} columns; name "
                f"one, such as '{request.time}[0]'."
            )
        ((label, time),) = columns[request.time].items()
        _check_increasing(source, label, time, place)
        if request.resample:
            step, vectors = _resampled(time, vectors)
        else:
            step = _uniform_step(source, label, time, place)

    def stack(names: tuple[str, ...]) -> tuple[np.ndarray, list[str]]:
        labels = [label for name in names for label in columns[name]]
        return np.stack([vectors[label] for label in labels], axis=1), labels

    u, input_names = stack(request.inputs)
    y, output_names = stack(request.outputs)
    names = {"u": input_names, "y": output_names}
    kappa = None
    if request.scheduling:
        kappa, names["kappa"] = stack(request.scheduling)
    try:
        return IOData(u=u, y=y, kappa=kappa, dt=step, names=names)
    except ValueError as error:
        raise DataError(f"{source}: {error}") from error


def _names(columns: Columns) -> tuple[str, ...]:
    listed = (columns,) if isinstance(columns, str | int) else columns
    return tuple(str(column) for column in listed)


def _check_lengths(source: str, vectors: Mapping[str, np.ndarray]) -> None:
    (first, reference), *others = vectors.items()
    for label, vector in others:
        if len(vector) != len(reference):
            raise DataError(
                f"{source}: column {label!r} has {len(vector)} samples but {first!r} has "
                f"{len(reference)}; choose columns of one record."
            )


def _check_finite(source: str, label: str, vector: np.ndarray, place: Callable[[int], str]) -> None:
    bad = np.flatnonzero(~np.isfinite(vector))
    if bad.size:
        raise DataError(
            f"{source}, {place(int(bad[0]))}, column {label!r}: {vector[bad[0]]} is not a finite "
            f"number ({bad.size} such in the column); cut the file there or fill the gaps."
        )


def _check_increasing(
    source: str, label: str, time: np.ndarray, place: Callable[[int], str]
) -> None:
    back = np.flatnonzero(np.diff(time) <= 0)
    if back.size:
        row = int(back[0]) + 1
        raise DataError(
            f"{source}, {place(row)}, column {label!r}: time goes from {time[row - 1]:.9g} to "
            f"{time[row]:.9g}, but must increase; split the file into records there, or drop the "
            f"repeated rows."
        )


def _uniform_step(source: str, label: str, time: np.ndarray, place: Callable[[int], str]) -> float:
    steps = np.diff(time)
    usual = float(np.median(steps))
    deviation = np.abs(steps - usual)
    worst = int(np.argmax(deviation))
    # Time stamps far from zero cannot be told apart below their own rounding.
    rounding = 4 * np.finfo(float).eps * float(np.abs(time).max())
    if deviation[worst] > _JITTER * usual + rounding:
        raise DataError(
            f"{source}, {place(worst + 1)}, column {label!r}: time is not uniform, the step there "
            f"is {steps[worst]:.6g} s where {usual:.6g} s is usual; pass resample=True to "
            f"interpolate to a uniform grid, or give dt= instead of time= if the stamps are only "
            f"rounded."
        )
    return _tidy(float(time[-1] - time[0]) / (len(time) - 1))


def _resampled(
    time: np.ndarray, vectors: Mapping[str, np.ndarray]
) -> tuple[float, dict[str, np.ndarray]]:
    step = _tidy(float(np.median(np.diff(time))))
    # The last grid point may pass the last stamp by rounding; interpolation holds the end there.
    samples = int(np.floor((time[-1] - time[0]) / step + 1e-6)) + 1
    grid = time[0] + step * np.arange(samples)
    return step, {label: np.interp(grid, time, vector) for label, vector in vectors.items()}


def _tidy(step: float) -> float:
    """Ten digits of the step: 0.01 rather than 0.010000000000000002, the same for every file."""
    return float(f"{step:.10g}")
