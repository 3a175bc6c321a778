"""What all plots share: palette, fresh or given axes, labels, labelled sets of systems, saving."""

import functools
import io
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeAlias, TypeVar

import numpy as np
from jaxtyping import ArrayLike

from lpvid._files import write_atomically

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Axes
    from matplotlib.figure import Figure as Figure
else:
    # Matplotlib is not imported for an annotation.
    Axes: TypeAlias = Any
    Figure: TypeAlias = Any

# Numbers to draw: arrays, or plain lists of them.
Values: TypeAlias = ArrayLike | Sequence[Any]

# Okabe and Ito's colours, told apart with any colour vision, those strong on white first.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F6000")
DATA_COLOUR = "#333333"
REFERENCE_COLOUR = "#000000"
FAINT = "#8C8C8C"
# A second sign beside the colour, for print in grey.
DASHES = ("-", (0, (6, 2)), (0, (2, 1.2)), (0, (6, 2, 1.5, 2)), (0, (9, 2, 2, 2, 2, 2)))
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
NOISE_FLOOR: dict[str, Any] = {
    "color": REFERENCE_COLOUR,
    "linestyle": DASHES[2],
    "linewidth": 1.0,
    "label": "noise floor",
}
# A model without the effects that it lacks, and with them.
BEFORE: dict[str, Any] = {"color": COLOURS[1], "linestyle": DASHES[1]}
AFTER: dict[str, Any] = {"color": COLOURS[0], "linestyle": DASHES[0]}
# Inches: narrow enough that letters can be read where a phone shows the whole width.
LOOP_WIDTH = 5.0

_STYLE: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.titleweight": "bold",
    "axes.labelsize": 9.0,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.fontsize": 8.0,
    "axes.unicode_minus": True,
}

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def styled(draw: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Draw in lpvid's style; Matplotlib's own settings are back afterwards."""

    @functools.wraps(draw)
    def wrapped(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        import matplotlib

        # Not `rc_context`: it would also take back what a notebook's backend sets with its first
        # figure, and no later figure would be shown.
        settings = matplotlib.rcParams
        before = {name: settings[name] for name in _STYLE}
        settings.update(_STYLE)
        try:
            return draw(*args, **kwargs)
        finally:
            settings.update(before)

    return wrapped


def grid_of_axes(
    rows: int,
    columns: int,
    axes: Any,
    *,
    size: tuple[float, float],
    sharex: bool | str = False,
    height_ratios: Sequence[float] | None = None,
) -> np.ndarray:
    """Axes in rows and columns: those given if they are as many, else of a new figure.

    Args:
        rows: how many rows.
        columns: how many columns.
        axes: those given, or `None`.
        size: width and height of a new figure in inches.
        sharex: whether panels of a new figure share their horizontal axes.
        height_ratios: heights of the rows of a new figure, relative to one another.

    Raises:
        ValueError: another number of axes is given.
    """
    if axes is None:
        import matplotlib.pyplot as plt

        options: dict[str, Any] = {"figsize": size, "sharex": sharex, "squeeze": False}
        options |= {"layout": "constrained", "height_ratios": height_ratios}
        _, made = plt.subplots(rows, columns, **options)
        return made
    given = np.atleast_1d(np.asarray(axes, dtype=object))
    if given.size != rows * columns:
        raise ValueError(
            f"axes: {rows} x {columns} are needed here, {given.size} given; leave axes out, or "
            f"make them with plt.subplots({rows}, {columns})."
        )
    return given.reshape(rows, columns)


def dress(axes: Axes) -> None:
    """Light grid behind the data, no box."""
    axes.grid(True, which="major", color="#D9D9D9", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=_STYLE["xtick.labelsize"])


def legend(axes: Axes, **options: Any) -> None:
    """Legend where something is labelled, on a translucent ground."""
    if axes.get_legend_handles_labels()[0]:
        made = axes.legend(framealpha=0.85, edgecolor="none", **options)
        # The sign of a translucent cloud would not be seen in the legend.
        for handle in made.legend_handles:
            if handle is not None and hasattr(handle, "get_marker"):
                handle.set_alpha(1.0)


def legend_above(axes: Axes) -> None:
    """Legend above the axes, where it hides nothing, in as many columns as fit."""
    labels = axes.get_legend_handles_labels()[1]
    longest = max((len(label) for label in labels), default=0)
    columns = max(1, min(len(labels), 100 // (longest + 8)))
    place = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0)}
    legend(axes, ncols=columns, borderaxespad=0.1, borderpad=0.2, **place)


def with_unit(name: str, unit: str) -> str:
    """`name (unit)`, or the name alone."""
    return f"{name} ({unit})" if unit else name


def few_decades(axis: Any) -> None:
    """Plain numbers at 1, 2 and 5 where a logarithmic axis has few decades, not at every digit."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = axis.get_view_interval()
    if 0.0 < low < high < 2e2 * low:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def p_value_text(value: Any) -> str:
    """A p-value in words that fit a picture."""
    if np.isnan(value):
        return "p unknown"
    return "p < 0.0001" if float(value) < 1e-4 else f"p = {float(value):.3f}"


def labelled(
    items: Any, labels: Sequence[str] | str | None, argument: str, noun: str
) -> dict[str, Any]:
    """One item, a sequence or a mapping as a mapping from label to item.

    Args:
        items: what the user gave.
        labels: one for each item of a sequence; none for a mapping, which has its own.
        argument: what the items are called, for messages.
        noun: default label, numbered where there are several items.

    Raises:
        ValueError: no items, labels that do not fit, or a label twice.
    """
    if isinstance(items, Mapping):
        if labels is not None:
            raise ValueError(f"labels: {argument} has its own; give one of the two.")
        found = {str(label): item for label, item in items.items()}
    else:
        several = list(items) if isinstance(items, list | tuple) else [items]
        if labels is None:
            labels = (
                [noun] if len(several) == 1 else [f"{noun} {i + 1}" for i in range(len(several))]
            )
        labels = [labels] if isinstance(labels, str) else list(labels)
        if len(labels) != len(several):
            raise ValueError(f"labels: {len(labels)} given for {len(several)} {argument}.")
        if len(set(labels)) != len(labels):
            raise ValueError(f"labels: {labels} holds a label twice; give distinct ones.")
        found = dict(zip(labels, several, strict=True))
    if not found:
        raise ValueError(f"{argument}: none given.")
    return found


def model_of(item: Any) -> Any:
    """The model of a result such as a `Fit` or a `Restructured`; a model itself."""
    return getattr(item, "model", item)


def channel_names(names: Sequence[str] | None, count: int, prefix: str, argument: str) -> list[str]:
    """Names given, or the prefix with a number: y1, y2, ...

    Raises:
        ValueError: another number of names than channels.
    """
    if names is None:
        return [f"{prefix}{i + 1}" for i in range(count)]
    if len(names) != count:
        raise ValueError(f"{argument}: {len(names)} given for {count} channels.")
    return list(names)


def colour(index: int) -> str:
    """Colour of the index-th thing; they recur after seven."""
    return COLOURS[index % len(COLOURS)]


def dashes(index: int) -> Any:
    """Line style of the index-th thing."""
    return DASHES[index % len(DASHES)]


def figure_of(axes: Any) -> Figure:
    """The figure that axes (or an array of them, or the figure itself) belong to.

    Raises:
        ValueError: something else is given.
    """
    if hasattr(axes, "savefig"):
        return axes
    first = np.atleast_1d(np.asarray(axes, dtype=object)).ravel()
    if first.size == 0 or not hasattr(first[0], "get_figure"):
        raise ValueError(
            f"axes: Matplotlib axes, an array of them or a figure is needed, got "
            f"{type(axes).__name__}."
        )
    return first[0].get_figure(root=True)


def png_bytes(axes: Any, *, dpi: float = 150.0, close: bool = True, form: str = "png") -> bytes:
    """The figure of some axes as the content of an image file.

    Args:
        axes: axes, an array of them or the figure.
        dpi: dots per inch.
        close: close the figure afterwards.
        form: format of the image, as Matplotlib calls it.

    Raises:
        ValueError: no axes are given, or Matplotlib cannot write the form.

    Example:
        >>> from lpvid.models import StateSpace
        >>> from lpvid.plot import bode, png_bytes
        >>> png_bytes(bode(StateSpace([[-1.0]], [[1.0]], [[1.0]])))[1:4]
        b'PNG'
    """
    figure = figure_of(axes)
    buffer = io.BytesIO()
    figure.savefig(buffer, format=form, dpi=dpi, facecolor="white")
    if close:
        import matplotlib.pyplot as plt

        plt.close(figure)
    return buffer.getvalue()


def save_figure(axes: Any, path: str | os.PathLike[str], *, dpi: float = 150.0) -> Path:
    """Write the figure of some axes to a file and close it; an interruption leaves the old file.

    Args:
        axes: axes, an array of them or the figure.
        path: where to; the suffix gives the form (PNG where there is none).
        dpi: dots per inch.

    Returns:
        The path.

    Raises:
        ValueError: no axes are given, or Matplotlib cannot write the form.
        OSError: the folder is missing or not writable.

    Example:
        >>> from lpvid.models import StateSpace
        >>> from lpvid.plot import bode, save_figure
        >>> save_figure(bode(StateSpace([[-1.0]], [[1.0]], [[1.0]])), "bode.png").name
        'bode.png'
    """
    form = Path(path).suffix.lstrip(".").lower() or "png"
    supported = figure_of(axes).canvas.get_supported_filetypes()
    if form not in supported:
        raise ValueError(f"path: no {form!r} files are written; use one of {', '.join(supported)}.")
    return write_atomically(path, png_bytes(axes, dpi=dpi, form=form))
