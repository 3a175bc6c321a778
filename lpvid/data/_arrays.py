"""Files of named arrays: which are columns, and how an array becomes several."""

import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from lpvid.data._assemble import Columns, assemble, make_request, missing_column
from lpvid.data._errors import DataError
from lpvid.data._files import file_bytes
from lpvid.data._io_data import IOData

_ONE_COLUMN = re.compile(r"(.+)\[(\d+)\]")


def read_arrays(
    path: str | os.PathLike[str],
    load: Callable[[Path, bytes], Mapping[str, np.ndarray]],
    inputs: Columns,
    outputs: Columns,
    scheduling: Columns,
    time: str | int | None,
    dt: float | None,
    resample: bool,
) -> IOData:
    """One record from a file of arrays; the other arguments are those of `read_csv`.

    Args:
        load: opens the file: its path and content in, arrays by name out.
    """
    path = Path(path)
    source = str(path)
    request = make_request(source, inputs, outputs, scheduling, time, dt, resample)
    arrays = load(path, file_bytes(path))
    columns = {name: _columns(source, name, arrays) for name in request.columns}
    return assemble(source, request, columns, lambda row: f"sample {row}")


def _columns(source: str, name: str, arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The vectors an array's name stands for: `acc` all its columns, `acc[0]` the first."""
    index = None
    if name not in arrays and (match := _ONE_COLUMN.fullmatch(name)):
        name, index = match[1], int(match[2])
    if name not in arrays:
        raise missing_column(source, name, [key for key in arrays if _is_column(arrays[key])])
    array = arrays[name]
    if array.dtype.kind not in "biuf":
        raise DataError(f"{source}: {name!r} holds {array.dtype} values, not real numbers.")
    if not _is_column(array):
        raise DataError(
            f"{source}: {name!r} has shape {array.shape}, which is no column of samples; give a "
            f"constant such as the sample time by its value (dt=)."
        )
    array = array.astype(float)
    # MATLAB keeps a vector as a row as readily as a column: there is only one way to read it.
    if array.ndim == 1 or array.shape[0] == 1:
        array = array.reshape(-1, 1)
    samples, channels = array.shape
    if channels > samples:
        raise DataError(
            f"{source}: {name!r} has {channels} columns but only {samples} samples; store it "
            f"time-major (time, channel): transpose it."
        )
    if index is not None and index >= channels:
        raise DataError(
            f"{source}: {name}[{index}] is not there: {name!r} has {channels} column(s), "
            f"{name}[0] to {name}[{channels - 1}]."
        )
    if channels == 1:
        return {name: array[:, 0]}
    chosen = range(channels) if index is None else (index,)
    return {f"{name}[{column}]": array[:, column] for column in chosen}


def _is_column(array: np.ndarray) -> bool:
    return array.dtype.kind in "biuf" and array.ndim in (1, 2) and array.size > 1
