"""MATLAB files, up to version 7 through SciPy and version 7.3 through h5py."""

import io
import os
from pathlib import Path
from typing import Any

import numpy as np
import scipy  # its parts load when first used

from lpvid.data._arrays import read_arrays
from lpvid.data._assemble import Columns
from lpvid.data._errors import DataError
from lpvid.data._io_data import IOData

_HDF5 = b"\x89HDF\r\n\x1a\n"


def read_mat(
    path: str | os.PathLike[str],
    *,
    inputs: Columns,
    outputs: Columns,
    scheduling: Columns = (),
    time: str | None = None,
    dt: float | None = None,
    resample: bool = False,
) -> IOData:
    """Read one record from a MATLAB `.mat` file, version 4 to 7.3.

    Arrays are (time, channel) or vectors, rows or columns. The name of an array of several
    columns stands for all of them, called `acc[0]`, `acc[1]`, ... (from 0); `"acc[0]"` picks one.
    A structure's fields are called `run.u`. Scalars are no columns: pass the sample time by value.
    Version 7.3 needs the optional package h5py.

    Args:
        path: the file.
        inputs: as for `read_csv`.
        outputs: as for `read_csv`.
        scheduling: as for `read_csv`.
        time: as for `read_csv`.
        dt: as for `read_csv`.
        resample: as for `read_csv`.

    Raises:
        DataError: (a `ValueError`) naming file, array and sample, as `read_csv`; and for damaged
            files and arrays of unequal length.
        ImportError: a file of version 7.3, and h5py is not installed.

    Example:
        >>> import numpy as np
        >>> import scipy.io
        >>> from lpvid.data import read_mat
        >>> scipy.io.savemat("run.mat", {"force": np.ones(50), "acc": np.ones((50, 2))})
        >>> read_mat("run.mat", inputs="force", outputs="acc", dt=1e-3)
        IOData(50 samples, 1 input (force), 2 outputs (acc[0], acc[1]), dt=0.001 s)
    """
    return read_arrays(path, _load, inputs, outputs, scheduling, time, dt, resample)


def _load(path: Path, content: bytes) -> dict[str, np.ndarray]:
    # HDF5 starts at the beginning or after a user block; MATLAB writes one of 512 bytes.
    if any(content[start : start + len(_HDF5)] == _HDF5 for start in (0, 512, 1024, 2048)):
        return _load_hdf5(path, content)
    try:
        variables = scipy.io.loadmat(io.BytesIO(content), struct_as_record=False)
    # Which error a damaged file raises depends on where it is cut.
    except Exception as error:
        raise _damaged(path) from error
    arrays: dict[str, np.ndarray] = {}
    for name, value in variables.items():
        if not name.startswith("__"):
            _flatten(name, value, arrays)
    return arrays


def _flatten(name: str, value: Any, arrays: dict[str, np.ndarray]) -> None:
    """Keep arrays under their names and structures' fields under dotted ones."""
    value = np.asarray(value)
    if value.dtype == object and value.size == 1:
        structure = value.item()
        for field in getattr(structure, "_fieldnames", ()):
            _flatten(f"{name}.{field}", getattr(structure, field), arrays)
        return
    arrays[name] = value


def _load_hdf5(path: Path, content: bytes) -> dict[str, np.ndarray]:
    try:
        import h5py
    except ImportError as error:
        raise ImportError(
            f"{path} is a MATLAB 7.3 (HDF5) file, which needs h5py: pip install h5py, or save it "
            f"in MATLAB with the option '-v7'."
        ) from error
    arrays: dict[str, np.ndarray] = {}

    def keep(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and not name.startswith("#"):
            # MATLAB stores columns first, HDF5 rows: the axes come reversed.
            arrays[name.replace("/", ".")] = np.asarray(item[()]).T

    try:
        with h5py.File(io.BytesIO(content), "r") as file:
            file.visititems(keep)
    except Exception as error:
        raise _damaged(path) from error
    return arrays


def _damaged(path: Path) -> DataError:
    return DataError(f"{path} is truncated or not a MATLAB file; copy or save it anew.")
