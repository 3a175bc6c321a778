"""Errors of prediction over the horizon, up to simulation."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from lpvid.plot._figure import (
    MARKERS,
    channel_names,
    colour,
    dashes,
    dress,
    grid_of_axes,
    labelled,
    legend_above,
    styled,
    with_unit,
)


@styled
def horizon_errors(
    errors: Any,
    labels: Sequence[str] | str | None = None,
    *,
    dt: float | None = None,
    output_names: Sequence[str] | None = None,
    output_units: Sequence[str] | None = None,
    axes: Any = None,
) -> np.ndarray:
    """Root mean square error over the horizon, one panel for each output.

    A dashed line is the error of simulation, which the curve runs into as the horizon grows.

    Args:
        errors: one result of `lpvid.analysis.horizon_errors`, a sequence, or a mapping from label
            to result.
        labels: one for each result of a sequence.
        dt: sample time in seconds; with it the horizon is drawn in seconds, else in samples.
        output_names: one for each output; y1, y2, ... by default.
        output_units: one for each output; none by default.
        axes: where to draw, one for each output; new ones by default.

    Returns:
        The axes, shape (ny,).

    Raises:
        ValueError: results of different numbers of outputs, names or axes that do not fit.

    Example:
        >>> import numpy as np
        >>> from lpvid.analysis import horizon_errors
        >>> from lpvid.models import StateSpace
        >>> from lpvid.plot import horizon_errors as draw
        >>> model = StateSpace([[0.5]], [[1.0]], [[1.0]], dt=0.1)
        >>> u, y = np.random.default_rng(0).standard_normal((2, 200))
        >>> draw(horizon_errors(model, u=u, y=y, gain=[[0.2]])).shape
        (1,)
    """
    found = labelled(errors, labels, "errors", "model")
    sizes = {np.shape(one.rmse)[1] for one in found.values()}
    if len(sizes) > 1:
        raise ValueError(f"errors: results of {sorted(sizes)} outputs do not share a plot.")
    ny = sizes.pop()
    outputs = channel_names(output_names, ny, "y", "output_names")
    units = [""] * ny if output_units is None else channel_names(output_units, ny, "", "units")
    panels = grid_of_axes(ny, 1, axes, size=(6.0, 0.9 + 2.2 * ny), sharex=True)[:, 0]
    for k, panel in enumerate(panels):
        dress(panel)
        for index, (label, one) in enumerate(found.items()):
            horizons, rmse = np.asarray(one.horizons), np.asarray(one.rmse)[:, k]
            ahead = np.isfinite(horizons)
            several = f"{label}: " if len(found) > 1 or labels is not None else ""
            if np.any(ahead):
                panel.plot(
                    horizons[ahead] * (1.0 if dt is None else dt),
                    rmse[ahead],
                    color=colour(index),
                    linewidth=1.2,
                    marker=MARKERS[index % len(MARKERS)],
                    markersize=4.0,
                    label=f"{several}prediction",
                )
            for value in rmse[~ahead]:
                panel.axhline(
                    value,
                    color=colour(index),
                    linewidth=1.2,
                    linestyle=dashes(1 + index % 4),
                    label=f"{several}simulation",
                )
        panel.set_xscale("log")
        top = max(float(np.max(np.asarray(one.rmse)[:, k])) for one in found.values())
        panel.set_ylim(0.0, 1.1 * top or 1.0)
        panel.set_ylabel(f"{outputs[k]}: {with_unit('RMS error', units[k])}")
    panels[-1].set_xlabel("horizon (samples)" if dt is None else "horizon (s)")
    legend_above(panels[0])
    return panels
