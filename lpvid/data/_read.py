"""One reader for every format, one or several files."""

import math
import os
from collections.abc import Sequence
from pathlib import Path

from lpvid.data._assemble import Columns
from lpvid.data._csv import read_csv
from lpvid.data._errors import DataError
from lpvid.data._io_data import IOData
from lpvid.data._join import join
from lpvid.data._mat import read_mat
from lpvid.data._npz import read_npz

_READERS = {
    ".csv": read_csv,
    ".txt": read_csv,
    ".dat": read_csv,
    ".tsv": read_csv,
    ".mat": read_mat,
    ".npz": read_npz,
}


def read(
    path: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    inputs: Columns,
    outputs: Columns,
    scheduling: Columns = (),
    time: str | int | None = None,
    dt: float | None = None,
    resample: bool = False,
) -> IOData:
    """Read records from one file, or one record from each of several.

    The suffix says how: `.csv`, `.txt`, `.dat` and `.tsv` by `read_csv`, `.mat` by `read_mat`,
    `.npz` by `read_npz`.

    Args:
        path: the file, or several.
        inputs: as for `read_csv`.
        outputs: as for `read_csv`.
        scheduling: as for `read_csv`.
        time: as for `read_csv`.
        dt: as for `read_csv`.
        resample: as for `read_csv`.

    Raises:
        DataError: (a `ValueError`) for another suffix, no file at all, files whose sample times or
            channels differ, and whatever the reader raises.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import read
        >>> for name in ("low.npz", "high.npz"):
        ...     np.savez(name, u=np.ones(50), y=np.ones(50))
        >>> read(["low.npz", "high.npz"], inputs="u", outputs="y", dt=0.1)
        IOData(50 samples x 2 records, 1 input (u), 1 output (y), dt=0.1 s)
    """
    paths = [path] if isinstance(path, str | os.PathLike) else list(path)
    if not paths:
        raise DataError("read: no path given; give one path or a list of them.")
    parts = []
    for one in paths:
        suffix = Path(one).suffix.lower()
        if suffix not in _READERS:
            raise DataError(
                f"{one}: the suffix {suffix!r} is not known ({', '.join(_READERS)}); call the "
                f"reader that fits, read_csv, read_mat or read_npz."
            )
        part = _READERS[suffix](
            one,
            inputs=inputs,
            outputs=outputs,
            scheduling=scheduling,
            time=time,
            dt=dt,
            resample=resample,
        )
        # Found here, where the files' names are known; `join` knows numbers only.
        if parts and not math.isclose(part.dt, parts[0].dt, rel_tol=1e-6):
            raise DataError(
                f"{one}: the sample time is {part.dt:g} s but {paths[0]} has {parts[0].dt:g} s; "
                f"read them apart and decimate one."
            )
        if parts and part.names != parts[0].names:
            raise DataError(
                f"{one}: the channels are {part.names} but {paths[0]} has {parts[0].names}."
            )
        parts.append(part)
    return join(parts)
