"""One self-contained HTML page put together piece by piece, and tables as text."""

import base64
import dataclasses
import html
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from lpvid._files import write_atomically
from lpvid.plot import png_bytes

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


@dataclasses.dataclass(frozen=True)
class Report:
    """A page put together piece by piece; every method returns a new, longer report.

    The page is one file: styles and pictures are inside, there is no script and nothing is
    fetched. It reads on a phone and in the dark. All text is escaped.

    Attributes:
        title: heading of the page and name of its tab.
        parts: what the page holds so far, as HTML.

    Example:
        >>> from lpvid.models import StateSpace
        >>> from lpvid.plot import bode
        >>> from lpvid.report import Report
        >>> page = (
        ...     Report("Two-link arm")
        ...     .heading("Fit")
        ...     .paragraph("Best fit rate on validation data.")
        ...     .table([[1, 99.2], [2, 98.7]], ["point", "BFT (%)"])
        ...     .figure(bode(StateSpace([[-1.0]], [[1.0]], [[1.0]])), "Frequency response")
        ... )
        >>> page.write("report.html").name
        'report.html'
    """

    title: str
    parts: tuple[str, ...] = ()

    def _with(self, part: str) -> "Report":
        return dataclasses.replace(self, parts=(*self.parts, part))

    def heading(self, text: str, level: int = 2) -> "Report":
        """A heading.

        Args:
            text: what it says.
            level: 2, 3 or 4 (the title is 1).

        Raises:
            ValueError: another level.
        """
        if level not in (2, 3, 4):
            raise ValueError(f"level: 2, 3 or 4 is needed, got {level}.")
        return self._with(f"<h{level}>{html.escape(text)}</h{level}>")

    def paragraph(self, text: str) -> "Report":
        """Plain text; a blank line starts a new paragraph."""
        blocks = [block.strip() for block in text.split("\n\n") if block.strip()]
        return self._with("\n".join(f"<p>{html.escape(block)}</p>" for block in blocks))

    def preformatted(self, text: str) -> "Report":
        """Text with its line breaks and spaces kept, such as a command or a log."""
        return self._with(f'<pre tabindex="0">{html.escape(text)}</pre>')

    def table(
        self, rows: Sequence[Sequence[Any]], headers: Sequence[str], caption: str = ""
    ) -> "Report":
        """A table; cells are written as in `text_table`, columns of numbers to the right.

        Args:
            rows: cells, row by row.
            headers: one for each column.
            caption: what the table shows.

        Raises:
            ValueError: a row has another length than `headers`.
        """
        cells, numeric = _formatted(rows, headers)
        shade = [' class="number"' if is_number else "" for is_number in numeric]
        head = "".join(
            f'<th scope="col"{s}>{html.escape(str(h))}</th>'
            for h, s in zip(headers, shade, strict=True)
        )
        body = "\n".join(
            "<tr>"
            + "".join(f"<td{s}>{html.escape(c)}</td>" for c, s in zip(row, shade, strict=True))
            + "</tr>"
            for row in cells
        )
        title = f"<caption>{html.escape(caption)}</caption>" if caption else ""
        name = html.escape(caption or "table", quote=True)
        return self._with(
            f'<div class="scroll" role="region" tabindex="0" aria-label="{name}"><table>{title}'
            f"<thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody></table></div>"
        )

    def figure(self, picture: Any, caption: str = "", *, alt: str | None = None) -> "Report":
        """A picture.

        Args:
            picture: Matplotlib axes or figure (which is closed), or the path of a PNG file.
            caption: what it shows.
            alt: description for those who cannot see it; the caption by default.

        Raises:
            ValueError: a file that is no PNG.
            OSError: a file that cannot be read.
        """
        if isinstance(picture, str | os.PathLike):
            content = Path(picture).read_bytes()
            if not content.startswith(_PNG_SIGNATURE):
                raise ValueError(f"picture: {os.fspath(picture)} is no PNG file; save it as PNG.")
        else:
            content = png_bytes(picture)
        width = int.from_bytes(content[16:20], "big")
        height = int.from_bytes(content[20:24], "big")
        text = html.escape(caption if alt is None else alt, quote=True)
        below = f"<figcaption>{html.escape(caption)}</figcaption>" if caption else ""
        encoded = base64.b64encode(content).decode()
        return self._with(
            f'<figure><img src="data:image/png;base64,{encoded}" alt="{text}" '
            f'width="{width}" height="{height}">{below}</figure>'
        )

    def to_html(self) -> str:
        """The whole page."""
        title = html.escape(self.title)
        body = "\n".join(self.parts)
        return (
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            '<meta name="color-scheme" content="light dark">\n'
            '<meta http-equiv="Content-Security-Policy" '
            "content=\"default-src 'none'; img-src data:; style-src 'unsafe-inline'\">\n"
            f"<title>{title}</title>\n<style>{_STYLE}</style>\n</head>\n"
            f"<body>\n<main>\n<h1>{title}</h1>\n{body}\n</main>\n</body>\n</html>\n"
        )

    def write(self, path: str | os.PathLike[str]) -> Path:
        """Write the page; an interruption leaves the old file.

        Args:
            path: where to.

        Returns:
            The path.

        Raises:
            OSError: the folder is missing or not writable.
        """
        return write_atomically(path, self.to_html().encode())


def text_table(rows: Sequence[Sequence[Any]], headers: Sequence[str]) -> str:
    """A table in aligned columns for the terminal, numbers to the right, text to the left.

    Floats have four significant digits, `None` is a dash, truth values are yes and no.

    Args:
        rows: cells, row by row.
        headers: one for each column.

    Raises:
        ValueError: a row has another length than `headers`.

    Example:
        >>> from lpvid.report import text_table
        >>> print(text_table([["arm", 99.123456], ["wafer", 87.5]], ["plant", "BFT (%)"]))
        plant  BFT (%)
        -----  -------
        arm      99.12
        wafer     87.5
    """
    cells, numeric = _formatted(rows, headers)
    table = [[str(header) for header in headers], *cells]
    widths = [max(len(row[k]) for row in table) for k in range(len(headers))]
    table.insert(1, ["-" * width for width in widths])
    lines = (
        "  ".join(
            cell.rjust(width) if is_number else cell.ljust(width)
            for cell, width, is_number in zip(row, widths, numeric, strict=True)
        ).rstrip()
        for row in table
    )
    return "\n".join(lines)


def _formatted(
    rows: Sequence[Sequence[Any]], headers: Sequence[str]
) -> tuple[list[list[str]], list[bool]]:
    """Cells as text, and which columns hold numbers (and nothing but them and gaps).

    Raises:
        ValueError: a row has another length than `headers`.
    """
    plain = []
    for number, row in enumerate(rows):
        if len(row) != len(headers):
            raise ValueError(f"rows: row {number} has {len(row)} cells for {len(headers)} headers.")
        plain.append([_scalar(cell) for cell in row])
    numeric = []
    for k in range(len(headers)):
        column = [row[k] for row in plain if row[k] is not None]
        numeric.append(bool(column) and all(_is_number(cell) for cell in column))
    return [[_text(cell) for cell in row] for row in plain], numeric


def _scalar(cell: Any) -> Any:
    """A number out of an array that holds one."""
    if isinstance(cell, np.ndarray | np.generic | jax.Array) and np.ndim(cell) == 0:
        return np.asarray(cell).item()
    return cell


def _is_number(cell: Any) -> bool:
    return isinstance(cell, int | float | complex) and not isinstance(cell, bool)


def _text(cell: Any) -> str:
    if cell is None:
        return "–"
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    if isinstance(cell, float):
        # Plain digits where they are short, a power of ten beyond.
        whole = math.isfinite(cell) and 1e4 <= abs(cell) < 1e7
        return f"{cell:.0f}" if whole else f"{cell:.4g}"
    if isinstance(cell, complex):
        return f"{cell:.4g}"
    return " ".join(str(cell).split())


_STYLE = """
:root { --ink: #1b1f24; --soft: #57606a; --line: #d0d7de; --page: #ffffff; --band: #f6f8fa; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6edf3; --soft: #9da7b1; --line: #3d444d; --page: #0d1117; --band: #161b22; }
}
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; text-size-adjust: 100%; }
body { margin: 0; background: var(--page); color: var(--ink);
  font: 1rem/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Liberation Sans", sans-serif;
  overflow-wrap: break-word; }
main { max-width: 60rem; margin: 0 auto; padding: 1rem 1rem 3rem; }
h1 { font-size: 1.6rem; line-height: 1.25; margin: .5rem 0 1rem; }
h2 { font-size: 1.25rem; margin: 2rem 0 .5rem; padding-bottom: .2rem;
  border-bottom: 1px solid var(--line); }
h3 { font-size: 1.08rem; margin: 1.5rem 0 .4rem; }
h4 { font-size: 1rem; margin: 1.2rem 0 .3rem; color: var(--soft); }
p { margin: .5rem 0; max-width: 44rem; }
pre { overflow-x: auto; background: var(--band); border: 1px solid var(--line);
  border-radius: 6px; padding: .6rem .8rem; font-size: .85rem; line-height: 1.4; }
.scroll { overflow-x: auto; margin: .8rem 0; }
table { border-collapse: collapse; font-size: .92rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; color: var(--soft); padding: 0 0 .3rem; }
th, td { padding: .3rem .7rem; border-bottom: 1px solid var(--line); text-align: left;
  white-space: nowrap; }
thead th { border-bottom: 2px solid var(--line); }
tbody tr:nth-child(even) { background: var(--band); }
.number { text-align: right; }
figure { margin: 1rem 0; }
img { display: block; max-width: 100%; height: auto; background: #ffffff;
  border: 1px solid var(--line); border-radius: 6px; }
figcaption { color: var(--soft); font-size: .9rem; margin-top: .3rem; }
@media (max-width: 30rem) {
  th, td { padding: .3rem .45rem; }
  td:first-child { white-space: normal; }
}
@media print { main { max-width: none; } figure, tr { break-inside: avoid; } }
"""
