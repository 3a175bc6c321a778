"""What the user passes as a signal, made a list of time-major float64 records, or refused."""

import math
from collections.abc import Sequence
from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

# One array, or a list with one array a record.
Signals: TypeAlias = ArrayLike | Sequence[Any]

# Samples stay NumPy arrays until the record is complete: JAX would compile each slice and join anew
# for each length. Only tracers, which have no samples yet, go through JAX.
Samples: TypeAlias = Float[Array, "..."] | Float[np.ndarray, "..."]

# A one-dimensional kappa that does not match the record is read as a constant operating point only
# if it is this short; a longer one is far more likely a time series of the wrong length.
_LONGEST_OPERATING_POINT = 16


def as_records(signal: Signals, argument: str) -> list[Samples]:
    """Split a public argument into records (time, channel).

    Args:
        signal: what the user gave.
        argument: its name, for messages.

    Raises:
        ValueError: an ambiguous shape, or values that are not real numbers.
    """
    if isinstance(signal, list | tuple):
        if len(signal) == 0:
            raise ValueError(f"{argument} is empty: give one array, or one array for each record.")
        if any(isinstance(entry, list | tuple) for entry in signal):
            raise ValueError(
                f"{argument} is a nested list, which could mean records or rows: wrap it in "
                f"numpy.asarray for one record, or give a list of arrays for several records."
            )
        if all(np.ndim(entry) == 0 for entry in signal):
            return [_as_record(_as_float(signal, argument), argument)]
        return [
            _as_record(_as_float(entry, f"{argument}[{index}]"), f"{argument}[{index}]")
            for index, entry in enumerate(signal)
        ]
    array = _as_float(signal, argument)
    if array.ndim == 3:
        if array.shape[0] == 0:
            raise ValueError(
                f"{argument} has shape {array.shape}, so no record: give at least one."
            )
        return [_as_record(array[index], f"{argument}[{index}]") for index in range(len(array))]
    return [_as_record(array, argument)]


def as_scheduling(kappa: Signals, lengths: tuple[int, ...]) -> list[Samples]:
    """Scheduling records (time, nk) of the given lengths; constants are broadcast over time.

    Raises:
        ValueError: another number of records or samples.
    """
    several = len(lengths) > 1
    if isinstance(kappa, list | tuple) and any(np.ndim(entry) > 0 for entry in kappa):
        entries = list(kappa)
    elif several and np.ndim(kappa) > 0:
        array = _as_float(kappa, "kappa")
        entries = [array[index] for index in range(array.shape[0])]
    elif several:
        entries = [kappa] * len(lengths)
    else:
        array = _as_float(kappa, "kappa")
        entries = list(array) if array.ndim == 3 else [array]
    if len(entries) != len(lengths):
        raise ValueError(
            f"kappa has {len(entries)} entries along its first axis but there are {len(lengths)} "
            f"records: give a scalar for all, or one entry (constant or time series) a record."
        )
    return [
        _as_schedule(_as_float(entry, "kappa"), length, f"kappa[{index}]" if several else "kappa")
        for index, (entry, length) in enumerate(zip(entries, lengths, strict=True))
    ]


def check_finite(
    signal: Samples,
    argument: str,
    names: tuple[str, ...],
    lengths: tuple[int, ...],
) -> None:
    """Find out whether all samples are finite; tracers have no values yet and pass.

    Raises:
        ValueError: naming the channel, record and sample that is not.
    """
    if isinstance(signal, Tracer):
        return
    finite = np.isfinite(signal)
    if finite.all():
        return
    row, column = (int(index) for index in np.argwhere(~finite)[0])
    record = int(np.searchsorted(np.cumsum(lengths), row, side="right"))
    sample = row - sum(lengths[:record])
    where = f"sample {sample}" + (f" of record {record}" if len(lengths) > 1 else "")
    raise ValueError(
        f"{argument} is not finite: channel {names[column]!r}, {where} is "
        f"{float(signal[row, column])}. Cut the record there, or interpolate the gap first."
    )


def split_records(signal: Any, lengths: tuple[int, ...]) -> list[Any]:
    """Take a stacked signal apart into its records; NumPy views unless it is traced."""
    signal = signal if isinstance(signal, Tracer) else np.asarray(signal)
    ends = np.cumsum(lengths).tolist()
    return [signal[end - length : end] for length, end in zip(lengths, ends, strict=True)]


def stack_records(records: list[Samples], argument: str) -> Samples:
    """Records one after the other, (time, channel).

    Raises:
        ValueError: their channels differ in number.
    """
    for number, record in enumerate(records):
        if record.shape[1] != records[0].shape[1]:
            raise ValueError(
                f"{argument}[{number}] has {record.shape[1]} channel(s) but {argument}[0] has "
                f"{records[0].shape[1]}: every record needs the same channels."
            )
    if len(records) == 1:
        return records[0]
    traced = any(isinstance(record, Tracer) for record in records)
    return (jnp if traced else np).concatenate(records)


def common_lengths(inputs: list[Samples], outputs: list[Samples]) -> tuple[int, ...]:
    """Length of each record, equal for inputs and outputs.

    Raises:
        ValueError: numbers of records or samples differ.
    """
    if len(inputs) != len(outputs):
        raise ValueError(
            f"y has {len(outputs)} record(s) but u has {len(inputs)}: give both for every record."
        )
    for number, (u, y) in enumerate(zip(inputs, outputs, strict=True)):
        if u.shape[0] != y.shape[0]:
            where = f" in record {number}" if len(inputs) > 1 else ""
            raise ValueError(
                f"y has {y.shape[0]} samples but u has {u.shape[0]}{where}: they must cover the "
                f"same samples; cut the longer one."
            )
    return tuple(u.shape[0] for u in inputs)


def sample_time(dt: Any) -> float:
    """The sample time as a Python float, positive.

    Raises:
        ValueError: it is not positive and finite, or a tracer.
    """
    if isinstance(dt, Tracer):
        raise ValueError("dt is traced: it is static; pass a Python float from outside jit.")
    dt = float(dt)
    if not (math.isfinite(dt) and dt > 0):
        raise ValueError(f"dt is {dt}: give the sample time in seconds, positive and finite.")
    return dt


def _as_float(given: Any, argument: str) -> Samples:
    signal: Any = given
    if isinstance(given, list | tuple) and any(isinstance(x, Tracer) for x in given):
        signal = jnp.stack([jnp.asarray(x, float) for x in given])
    if isinstance(signal, Tracer):
        if jnp.issubdtype(signal.dtype, jnp.complexfloating):
            raise ValueError(f"{argument} holds {signal.dtype} values: give real numbers.")
        return jnp.asarray(signal, float)
    # A mask lost in conversion would pass made-up samples on; NaN is found and named.
    if isinstance(signal, np.ma.MaskedArray):
        signal = np.ma.filled(signal.astype(float), np.nan)
    array = np.asarray(signal)
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{argument} holds {array.dtype} values: give an array of real numbers.")
    return array.astype(float, copy=False)


def _as_record(array: Samples, argument: str) -> Samples:
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2:
        raise ValueError(
            f"{argument} has shape {array.shape}: a record is (time,) or (time, channel), and "
            f"(record, time, channel) holds several records."
        )
    samples, channels = array.shape
    if channels == 0:
        raise ValueError(f"{argument} has shape {array.shape}, so no channel: give at least one.")
    if samples < 2:
        raise ValueError(
            f"{argument} has {samples} sample(s) (shape {array.shape}): a record needs 2 or more. "
            f"Signals are time-major (time, channel); transpose if time is the second axis."
        )
    if channels > samples:
        raise ValueError(
            f"{argument} has {channels} channels but only {samples} samples (shape "
            f"{array.shape}): signals are time-major (time, channel); transpose it."
        )
    return array


def _as_schedule(array: Samples, length: int, argument: str) -> Samples:
    if array.ndim == 2:
        array = _as_record(array, argument)
        if array.shape[0] != length:
            raise ValueError(
                f"{argument} has {array.shape[0]} samples but u has {length}: they must cover the "
                f"same samples; cut the longer one."
            )
        return array
    if array.ndim > 2:
        raise ValueError(f"{argument} has shape {array.shape}: give (time, nk), (nk,) or a scalar.")
    if array.ndim == 1 and array.shape[0] == length:
        return array[:, None]
    constant = array[None] if array.ndim == 0 else array
    if not 0 < constant.shape[0] <= _LONGEST_OPERATING_POINT:
        raise ValueError(
            f"{argument} has {constant.shape[0]} entries: neither the record's {length} samples "
            f"nor a constant operating point (1 to {_LONGEST_OPERATING_POINT} entries). Cut it to "
            f"the record, or give it as (time, nk)."
        )
    xp = jnp if isinstance(constant, Tracer) else np
    return xp.broadcast_to(constant[None, :], (length, constant.shape[0]))
