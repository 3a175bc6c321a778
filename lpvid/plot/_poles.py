"""Poles in the plane, and mode frequencies over the scheduling."""

from collections.abc import Callable, Sequence
from typing import Any, cast

import jax
import numpy as np
from numpy.typing import NDArray

from lpvid.models import LPVStateSpace, StateSpace
from lpvid.plot._bands import draw_regions
from lpvid.plot._figure import (
    FAINT,
    MARKERS,
    REFERENCE_COLOUR,
    Axes,
    Values,
    colour,
    dress,
    grid_of_axes,
    labelled,
    legend,
    model_of,
    styled,
)
from lpvid.plot._systems import (
    HZ,
    continuous_poles,
    plane_poles,
    pole_uncertainty,
    state_spaces,
    uncertain,
)

_DAMPINGS = (0.05, 0.1, 0.3, 0.7)


@styled
def poles(
    systems: Any,
    labels: Sequence[str] | str | None = None,
    *,
    level: float | None = 0.95,
    axes: Axes | None = None,
) -> Axes:
    """Poles in the complex plane.

    Continuous time: the s-plane divided by 2π, so that the distance from the origin is the
    natural frequency in Hz, with lines of equal damping ratio and the unstable half shaded.
    Discrete time: the z-plane with the unit circle.

    Args:
        systems: as for `bode`; the poles of a batch of models make a cloud. Those of a refined
            model come with confidence regions, an ellipse for a complex pole and an interval for a
            real one, each pole on its own (delta method).
        labels: as for `bode`.
        level: probability of the confidence regions; `None` for no regions.
        axes: where to draw; new ones by default.

    Raises:
        ValueError: continuous- and discrete-time models together, or a level that is no
            probability.

    Example:
        >>> from lpvid.models import StateSpace
        >>> from lpvid.plot import poles
        >>> poles(StateSpace([[-1.0]], [[1.0]], [[1.0]])).get_xlabel()
        'real part / 2π (Hz)'
    """
    models = state_spaces(systems, labels)
    discrete = {model.is_discrete for model in models.values()}
    if len(discrete) > 1:
        raise ValueError(
            "systems: continuous- and discrete-time models do not share a plane; convert with "
            "c2d or d2c."
        )
    panel = grid_of_axes(1, 1, axes, size=(5.2, 4.4))[0, 0]
    dress(panel)
    is_discrete = discrete.pop()
    known = uncertain(systems, labels, level)
    for index, (label, model) in enumerate(models.items()):
        values = plane_poles(model).ravel()
        values = values if is_discrete else values / HZ
        cloud = len(model.batch_shape) > 0
        panel.plot(
            values.real,
            values.imag,
            linestyle="none",
            marker=MARKERS[index % len(MARKERS)],
            markersize=3.0 if cloud else 6.5,
            markerfacecolor=colour(index) if cloud else "none",
            markeredgecolor=colour(index),
            markeredgewidth=0.0 if cloud else 1.4,
            alpha=0.4 if cloud else 1.0,
            label=label,
            zorder=3,
        )
        if label in known and level is not None:
            spread = pole_uncertainty(known[label])
            draw_regions(panel, spread, level, 1.0 if is_discrete else HZ, colour(index))
    if is_discrete:
        _unit_circle(panel)
    else:
        _damping_lines(panel)
    if len(models) > 1 or labels is not None or known:
        legend(panel)
    return panel


def _unit_circle(panel: Axes) -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 361)
    panel.plot(np.cos(angle), np.sin(angle), color=FAINT, linewidth=1.0, label="_unit circle")
    panel.axhline(0.0, color=FAINT, linewidth=0.8)
    panel.axvline(0.0, color=FAINT, linewidth=0.8)
    panel.set_aspect("equal", adjustable="datalim")
    panel.set_xlabel("real part of z")
    panel.set_ylabel("imaginary part of z")


def _damping_lines(panel: Axes) -> None:
    (left, right), (low, high) = panel.dataLim.intervalx, panel.dataLim.intervaly
    width = max(right, 0.0) - min(left, 0.0) or 1.0
    # The origin and a strip of the unstable side are always shown, and room beside the poles.
    left, right = min(1.1 * left, -0.05 * width), max(1.1 * right, 0.08 * width)
    reach = 1.12 * max(abs(low), abs(high)) or 0.5 * width
    low, high = -reach, reach
    labelled_at = np.inf
    for damping in _DAMPINGS:
        slope = np.sqrt(1.0 - damping**2) / damping
        # The ray ends where it meets the left or the upper edge.
        end = max(left, -high / slope)
        for sign in (1.0, -1.0):
            panel.plot(
                [0.0, end],
                [0.0, -sign * slope * end],
                color=FAINT,
                linewidth=0.7,
                linestyle=(0, (4, 3)),
                label=f"_damping {damping:g}",
                zorder=1,
            )
        if abs(labelled_at - abs(slope * end)) < 0.06 * reach:
            continue
        labelled_at = abs(slope * end)
        panel.annotate(
            f"ζ = {damping:g}",
            (end, -slope * end),
            xytext=(2, 2),
            textcoords="offset points",
            color="#595959",
            fontsize=7.5,
            annotation_clip=False,
        )
    panel.axvspan(0.0, right, color="#D55E00", alpha=0.07, linewidth=0)
    panel.axhline(0.0, color=FAINT, linewidth=0.8)
    panel.axvline(0.0, color=FAINT, linewidth=0.8)
    panel.set_xlim(left, right)
    panel.set_ylim(low, high)
    panel.set_xlabel("real part / 2π (Hz)")
    panel.set_ylabel("imaginary part / 2π (Hz)")


@styled
def mode_frequencies(
    systems: Any,
    kappas: Values | None = None,
    labels: Sequence[str] | str | None = None,
    *,
    damping: bool = False,
    along: int = 0,
    name: str | None = None,
    axes: Any = None,
) -> np.ndarray:
    """Natural frequencies of the oscillatory modes over the scheduling.

    Args:
        systems: one, or a mapping from label to one, of: an `LPVStateSpace` (a line over its
            range); a list of local models or results at `kappas` (dots); a function from the
            scheduling to a `StateSpace` (a dashed black line, for an analytic reference).
        kappas: where the local models are, (n_points,) or (n_points, n_scheduling); also the range
            of a function.
        labels: one for each system of a sequence of systems.
        damping: add a panel with the damping ratios.
        along: which scheduling variable is drawn; the others stay in the middle of their range.
        name: of the scheduling variable, "κ" by default.
        axes: where to draw, as many as returned; new ones by default.

    Returns:
        The axes, shape (1,), or (2,) with damping.

    Raises:
        ValueError: `kappas` is missing or has another length than the local models.

    Example:
        >>> from lpvid.models import StateSpace
        >>> from lpvid.plot import mode_frequencies
        >>> def spring(stiffness):
        ...     return StateSpace([[0.0, 1.0], [-stiffness, -0.1]], [[0.0], [1.0]], [[1.0, 0.0]])
        >>> systems = {"local": [spring(1.0), spring(4.0)], "physics": spring}
        >>> mode_frequencies(systems, [1.0, 4.0], damping=True).shape
        (2,)
    """
    points = None if kappas is None else np.asarray(kappas, float)
    points = points[:, None] if points is not None and points.ndim == 1 else points
    if isinstance(systems, list | tuple) and labels is None:
        systems = {"local models": systems}  # a plain list of local models is one system
    found = labelled(systems, labels, "systems", "model")
    curves = [
        (label, *_along_kappa(system, label, points, along, index))
        for index, (label, system) in enumerate(found.items())
    ]
    rows = 2 if damping else 1
    panels = grid_of_axes(rows, 1, axes, size=(6.0, 1.0 + 2.4 * rows), sharex=True)[:, 0]
    for panel in panels:
        dress(panel)
    for label, where, poles_there, look in curves:
        frequency, ratio = _modes(poles_there)
        for panel, values in zip(panels, (frequency / HZ, ratio), strict=False):
            for rank, curve in enumerate(values.T):
                panel.plot(where, curve, label=label if rank == 0 else "_", **look)
    panels[0].set_ylabel("mode frequency (Hz)")
    panels[0].set_ylim(bottom=min(0.0, panels[0].get_ylim()[0]))
    if damping:
        panels[1].set_ylabel("damping ratio")
    panels[-1].set_xlabel(
        name or ("κ" if points is None or points.shape[1] == 1 else f"κ{along + 1}")
    )
    if len(found) > 1 or labels is not None:
        legend(panels[0])
    return panels


def _along_kappa(
    system: Any, label: str, points: np.ndarray | None, along: int, index: int
) -> tuple[np.ndarray, list[NDArray[np.complex128]], dict[str, Any]]:
    """Scheduling, the poles there (rad/s), and how they are drawn."""
    if isinstance(system, LPVStateSpace):
        low, high = np.asarray(system.kappa_low), np.asarray(system.kappa_high)
        grid = _line(low, high, along)
        look = {"color": colour(index), "linewidth": 1.4}
        return grid[:, along], list(continuous_poles(jax.vmap(system.at)(grid))), look
    if points is None:
        raise ValueError(f"kappas: needed for {label!r}, to know where its models are.")
    if callable(system) and not isinstance(system, list | tuple):
        function = cast(Callable[[Any], StateSpace], system)
        grid = _line(points.min(axis=0), points.max(axis=0), along)
        look = {"color": REFERENCE_COLOUR, "linestyle": "--", "linewidth": 1.0}
        arguments = grid[:, 0] if grid.shape[1] == 1 else grid
        return grid[:, along], [continuous_poles(function(kappa)) for kappa in arguments], look
    models = [model_of(item) for item in system]
    if len(models) != points.shape[0]:
        raise ValueError(
            f"kappas: {points.shape[0]} points given for the {len(models)} models of {label!r}."
        )
    look = {
        "color": colour(index),
        "linestyle": "none",
        "marker": MARKERS[index % len(MARKERS)],
        "markersize": 5.0,
    }
    return points[:, along], [continuous_poles(model) for model in models], look


def _line(low: np.ndarray, high: np.ndarray, along: int) -> np.ndarray:
    """Points from low to high in one variable, the others in the middle."""
    grid = np.tile((low + high) / 2.0, (101, 1))
    grid[:, along] = np.linspace(low[along], high[along], 101)
    return grid


def _modes(poles_there: list[NDArray[np.complex128]]) -> tuple[np.ndarray, np.ndarray]:
    """Frequency (rad/s) and damping by rank, shape (points, modes), NaN where there are fewer."""
    upper = []
    for values in poles_there:
        # Rounding gives a double real pole a tiny imaginary part.
        values = values[np.isfinite(values) & (values.imag > 1e-9 * np.abs(values))]
        upper.append(values[np.argsort(np.abs(values))])
    count = max((values.size for values in upper), default=0)
    frequency, damping = np.full((2, len(poles_there), count), np.nan)
    for row, values in enumerate(upper):
        frequency[row, : values.size] = np.abs(values)
        damping[row, : values.size] = -values.real / np.abs(values)
    return frequency, damping
