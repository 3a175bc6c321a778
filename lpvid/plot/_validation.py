"""Models beside a plant, over time."""

from typing import Any

import numpy as np

from lpvid.control import Validation
from lpvid.plot._figure import (
    DATA_COLOUR,
    FAINT,
    colour,
    dashes,
    dress,
    grid_of_axes,
    legend_above,
    styled,
    with_unit,
)


@styled
def validation(found: Validation, *, axes: Any = None) -> np.ndarray:
    """What the plant did and what the models say, one panel for each output.

    The legend gives δ of each model. The part that data-matching models could know is shaded.

    Args:
        found: result of `lpvid.control.data_matching` or `set_point_following`.
        axes: where to draw, one for each output; new ones by default.

    Returns:
        The axes, shape (ny,).

    Raises:
        ValueError: another number of axes is given.

    Example:
        >>> import numpy as np
        >>> from lpvid.control import data_matching
        >>> from lpvid.data import IOData
        >>> from lpvid.models import StateSpace
        >>> from lpvid.plot import validation
        >>> u = np.ones(40)
        >>> lag = StateSpace([[0.5]], [[1.0]], [[1.0]], dt=0.1)
        >>> data = IOData(u=u, y=lag.simulate(u=u), dt=0.1)
        >>> validation(data_matching({"lag": lag}, data)).shape
        (1,)
    """
    data, ny = found.data, found.data.ny
    panels = grid_of_axes(ny, 1, axes, size=(7.5, 0.7 + 2.0 * ny), sharex=True)[:, 0]
    time = data.dt * np.arange(data.n_samples)
    starts = np.concatenate([[0], np.cumsum(data.lengths)[:-1]])
    errors = np.asarray(found.relative_error)
    for k, panel in enumerate(panels):
        dress(panel)
        panel.margins(x=0.01)
        for first, known in zip(starts, found.identified, strict=True):
            if known:
                panel.axvspan(
                    data.dt * first,
                    data.dt * (first + known),
                    color=FAINT,
                    alpha=0.12,
                    linewidth=0,
                )
        # A line would join the end of a record with the start of the next.
        cut = starts[1:]
        panel.plot(
            np.insert(time, cut, np.nan),
            np.insert(np.asarray(data.y)[:, k], cut, np.nan),
            color=DATA_COLOUR,
            linewidth=1.6,
            label="plant",
        )
        for i, label in enumerate(found.labels):
            panel.plot(
                np.insert(time, cut, np.nan),
                np.insert(np.asarray(found.outputs)[i, :, k], cut, np.nan),
                color=colour(i),
                linestyle=dashes(i + 1),
                linewidth=1.1,
                label=f"{label}: δ = {errors[i, k]:.3f}",
            )
        # An unstable model must not squeeze the plant into a line.
        low, high = np.min(np.asarray(data.y)[:, k]), np.max(np.asarray(data.y)[:, k])
        room = 0.5 * (high - low) or 1.0
        bottom, top = panel.get_ylim()
        panel.set_ylim(max(bottom, low - room), min(top, high + room))
        panel.set_ylabel(with_unit(data.output_names[k], data.output_units[k]))
        legend_above(panel)
    panels[-1].set_xlabel("time (s)")
    return panels
