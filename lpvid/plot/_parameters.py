"""Parameters over the scheduling: local values, the LPV model's curve, a reference."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from lpvid.models import LPVStateSpace
from lpvid.plot._figure import REFERENCE_COLOUR, Values, colour, dress, grid_of_axes, styled


@styled
def parameters(
    lpv: LPVStateSpace,
    kappas: Values | None = None,
    parameters: Any = None,
    reference: Callable[[Any], Values] | Values | None = None,
    names: Sequence[str] | None = None,
    *,
    which: Sequence[int] | None = None,
    along: int = 0,
    at: Values | None = None,
    name: str | None = None,
    axes: Any = None,
) -> np.ndarray:
    """Every parameter of an LPV model over the scheduling, in small multiples.

    Args:
        lpv: the model, drawn as a line.
        kappas: where the local models are, (n_points,) or (n_points, n_scheduling).
        parameters: those of the local models, drawn as dots, (n_points, n_parameters), or the
            results of `restructure`.
        reference: drawn dashed: a function from the scheduling to the parameters, or values at
            `kappas`.
        names: of all parameters; those of the structure by default.
        which: indices of the parameters to draw; all by default.
        along: with several scheduling variables, the one that is drawn.
        at: the point that holds the others' values; the middle by default. Local models elsewhere
            are drawn hollow.
        name: of the scheduling variable, "κ" by default.
        axes: where to draw, one for each parameter drawn; new ones by default.

    Returns:
        The axes, one for each parameter drawn.

    Raises:
        ValueError: names, points, parameters or reference of shapes that do not fit.

    Example:
        >>> import jax.numpy as jnp
        >>> from lpvid.models import FreeStructure, LPVStateSpace, polynomial_basis
        >>> from lpvid.plot import parameters
        >>> structure = FreeStructure(n_states=1, n_inputs=1, n_outputs=1, feedthrough=False)
        >>> coefficients = jnp.array([[-3.0, 1.0, 1.0], [1.0, 0.0, 0.0]])
        >>> basis, low, high = polynomial_basis([0.0, 2.0], 1), jnp.zeros(1), jnp.full(1, 2.0)
        >>> lpv = LPVStateSpace(structure, basis, coefficients, low, high)
        >>> parameters(lpv, [0.0, 2.0], [[-4.0, 1.0, 1.0], [-2.0, 1.0, 1.0]]).shape
        (3,)
    """
    count = lpv.structure.n_parameters
    names = list(lpv.structure.parameter_names if names is None else names)
    if len(names) != count:
        raise ValueError(f"names: {len(names)} given for {count} parameters.")
    chosen = list(range(count)) if which is None else [int(index) for index in which]
    points = _points(kappas, lpv.n_scheduling)
    local = _local(parameters, points, count)
    low, high = np.asarray(lpv.kappa_low), np.asarray(lpv.kappa_high)
    middle = (low + high) / 2.0 if at is None else np.atleast_1d(np.asarray(at, float))
    grid = np.tile(middle, (101, 1))
    grid[:, along] = np.linspace(low[along], high[along], 101)
    curves = np.asarray(jax.vmap(lpv.parameters)(grid))
    exact = _reference(reference, grid, points, along, count)
    panels = _panels(len(chosen), axes)
    for panel, index in zip(panels, chosen, strict=True):
        dress(panel)
        panel.plot(
            grid[:, along], curves[:, index], color=colour(0), linewidth=1.4, label="LPV model"
        )
        if exact is not None:
            panel.plot(
                exact[0],
                exact[1][:, index],
                color=REFERENCE_COLOUR,
                linewidth=1.0,
                linestyle="--",
                label="reference",
            )
        if local is not None and points is not None:
            _draw_local(panel, points, local[:, index], middle, along, high - low)
        panel.set_title(names[index], loc="left")
        _widen(panel)
    label = name or ("κ" if lpv.n_scheduling == 1 else f"κ{along + 1}")
    columns = _columns(len(chosen))
    for panel in panels[-columns:]:
        panel.set_xlabel(label)
        panel.tick_params(labelbottom=True)
    handles, texts = panels[0].get_legend_handles_labels()
    if axes is None and len(handles) > 1:
        panels[0].figure.legend(
            handles, texts, loc="outside upper right", ncols=len(handles), frameon=False
        )
    return panels


def _widen(panel) -> None:
    """Show at least a tenth of the parameter's size: a scatter of half a per cent is no trend."""
    low, high = panel.get_ylim()
    least = 0.1 * max(abs(low), abs(high))
    if high - low < least:
        panel.set_ylim((low + high - least) / 2, (low + high + least) / 2)


def _draw_local(panel, points, values, middle, along, width) -> None:
    others = np.delete(np.arange(points.shape[1]), along)
    distance = np.abs(points[:, others] - middle[others]) / np.where(width > 0, width, 1.0)[others]
    on_line = np.all(distance < 1e-6, axis=1)
    look = {"linestyle": "none", "marker": "o", "markersize": 4.5, "color": colour(1), "zorder": 3}
    if np.any(on_line):
        panel.plot(points[on_line, along], values[on_line], label="local models", **look)
    if not np.all(on_line):
        panel.plot(
            points[~on_line, along],
            values[~on_line],
            markerfacecolor="none",
            alpha=0.5,
            label="local models elsewhere",
            **look,
        )


def _columns(count: int) -> int:
    return min(4, math.ceil(math.sqrt(count)))


def _panels(count: int, axes: Any) -> np.ndarray:
    if axes is not None:
        return grid_of_axes(count, 1, axes, size=(0.0, 0.0))[:, 0]
    columns = _columns(count)
    rows = math.ceil(count / columns)
    made = grid_of_axes(
        rows, columns, None, size=(max(4.5, 2.6 * columns), 0.7 + 1.8 * rows), sharex=True
    )
    for panel in made.ravel()[count:]:
        panel.remove()
    return made.ravel()[:count]


def _points(kappas: Values | None, n_scheduling: int) -> np.ndarray | None:
    if kappas is None:
        return None
    points = np.asarray(kappas, float)
    points = points[:, None] if points.ndim == 1 else points
    if points.ndim != 2 or points.shape[1] != n_scheduling:
        raise ValueError(
            f"kappas: shape (n_points, {n_scheduling}) is needed, got {np.shape(kappas)}."
        )
    return points


def _local(given: Any, points: np.ndarray | None, count: int) -> np.ndarray | None:
    if given is None:
        return None
    if isinstance(given, list | tuple):
        given = np.stack([np.asarray(getattr(item, "parameters", item)) for item in given])
    values = np.asarray(given, float)
    if points is None or values.shape != (points.shape[0], count):
        needed = "kappas" if points is None else f"({points.shape[0]}, {count})"
        raise ValueError(f"parameters: shape {values.shape} given, {needed} needed with it.")
    return values


def _reference(
    reference: Any, grid: np.ndarray, points: np.ndarray | None, along: int, count: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """κ and values of the reference, in rising order of κ."""
    if reference is None:
        return None
    if callable(reference):
        arguments = grid[:, 0] if grid.shape[1] == 1 else grid
        values = np.stack([np.asarray(reference(kappa), float).ravel() for kappa in arguments])
        where = grid[:, along]
    else:
        values = np.asarray(reference, float)
        if points is None or values.shape[0] != points.shape[0]:
            raise ValueError(
                "reference: values need kappas of the same length; or give a function."
            )
        where = points[:, along]
    if values.ndim != 2 or values.shape[1] != count:
        raise ValueError(f"reference: {count} parameters are needed, got shape {values.shape}.")
    order = np.argsort(where)
    return where[order], values[order]
