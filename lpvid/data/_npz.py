"""NumPy archives."""

import io
import os
from pathlib import Path

import numpy as np

from lpvid.data._arrays import read_arrays
from lpvid.data._assemble import Columns
from lpvid.data._errors import DataError
from lpvid.data._io_data import IOData


def read_npz(
    path: str | os.PathLike[str],
    *,
    inputs: Columns,
    outputs: Columns,
    scheduling: Columns = (),
    time: str | None = None,
    dt: float | None = None,
    resample: bool = False,
) -> IOData:
    """Read one record from an `.npz` archive.

    Arrays are (time,) or (time, channel). The name of an array of several columns stands for
    all of them, called `acc[0]`, `acc[1]`, ...; `"acc[0]"` picks one. Scalars are no columns: pass
    the sample time by value.

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
            archives and arrays of unequal length.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import read_npz
        >>> np.savez("level1.npz", force=np.ones(50), acc=np.ones((50, 2)))
        >>> read_npz("level1.npz", inputs="force", outputs="acc[1]", dt=1 / 400)
        IOData(50 samples, 1 input (force), 1 output (acc[1]), dt=0.0025 s)
    """
    return read_arrays(path, _load, inputs, outputs, scheduling, time, dt, resample)


def _load(path: Path, content: bytes) -> dict[str, np.ndarray]:
    damaged = f"{path} is truncated or not an .npz archive; copy or save it anew with numpy.savez."
    if not content.startswith(b"PK"):
        raise DataError(damaged)
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            return {name: _array(archive, name) for name in archive.files}
    # Which error a damaged archive raises depends on where it is cut.
    except Exception as error:
        raise DataError(damaged) from error


def _array(archive: np.lib.npyio.NpzFile, name: str) -> np.ndarray:
    try:
        return archive[name]
    except ValueError as error:
        if "pickle" not in str(error).lower():
            raise
        # Python objects are not loaded; asked for, they are refused by their type.
        return np.empty(0, object)
