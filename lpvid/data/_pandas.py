"""pandas data frames."""

from typing import Any

import numpy as np

from lpvid.data._assemble import Columns, assemble, make_request, missing_column
from lpvid.data._errors import DataError
from lpvid.data._io_data import IOData


def from_pandas(
    frame: Any,
    *,
    inputs: Columns,
    outputs: Columns,
    scheduling: Columns = (),
    time: str | None = None,
    dt: float | None = None,
    resample: bool = False,
) -> IOData:
    """One record from the columns of a pandas `DataFrame`.

    pandas itself is not needed by this library.

    Args:
        frame: the data frame.
        inputs: as for `read_csv`.
        outputs: as for `read_csv`.
        scheduling: as for `read_csv`.
        time: a column or the index, in seconds or of a date-time or time-delta type.
        dt: as for `read_csv`.
        resample: as for `read_csv`.

    Raises:
        DataError: (a `ValueError`) naming column and row (counted from 0), as `read_csv`.

    Example:
        >>> import pandas as pd
        >>> from lpvid.data import from_pandas
        >>> frame = pd.DataFrame({"u": [1.0, 2.0, 3.0], "y": [5.0, 6.0, 7.0]})
        >>> from_pandas(frame, inputs="u", outputs="y", dt=0.01)
        IOData(3 samples, 1 input (u), 1 output (y), dt=0.01 s)
    """
    source = "data frame"
    if not hasattr(frame, "columns") or not hasattr(frame, "index"):
        raise DataError(f"frame is a {type(frame).__name__}: give a pandas DataFrame.")
    request = make_request(source, inputs, outputs, scheduling, time, dt, resample)
    # By number, so that names may be any label and repeated ones are noticed.
    labels = [str(label) for label in frame.columns]
    columns = {}
    for name in request.columns:
        if labels.count(name) > 1:
            raise DataError(f"{source}: column {name!r} appears {labels.count(name)} times.")
        if name in labels:
            series = frame.iloc[:, labels.index(name)]
        elif name == request.time and name == str(frame.index.name):
            series = frame.index
        else:
            raise missing_column(source, name, labels)
        columns[name] = {name: _values(source, name, series)}
    return assemble(source, request, columns, lambda row: f"row {row}")


def _values(source: str, name: str, series: Any) -> np.ndarray:
    values = series.to_numpy()
    if values.dtype.kind in "mM":
        missing = np.isnat(values)
        seconds = (values - values[:1]) / np.timedelta64(1, "s")
        return np.where(missing, np.nan, seconds)
    try:
        # pandas' own missing value becomes NaN, which is reported with its row.
        return series.to_numpy(dtype=float, na_value=np.nan)
    except (ValueError, TypeError):
        row, value = next((i, v) for i, v in enumerate(values) if not _is_number(v))
        raise DataError(
            f"{source}, row {row}, column {name!r}: {value!r} is not a number."
        ) from None


def _is_number(value: Any) -> bool:
    try:
        float(value)
    except (ValueError, TypeError):
        return False
    return True
