"""Records from the command line's arguments, and how a model is identified from them."""

import argparse
import os
from collections.abc import Sequence
from typing import Any

from jaxtyping import Array, Float

from lpvid.commands._errors import UsageError
from lpvid.data import IOData, Offset, preprocess, read
from lpvid.identify import (
    CVA,
    N4SID,
    ORSE,
    AbstractSubspaceMethod,
    ContinuousTimeCVA,
    ContinuousTimeMOESP,
    ContinuousTimeN4SID,
    PastInputMOESP,
    PastOutputMOESP,
)
from lpvid.identify.gray_box import AbstractContinuousTimeMethod

_METHODS = {
    "po-moesp": PastOutputMOESP,
    "pi-moesp": PastInputMOESP,
    "n4sid": N4SID,
    "cva": CVA,
    "orse": ORSE,
}
_CONTINUOUS = {
    "continuous-moesp": ContinuousTimeMOESP,
    "continuous-n4sid": ContinuousTimeN4SID,
    "continuous-cva": ContinuousTimeCVA,
}


def check_columns(arguments: argparse.Namespace) -> None:
    """Raise where a column has two parts, or options contradict one another."""
    parts = [("--input", name) for name in arguments.input]
    parts += [("--output", name) for name in arguments.output]
    # Only some commands have a schedule.
    parts += [("--schedule", name) for name in getattr(arguments, "schedule", ())]
    parts += [("--time", arguments.time)] if arguments.time is not None else []
    seen: dict[str, str] = {}
    for option, name in parts:
        if name in seen:
            where = (
                f"twice in {option}" if seen[name] == option else f"in {seen[name]} and {option}"
            )
            raise UsageError(f"the column {name!r} is {where}; give it one part")
        seen[name] = option
    if arguments.resample and arguments.time is None:
        raise UsageError("--resample needs the time column: give --time")


def read_records(
    arguments: argparse.Namespace, files: Sequence[str], scheduling: Sequence[str] = ()
) -> IOData:
    """One record from each file, by the columns and the clock of the arguments."""
    for file in files:
        if not os.path.exists(file):
            raise UsageError(f"{file}: no such file; check the path and the working folder")
    return read(
        list(files),
        inputs=arguments.input,
        outputs=arguments.output,
        scheduling=list(scheduling),
        time=arguments.time,
        dt=arguments.dt,
        resample=arguments.resample,
    )


def without_offsets(
    arguments: argparse.Namespace, data: IOData, *others: IOData
) -> tuple[Offset | None, list[IOData]]:
    """`data` and others, both freed of the means of `data`, unless offsets are to be kept."""
    if arguments.keep_offsets:
        return None, [data, *others]
    offset = Offset.mean_of(data)
    return offset, [preprocess(part, offset)[0] for part in (data, *others)]


def offsets_of(offset: Offset | None) -> dict[str, Any] | None:
    """The offsets, one row a record, as the JSON files hold them: means, and what a fit added."""
    return None if offset is None else {"u": offset.u, "y": offset.y}


def subspace_method(arguments: argparse.Namespace) -> AbstractSubspaceMethod:
    """The discrete-time method that the arguments describe.

    With offsets removed it estimates what the means of the records leave of them.
    """
    return _METHODS[arguments.method](
        order=arguments.order,
        block_rows=arguments.block_rows,
        stabilise=False if arguments.stabilise is None else arguments.stabilise,
        offset=not arguments.keep_offsets,
    )


def any_method(
    arguments: argparse.Namespace,
) -> AbstractSubspaceMethod | AbstractContinuousTimeMethod:
    """The method that the arguments describe, in discrete or in continuous time.

    Raises:
        UsageError: an option that the method does not have.
    """
    if arguments.method not in _CONTINUOUS:
        if arguments.tau is not None:
            raise UsageError(f"--tau is for {', '.join(_CONTINUOUS)}")
        return subspace_method(arguments)
    if arguments.stabilise is not None:
        raise UsageError(f"--stabilise is for {', '.join(_METHODS)}")
    return _CONTINUOUS[arguments.method](
        order=arguments.order, tau=arguments.tau, block_rows=arguments.block_rows
    )


def with_rest(offset: Offset, rest: Float[Array, "*record ny"]) -> Offset:
    """The offsets as a fit knows them: the means, and what they have left of the outputs'.

    The mean of a record is not quite its offset: a slow response moves it. The rest is of each
    record, or one for all where the fit estimates it so.
    """
    return Offset(u=offset.u, y=offset.y + (rest[None] if rest.ndim == 1 else rest))
