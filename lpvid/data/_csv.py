"""Text tables: CSV, TSV, columns between blanks; with or without a header line."""

import csv
import os
from pathlib import Path

import numpy as np

from lpvid.data._assemble import Columns, assemble, make_request, missing_column
from lpvid.data._errors import DataError
from lpvid.data._files import file_bytes
from lpvid.data._io_data import IOData

# Semicolon first: where it separates, a comma may stand inside a number or a name.
_DELIMITERS = (";", "\t", ",")
_COMMENTS = ("#", "%")


def read_csv(
    path: str | os.PathLike[str],
    *,
    inputs: Columns,
    outputs: Columns,
    scheduling: Columns = (),
    time: str | int | None = None,
    dt: float | None = None,
    resample: bool = False,
) -> IOData:
    """Read one record from a text table.

    The delimiter (comma, semicolon, tab or blanks) is found out. A first line with text in it is
    the header; names may be quoted. Without a header, columns are called "1", "2", ... (or 1, 2).
    Blank lines, and lines starting with `#` or `%` above the table, are passed over, and so is an
    empty last column. The decimal sign is a point.

    Args:
        path: the file.
        inputs: name of the input column, or several.
        outputs: name of the output column, or several.
        scheduling: name of the scheduling column, or several; none by default.
        time: name of the time column, in seconds. It must be uniform to 1e-3 of a step; the sample
            time is the mean step.
        dt: sample time in seconds, instead of `time`.
        resample: where time is not uniform, interpolate linearly to a grid at the median step.

    Raises:
        DataError: (a `ValueError`) naming file, line and column: missing columns (listing those
            there), text or nothing where a number should be, rows of unequal length, time that is
            not uniform or does not increase, values that are not finite, empty, cut-off or missing
            files.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import read_csv
        >>> rows = [[0.0, 1.0, 5.0], [0.1, 2.0, 6.0], [0.2, 3.0, 7.0]]
        >>> np.savetxt("run.csv", rows, delimiter=",", header="t,u,y", comments="")
        >>> read_csv("run.csv", inputs="u", outputs="y", time="t")
        IOData(3 samples, 1 input (u), 1 output (y), dt=0.1 s)
    """
    path = Path(path)
    source = str(path)
    request = make_request(source, inputs, outputs, scheduling, time, dt, resample)
    table = _Table(source, file_bytes(path))
    for name in request.columns:
        table.check_column(name)
    values = table.fast_values()
    if values is None:
        columns = table.slow_values(request.columns)
    else:
        columns = {name: values[:, table.header.index(name)] for name in request.columns}
    labelled = {name: {name: column} for name, column in columns.items()}
    return assemble(source, request, labelled, table.place)


class _Table:
    """The lines of a text table, its delimiter and its header."""

    def __init__(self, source: str, content: bytes):
        self.source = source
        text = _decoded(source, content)
        lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
        first = 0
        while first < len(lines) and (
            not lines[first].strip() or lines[first].lstrip().startswith(_COMMENTS)
        ):
            first += 1
        body = lines[first:]
        if not body:
            raise DataError(f"{source} holds no table: every line is blank or a comment.")
        self.delimiter = _delimiter([line for line in body[:20] if line.strip()])
        cells = self._cells(body[0])
        while len(cells) > 1 and not cells[-1]:
            cells = cells[:-1]
        has_header = any(cell and not _is_number(cell) for cell in cells)
        # An unnamed column (the row numbers some programs write) is called by its number.
        numbered = [str(number) for number in range(1, len(cells) + 1)]
        self.header = numbered
        if has_header:
            self.header = [cell or number for cell, number in zip(cells, numbered, strict=True)]
        self.first = first + has_header
        self.lines = body[has_header:]
        if not any(line.strip() for line in self.lines):
            raise DataError(f"{source} is empty below its header, line {first + 1}.")

    def check_column(self, name: str) -> None:
        """Find out whether there is exactly one column `name`.

        Raises:
            DataError: there is none, or there are several.
        """
        if name not in self.header:
            raise missing_column(self.source, name, self.header)
        if self.header.count(name) > 1:
            numbers = [str(i + 1) for i, other in enumerate(self.header) if other == name]
            raise DataError(
                f"{self.source}: column {name!r} appears {len(numbers)} times (columns "
                f"{' and '.join(numbers)}); rename one in the file."
            )

    def place(self, row: int) -> str:
        """Where a row of numbers is in the file."""
        numbered = [i for i, line in enumerate(self.lines, self.first + 1) if line.strip()]
        return f"line {numbered[row]}"

    def fast_values(self) -> np.ndarray | None:
        """Every column at once through NumPy; `None` where the file is not that simple."""
        lines = self.lines
        if self.delimiter is not None:
            delimiter = self.delimiter
            lines = [line.rstrip(" ").removesuffix(delimiter) for line in lines]
        try:
            values = np.loadtxt(
                [line for line in lines if line and not line.isspace()],
                delimiter=self.delimiter,
                comments=None,
                quotechar='"',
                ndmin=2,
            )
        except ValueError:
            return None
        return values if values.shape[1] == len(self.header) else None

    def slow_values(self, names: tuple[str, ...]) -> dict[str, np.ndarray]:
        """The named columns, cell by cell; finds the cell that is wrong.

        Raises:
            DataError: a row of another length, or a cell that is no number.
        """
        wanted = {name: self.header.index(name) for name in names}
        columns: dict[str, list[float]] = {name: [] for name in names}
        last = max(number for number, line in enumerate(self.lines) if line.strip())
        for number, line in enumerate(self.lines):
            if not line.strip():
                continue
            where = f"{self.source}, line {self.first + number + 1}"
            # A copy that was interrupted ends somewhere in the last line.
            cut = "; the file looks truncated there: copy it anew or delete the line"
            advice = cut if number == last else ""
            cells = self._cells(line)
            if len(cells) == len(self.header) + 1 and not cells[-1]:
                cells = cells[:-1]
            if len(cells) != len(self.header):
                raise DataError(
                    f"{where} has {len(cells)} cell(s) but the table has {len(self.header)} "
                    f"columns ({', '.join(self.header)})"
                    f"{advice or '; complete or delete the row'}."
                )
            for name, index in wanted.items():
                fault = _fault(cells[index])
                if fault:
                    raise DataError(f"{where}, column {name!r}: {fault}{advice}.")
                columns[name].append(float(cells[index]))
        return {name: np.array(column) for name, column in columns.items()}

    def _cells(self, line: str) -> list[str]:
        if self.delimiter is None:
            cells = next(csv.reader([" ".join(line.split())], delimiter=" "))
        else:
            cells = next(csv.reader([line], delimiter=self.delimiter, skipinitialspace=True))
        return [cell.strip() for cell in cells]


def _decoded(source: str, content: bytes) -> str:
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        return content.decode("utf-16", errors="replace")
    if b"\0" in content[:4096]:
        raise DataError(f"{source} is not text; read .mat and .npz files by read_mat, read_npz.")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        # Units such as the degree sign, written by older programs; every byte has a meaning there.
        return content.decode("latin-1")


def _delimiter(lines: list[str]) -> str | None:
    """The first candidate that separates every line into as many cells, else the commonest."""
    counts = {
        mark: [len(next(csv.reader([line], delimiter=mark))) - 1 for line in lines]
        for mark in _DELIMITERS
    }
    for mark, numbers in counts.items():
        if numbers[0] > 0 and len(set(numbers)) == 1:
            return mark
    # Rows are ragged, or blanks separate: the second line is more likely numbers than the first.
    sample = min(1, len(lines) - 1)
    best = max(_DELIMITERS, key=lambda mark: (counts[mark][sample], counts[mark][0]))
    return best if counts[best][sample] > 0 else None


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    # Python reads 1_000 as a number; a file does not mean it so.
    return "_" not in cell


def _fault(cell: str) -> str | None:
    """What is wrong with a cell that should hold a number."""
    if not cell:
        return "the cell is empty; fill it, or cut the file there"
    if _is_number(cell):
        return None
    decimal = "; write decimals with a point" if _is_number(cell.replace(",", ".")) else ""
    return f"{cell!r} is not a number{decimal}"
