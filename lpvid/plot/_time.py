"""Records, and models beside them, over time."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from lpvid.analysis import bft
from lpvid.data import IOData
from lpvid.models import LPVStateSpace
from lpvid.plot._figure import (
    DATA_COLOUR,
    FAINT,
    colour,
    dashes,
    dress,
    grid_of_axes,
    labelled,
    legend_above,
    model_of,
    styled,
    with_unit,
)


@styled
def records(data: IOData, *, axes: Any = None) -> np.ndarray:
    """Inputs, outputs and scheduling over time, one panel for each channel.

    Several records follow one another, with a line between them.

    Args:
        data: one or several records.
        axes: where to draw, one for each channel; new ones by default.

    Returns:
        The axes, shape (nu + ny + nk,), inputs first.

    Raises:
        ValueError: another number of axes than channels.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.plot import records
        >>> t = 0.01 * np.arange(200)
        >>> records(IOData(u=np.sin(t), y=np.cos(t), kappa=0.3, dt=0.01)).shape
        (3,)
    """
    groups = [
        (data.u, data.input_names, data.input_units, colour(0), "input"),
        (data.y, data.output_names, data.output_units, DATA_COLOUR, "output"),
    ]
    if data.kappa is not None:
        groups.append(
            (data.kappa, data.scheduling_names, data.scheduling_units, colour(2), "scheduling")
        )
    channels = [
        (np.asarray(signal)[:, k], f"{kind} {names[k]}", units[k], shade)
        for signal, names, units, shade, kind in groups
        for k in range(len(names))
    ]
    count = len(channels)
    panels = grid_of_axes(count, 1, axes, size=(7.5, 0.6 + 1.4 * count), sharex=True)[:, 0]
    for panel, (signal, title, unit, shade) in zip(panels, channels, strict=True):
        dress(panel)
        panel.margins(x=0.01)
        panel.plot(*_over_time(data, signal), color=shade, linewidth=1.0)
        # Long names would run into their neighbours if they stood upright.
        panel.set_title(title, loc="left")
        panel.set_ylabel(unit)
        _separate_records(panel, data)
    panels[-1].set_xlabel("time (s)")
    return panels


@styled
def compare(
    data: IOData,
    models: Any,
    labels: Sequence[str] | str | None = None,
    *,
    axes: Any = None,
) -> np.ndarray:
    """Measured outputs beside simulated ones, with their residuals below.

    The legend gives the best fit rate (BFT) over all records in percent.

    Args:
        data: one or several records.
        models: one or several (a sequence, or a mapping from label to model) of: models
            (`StateSpace`, `LPVStateSpace`) and results that hold one, simulated from rest record by
            record; outputs simulated already, (time, ny).
        labels: one for each model of a sequence.
        axes: where to draw, two for each output; new ones by default.

    Returns:
        The axes, shape (ny, 2): measured and simulated, residual.

    Raises:
        ValueError: an output has another shape than the measured one, or an LPV model meets data
            without scheduling.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.models import StateSpace
        >>> from lpvid.plot import compare
        >>> u = np.sin(0.01 * np.arange(200))
        >>> lag = StateSpace([[-5.0]], [[5.0]], [[1.0]]).discretise(0.01)
        >>> compare(IOData(u=u, y=u, dt=0.01), {"lag": lag}).shape
        (1, 2)
    """
    outputs = {
        label: _simulated(data, model, label)
        for label, model in labelled(models, labels, "models", "model").items()
    }
    measured = np.asarray(data.y)
    scores = {label: np.asarray(bft(measured, output)) for label, output in outputs.items()}
    ny = data.ny
    panels = grid_of_axes(
        2 * ny,
        1,
        axes,
        size=(7.5, 0.6 + 3.2 * ny),
        sharex=True,
        height_ratios=[2.0, 1.0] * ny,
    )[:, 0].reshape(ny, 2)
    for k, (main, rest) in enumerate(panels):
        for panel in (main, rest):
            dress(panel)
            panel.margins(x=0.01)
        main.plot(
            *_over_time(data, measured[:, k]), color=DATA_COLOUR, linewidth=1.6, label="measured"
        )
        for i, (label, output) in enumerate(outputs.items()):
            look = {"color": colour(i), "linestyle": dashes(i), "linewidth": 1.1}
            text = f"{label}: BFT {scores[label][k]:.2f} %"
            main.plot(*_over_time(data, output[:, k]), label=text, **look)
            rest.plot(*_over_time(data, measured[:, k] - output[:, k]), label=label, **look)
        main.set_ylabel(with_unit(data.output_names[k], data.output_units[k]))
        rest.set_ylabel(with_unit("residual", data.output_units[k]))
        _separate_records(main, data)
        _separate_records(rest, data)
        legend_above(main)
    panels[-1, 1].set_xlabel("time (s)")
    return panels


def _simulated(data: IOData, model: Any, label: str) -> np.ndarray:
    model = model_of(model)
    if isinstance(model, LPVStateSpace):
        parts = []
        for record in data.records:
            if record.kappa is None:
                raise ValueError(
                    f"data: the LPV model {label!r} needs the scheduling; give kappa= to IOData."
                )
            parts.append(model.simulate(u=record.u, kappa=record.kappa, dt=record.dt))
        output = np.concatenate([np.asarray(part) for part in parts])
    elif hasattr(model, "simulate"):
        parts = [model.simulate(u=r.u, dt=r.dt) for r in data.records]
        output = np.concatenate([np.asarray(part) for part in parts])
    else:
        output = np.asarray(model, float)
    output = output[:, None] if output.ndim == 1 else output
    if output.shape != data.y.shape:
        raise ValueError(
            f"models: {label!r} has outputs of shape {output.shape}, measured are {data.y.shape}."
        )
    return output


def _over_time(data: IOData, signal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Time and signal of the records one after another, broken by a NaN between them."""
    time = data.dt * np.arange(data.n_samples)
    cuts = np.cumsum(data.lengths)[:-1]
    return np.insert(time, cuts, data.dt * cuts), np.insert(signal, cuts, np.nan)


def _separate_records(panel: Any, data: IOData) -> None:
    for cut in np.cumsum(data.lengths)[:-1]:
        panel.axvline(data.dt * (cut - 0.5), color=FAINT, linewidth=0.8, linestyle=":")
