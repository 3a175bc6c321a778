"""What single modes contribute, and what a reduction leaves of a model."""

from typing import Any

import numpy as np
from jaxtyping import ArrayLike

from lpvid.data import IOData
from lpvid.models import StateSpace
from lpvid.plot._figure import (
    BEFORE,
    DATA_COLOUR,
    FAINT,
    colour,
    dashes,
    dress,
    few_decades,
    grid_of_axes,
    legend,
    legend_above,
    styled,
    with_unit,
)
from lpvid.plot._systems import HZ
from lpvid.reduce import ModalReduction, ModalTable
from lpvid.reduce import modal_responses as responses_of
from lpvid.reduce import modal_table as table_of

_GRID = 600


@styled
def modal_responses(
    model: StateSpace,
    data: IOData,
    *,
    x0: ArrayLike | None = None,
    most: int = 5,
    axes: Any = None,
) -> np.ndarray:
    """The strongest modes' responses to the actual input, one panel for each output.

    Args:
        model: as for `lpvid.reduce.modal_responses`.
        data: the record; its outputs are drawn behind.
        x0: first state, as for `lpvid.reduce.modal_responses`.
        most: how many modes are drawn one by one, by their MRM; the others as their sum.
        axes: where to draw, one for each output; new ones by default.

    Returns:
        The axes, shape (ny,).

    Raises:
        ValueError: `most` below one, or as `lpvid.reduce.modal_responses` raises.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.models import StateSpace
        >>> from lpvid.plot import modal_responses
        >>> model = StateSpace([[0.9, 0.1], [0.0, 0.5]], [[1.0], [1.0]], [[1.0, 1.0]], dt=0.1)
        >>> u = np.ones(20)
        >>> modal_responses(model, IOData(u=u, y=model.simulate(u=u), dt=0.1)).shape
        (1,)
    """
    if most < 1:
        raise ValueError(f"most={most}: draw at least one mode.")
    table = table_of(model, data, x0=x0)
    responses = np.asarray(responses_of(model, data, x0=x0))
    strongest = np.argsort(-np.asarray(table.response_magnitude), kind="stable")
    panels = grid_of_axes(data.ny, 1, axes, size=(7.5, 0.9 + 2.0 * data.ny), sharex=True)[:, 0]
    time = data.dt * np.arange(data.n_samples)
    cut = np.cumsum(data.lengths)[:-1]
    rest = strongest[most:]
    for k, panel in enumerate(panels):
        dress(panel)
        panel.margins(x=0.01)
        measured = np.asarray(data.y)[:, k]
        drawn = [(measured, {"color": FAINT, "linewidth": 2.2, "alpha": 0.5, "label": "record"})]
        for i, mode in enumerate(strongest[:most]):
            look = {"color": colour(i), "linestyle": dashes(i), "linewidth": 1.1}
            drawn.append((responses[mode, :, k], look | {"label": _name(table, int(mode))}))
        if rest.size:
            look = {"color": DATA_COLOUR, "linewidth": 0.8, "label": f"the other {rest.size}"}
            drawn.append((responses[rest, :, k].sum(axis=0), look))
        for signal, look in drawn:
            panel.plot(np.insert(time, cut, np.nan), np.insert(signal, cut, np.nan), **look)
        panel.set_ylabel(with_unit(data.output_names[k], data.output_units[k]))
    legend_above(panels[0])
    panels[-1].set_xlabel("time (s)")
    return panels


@styled
def modal_reduction(reduction: ModalReduction, *, axes: Any = None) -> np.ndarray:
    """The modes by their measures, those kept filled, and the gain with and without the others.

    Args:
        reduction: result of `lpvid.reduce.modal_truncation`.
        axes: where to draw, three; new ones by default.

    Returns:
        The axes, shape (3,): MRM, MSV, largest gain over frequency. A measure that the table lacks
        leaves its panel empty.

    Raises:
        ValueError: another number of axes is given.

    Example:
        >>> import numpy as np
        >>> from lpvid.models import StateSpace
        >>> from lpvid.plot import modal_reduction
        >>> from lpvid.reduce import ModalHankelValue, modal_truncation
        >>> model = StateSpace(np.diag([0.9, 0.5]), [[1.0], [0.1]], [[1.0, 0.1]], dt=0.1)
        >>> modal_reduction(modal_truncation(model, 1, rank=ModalHankelValue())).shape
        (3,)
    """
    table = reduction.table
    panels = grid_of_axes(3, 1, axes, size=(6.2, 7.2), sharex=True)[:, 0]
    hertz = np.asarray(table.frequency) / HZ
    visible = np.isfinite(hertz) & (hertz > 0.0)
    real = np.array(table.sizes) == 1
    kept = np.asarray(reduction.kept)
    measures = ((table.response_magnitude, "MRM"), (table.singular_value, "MSV"))
    for panel, (values, name) in zip(panels, measures, strict=False):
        dress(panel)
        values = np.asarray(values)
        for chosen, is_real, fill, label in (
            (kept, False, True, "pair, kept"),
            (kept, True, True, "real, kept"),
            (~kept, False, False, "pair, left out"),
            (~kept, True, False, "real, left out"),
        ):
            some = chosen & (real == is_real) & visible & (values > 0.0)
            if some.any():
                panel.plot(
                    hertz[some],
                    values[some],
                    linestyle="none",
                    marker="s" if is_real else "o",
                    markersize=6.5,
                    color=colour(0),
                    markerfacecolor=colour(0) if fill else "white",
                    label=label,
                )
        panel.set_yscale("log")
        panel.margins(y=0.15)
        panel.set_ylabel(name)
    legend_above(panels[0])
    _gains(panels[2], reduction, hertz[visible])
    panels[2].set_xlabel("frequency (Hz)")
    return panels


def _name(table: ModalTable, mode: int) -> str:
    hertz = float(table.frequency[mode]) / HZ
    damping = "real" if table.sizes[mode] == 1 else f"ζ = {float(table.damping[mode]):.3f}"
    return f"{table.names[mode]}: {hertz:.3g} Hz, {damping}"


def _gains(panel: Any, reduction: ModalReduction, hertz: np.ndarray) -> None:
    dress(panel)
    whole, reduced = reduction.table.model, reduction.model
    top = 0.5 / whole.dt if whole.is_discrete else 3.0 * np.max(hertz, initial=1.0)
    low = min(0.5 * np.min(hertz, initial=top), 0.1 * top)
    grid = np.unique(np.concatenate([np.geomspace(low, top, _GRID), hertz[hertz < top]]))
    responses = [np.asarray(m.frequency_response(HZ * grid)) for m in (whole, reduced)]
    lines = (
        (responses[0], {"color": DATA_COLOUR, "linewidth": 1.6, "label": "all modes"}),
        (responses[1], {"color": colour(0), "linestyle": dashes(1), "label": "reduced"}),
        (responses[0] - responses[1], BEFORE | {"linewidth": 0.8, "label": "difference"}),
    )
    for response, look in lines:
        gain = np.linalg.norm(response, 2, axis=(1, 2))
        panel.plot(grid, np.where(gain > 0.0, gain, np.nan), **look)
    panel.set_xscale("log")
    panel.set_yscale("log")
    few_decades(panel.xaxis)
    panel.set_ylabel("largest gain")
    legend(panel)
