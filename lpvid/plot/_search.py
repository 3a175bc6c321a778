"""Choices and their evidence: singular values and order, minima of a search, fit over points."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lpvid.plot._figure import (
    FAINT,
    MARKERS,
    Axes,
    Values,
    channel_names,
    colour,
    dress,
    grid_of_axes,
    labelled,
    legend,
    legend_above,
    styled,
)

# With more bars than this the numbers on them would overlap.
_MOST_NUMBERED_BARS = 16


@styled
def scree(fit: Any, order: int | None = None, *, axes: Axes | None = None) -> Axes:
    """Singular values of an identification, those kept by the order filled.

    Args:
        fit: a `Fit`, or an array of singular values.
        order: how many are kept; that of the `Fit` by default.
        axes: where to draw; new ones by default.

    Raises:
        ValueError: more than one row of singular values.

    Example:
        >>> from lpvid.plot import scree
        >>> scree([10.0, 4.0, 1e-3, 1e-4], order=2).get_yscale()
        'log'
    """
    values = np.asarray(getattr(fit, "singular_values", fit), float)
    if values.ndim != 1:
        raise ValueError(f"fit: one row of singular values is needed, got shape {values.shape}.")
    if order is None and hasattr(fit, "model"):
        order = int(fit.model.nx)
    panel = grid_of_axes(1, 1, axes, size=(5.5, 3.4))[0, 0]
    dress(panel)
    number = np.arange(1, values.size + 1)
    shown = np.where(values > 0, values, np.nan)
    kept = values.size if order is None else order
    panel.plot(number, shown, color=FAINT, linewidth=0.8, label="_all", zorder=1)
    name = "singular values" if order is None else f"kept: order {order}"
    panel.plot(
        number[:kept], shown[:kept], linestyle="none", marker="o", color=colour(0), label=name
    )
    if order is not None and order < values.size:
        panel.plot(
            number[kept:],
            shown[kept:],
            linestyle="none",
            marker="o",
            markerfacecolor="white",
            color=colour(0),
            label="left out",
        )
        panel.axvline(order + 0.5, color=colour(1), linewidth=1.0, linestyle="--")
    panel.set_yscale("log")
    panel.set_xlabel("number")
    panel.set_ylabel("singular value")
    panel.xaxis.get_major_locator().set_params(integer=True)
    legend(panel)
    return panel


@styled
def minima(
    restructured: Any, labels: Sequence[str] | str | None = None, *, axes: Axes | None = None
) -> Axes:
    """Cost that each start of a restructuring ended with, sorted; hits of the best are filled.

    A flat foot is a minimum that many starts agree on; one lonely point at the bottom is a reason
    to ask for more starts.

    Args:
        restructured: one result of `restructure`, a sequence, or a mapping from label to result.
        labels: one for each result of a sequence.
        axes: where to draw; new ones by default.

    Raises:
        ValueError: no results, or labels that do not fit.

    Example:
        >>> import jax
        >>> import jax.numpy as jnp
        >>> from lpvid.models import FunctionStructure, StateSpace
        >>> from lpvid.plot import minima
        >>> from lpvid.restructure import HinfMatching, restructure
        >>> black_box = StateSpace([[-2.0]], [[4.0]], [[0.5]])
        >>> lag = FunctionStructure(lambda p: (-p[:1, None], p[:1, None], jnp.eye(1)), nominal=1.0)
        >>> match = HinfMatching(passes=0)
        >>> best = restructure(black_box, lag, starts=2, key=jax.random.key(0), method=match)
        >>> minima(best).get_ylabel()
        'match cost'
    """
    found = labelled(restructured, labels, "restructured", "starts")
    panel = grid_of_axes(1, 1, axes, size=(5.5, 3.4))[0, 0]
    dress(panel)
    for index, (label, result) in enumerate(found.items()):
        costs = np.sort(np.asarray(result.match_costs, float))
        hits = int(result.hits)
        number = np.arange(1, costs.size + 1)
        # A cost of zero (an exact match) is shown at the bottom instead of being lost.
        shown = np.where(np.isfinite(costs), np.maximum(costs, 1e-32), np.nan)
        marker = MARKERS[index % len(MARKERS)]
        panel.plot(
            number,
            shown,
            color=colour(index),
            linewidth=0.8,
            marker=marker,
            markerfacecolor="white",
            label=f"{label}: {hits} of {costs.size} in the best minimum",
        )
        panel.plot(
            number[:hits],
            shown[:hits],
            linestyle="none",
            marker=marker,
            color=colour(index),
            label="_hits",
        )
    panel.set_yscale("log")
    panel.set_xlabel("start, sorted by cost")
    panel.set_ylabel("match cost")
    panel.xaxis.get_major_locator().set_params(integer=True)
    legend(panel)
    return panel


@styled
def fit_over_points(
    table: Mapping[str, Values],
    points: Values | None = None,
    *,
    output_names: Sequence[str] | None = None,
    measure: str = "BFT (%)",
    axes: Any = None,
) -> np.ndarray:
    """Bars of a fit measure for each operating point and model, one panel for each output.

    Args:
        table: mapping from a model's label to its values, (n_points,) or (n_points, ny).
        points: names or values of the operating points; 1, 2, ... by default.
        output_names: one for each output; y1, y2, ... by default.
        measure: label of the vertical axis.
        axes: where to draw, one for each output; new ones by default.

    Returns:
        The axes, shape (ny,).

    Raises:
        ValueError: the models' shapes differ, or names, points or axes do not fit.

    Example:
        >>> from lpvid.plot import fit_over_points
        >>> table = {"black box": [99.1, 98.7], "structured": [98.9, 98.2]}
        >>> fit_over_points(table, points=["arm bent", "arm straight"]).shape
        (1,)
    """
    values = {}
    for label, row in labelled(table, None, "table", "model").items():
        array = np.asarray(row, float)
        values[label] = array[:, None] if array.ndim == 1 else array
    shapes = {array.shape for array in values.values()}
    if len(shapes) > 1 or next(iter(shapes))[0] == 0 or len(next(iter(shapes))) != 2:
        listed = ", ".join(f"{label!r} {array.shape}" for label, array in values.items())
        raise ValueError(
            "table: one value (or one for each output) for every point and model is needed, "
            f"got {listed}."
        )
    count, ny = shapes.pop()
    names = _point_names(points, count)
    outputs = channel_names(output_names, ny, "y", "output_names")
    width = max(5.5, 1.5 + 0.16 * count * (len(values) + 1))
    panels = grid_of_axes(ny, 1, axes, size=(min(width, 12.0), 0.9 + 2.2 * ny), sharex=True)[:, 0]
    bar = 0.8 / len(values)
    place = np.arange(count)
    for k, panel in enumerate(panels):
        dress(panel)
        panel.grid(False, axis="x")
        for index, (label, array) in enumerate(values.items()):
            offset = (index - (len(values) - 1) / 2.0) * bar
            bars = panel.bar(
                place + offset, array[:, k], 0.92 * bar, color=colour(index), label=label
            )
            if count * len(values) <= _MOST_NUMBERED_BARS:
                panel.bar_label(bars, fmt="%.1f", fontsize=7.5, padding=1)
        panel.set_ylabel(f"{outputs[k]}: {measure}" if ny > 1 else measure)
    panels[-1].set_xticks(place, names, rotation=0 if max(map(len, names)) < 7 else 40)
    panels[-1].set_xlabel("operating point")
    legend_above(panels[0])
    return panels


def _point_names(points: Any, count: int) -> list[str]:
    if points is None:
        return [str(i + 1) for i in range(count)]
    names = []
    for point in points:
        if isinstance(point, str):
            names.append(point)
        else:
            names.append(", ".join(f"{value:.4g}" for value in np.atleast_1d(np.asarray(point))))
    if len(names) != count:
        raise ValueError(f"points: {len(names)} given for {count} rows of the table.")
    return names
