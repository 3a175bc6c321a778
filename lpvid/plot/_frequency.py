"""Frequency responses: Bode magnitude and phase, singular values."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from lpvid.models import StateSpace
from lpvid.plot._bands import draw_bands
from lpvid.plot._figure import (
    Axes,
    Values,
    channel_names,
    colour,
    dashes,
    dress,
    grid_of_axes,
    legend,
    styled,
)
from lpvid.plot._systems import (
    HZ,
    continuous_poles,
    response_of,
    response_uncertainty,
    state_spaces,
    uncertain,
)


@styled
def bode(
    systems: Any,
    omega: Values | None = None,
    labels: Sequence[str] | str | None = None,
    *,
    phase: bool = False,
    decibels: bool = True,
    level: float | None = 0.95,
    input_names: Sequence[str] | None = None,
    output_names: Sequence[str] | None = None,
    axes: Any = None,
) -> np.ndarray:
    """Magnitude of every entry of the transfer matrix: outputs down, inputs across.

    Args:
        systems: a `StateSpace`, a result that holds one, or several in a sequence or a mapping from
            label to system. A batch of models is drawn in one colour. A refined model comes with
            its confidence bands (one frequency at a time, delta method).
        omega: frequencies in rad/s; by default a decade around the poles. A discrete-time model is
            drawn up to its Nyquist frequency.
        labels: one for each system of a sequence.
        phase: add a row with the phase, unwrapped, in degrees, below each output.
        decibels: magnitude in dB, or on a logarithmic axis.
        level: probability of the confidence bands; `None` for no bands.
        input_names: one for each input; u1, u2, ... by default.
        output_names: one for each output; y1, y2, ... by default.
        axes: where to draw, as many as returned; new ones by default.

    Returns:
        The axes, shape (ny, nu), or (2 ny, nu) with phase.

    Raises:
        ValueError: systems with different numbers of inputs or outputs, names or axes that do not
            fit, a level that is no probability, or no frequency below the Nyquist frequency.

    Example:
        >>> from lpvid.models import StateSpace
        >>> from lpvid.plot import bode
        >>> lag = StateSpace([[-1.0]], [[1.0]], [[1.0]])
        >>> bode([lag, lag.discretise(0.1)], labels=["continuous", "sampled"], phase=True).shape
        (2, 1)
    """
    models = state_spaces(systems, labels)
    ny, nu = _common_size(models)
    inputs = channel_names(input_names, nu, "u", "input_names")
    outputs = channel_names(output_names, ny, "y", "output_names")
    responses = _responses(models, omega)
    known = uncertain(systems, labels, level)
    rows = 2 if phase else 1
    panels = grid_of_axes(
        rows * ny,
        nu,
        axes,
        size=(max(5.5, 0.8 + 3.2 * nu), 0.8 + (3.6 if phase else 2.4) * ny),
        sharex=True,
        height_ratios=[1.6, 1.0] * ny if phase else None,
    )
    for panel in panels.ravel():
        dress(panel)
    for index, (label, (grid, response)) in enumerate(responses.items()):
        look = _look(index, response.shape[0])
        for (k, j), panel in np.ndenumerate(panels[::rows]):
            for member, one in enumerate(response[:, :, k, j]):
                name = label if member == 0 else "_"
                panel.plot(grid / HZ, _magnitude(one, decibels), label=name, **look)
                if phase:
                    below: Any = panels[rows * k + 1, j]
                    below.plot(grid / HZ, _phase(one), **look)
        if label in known and level is not None:
            spread = response_uncertainty(known[label], grid)
            draw_bands(panels, rows, grid / HZ, spread, level, decibels, colour(index))
    for (k, j), panel in np.ndenumerate(panels):
        panel.set_xscale("log")
        is_phase = phase and k % 2 == 1
        if is_phase:
            panel.yaxis.set_major_locator(_quarter_turns())
        elif not decibels:
            panel.set_yscale("log")
        if j == 0:
            quantity = "phase (deg)" if is_phase else _magnitude_label(decibels)
            panel.set_ylabel(quantity)
        if not is_phase:
            panel.set_title(f"{outputs[k // rows]} from {inputs[j]}", loc="left")
        if k == rows * ny - 1:
            panel.set_xlabel("frequency (Hz)")
    if len(models) > 1 or labels is not None or known:
        legend(panels[0, 0])
    return panels


@styled
def singular_values(
    systems: Any,
    omega: Values | None = None,
    labels: Sequence[str] | str | None = None,
    *,
    decibels: bool = True,
    axes: Axes | None = None,
) -> Axes:
    """Singular values of the transfer matrix over frequency; the peak of the largest is H∞.

    Args:
        systems: as for `bode`, but with any numbers of inputs and outputs.
        omega: as for `bode`.
        labels: as for `bode`.
        decibels: as for `bode`.
        axes: where to draw; new ones by default.

    Raises:
        ValueError: no frequency lies below the Nyquist frequency.

    Example:
        >>> from lpvid.models import StateSpace
        >>> from lpvid.plot import singular_values
        >>> fast, slow = (StateSpace([[-p]], [[p]], [[1.0]]) for p in (2.0, 1.0))
        >>> singular_values({"error": fast - slow}).get_xlabel()
        'frequency (Hz)'
    """
    models = state_spaces(systems, labels)
    responses = _responses(models, omega)
    panel = grid_of_axes(1, 1, axes, size=(6.0, 3.6))[0, 0]
    dress(panel)
    for index, (label, (grid, response)) in enumerate(responses.items()):
        look = _look(index, response.shape[0])
        values = np.linalg.svd(response, compute_uv=False)
        for member in range(values.shape[0]):
            for order in range(values.shape[-1]):
                name = label if member == order == 0 else "_"
                curve = _magnitude(values[member, :, order], decibels)
                panel.plot(grid / HZ, curve, label=name, **look)
    panel.set_xscale("log")
    if not decibels:
        panel.set_yscale("log")
    panel.set_xlabel("frequency (Hz)")
    panel.set_ylabel(_magnitude_label(decibels).replace("magnitude", "singular values"))
    if len(models) > 1 or labels is not None:
        legend(panel)
    return panel


def _common_size(models: dict[str, StateSpace]) -> tuple[int, int]:
    sizes = {label: (model.ny, model.nu) for label, model in models.items()}
    if len(set(sizes.values())) > 1:
        listed = ", ".join(f"{label!r} {ny} x {nu}" for label, (ny, nu) in sizes.items())
        raise ValueError(
            f"systems: outputs x inputs differ ({listed}); plot them apart, or use singular_values."
        )
    return next(iter(sizes.values()))


def _look(index: int, members: int) -> dict[str, Any]:
    # A cloud of models is drawn thin and translucent, so that its density shows.
    several = members > 1
    return {
        "color": colour(index),
        "linestyle": "-" if several else dashes(index),
        "linewidth": 0.7 if several else 1.4,
        "alpha": max(0.12, min(0.6, 6.0 / members)) if several else 1.0,
    }


def _responses(
    models: dict[str, StateSpace], omega: Values | None
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Label → frequencies in rad/s, response (member, frequency, ny, nu)."""
    grids = {label: _grid(omega, model, models) for label, model in models.items()}
    return {label: (grid, response_of(models[label], grid)) for label, grid in grids.items()}


def _grid(omega: Values | None, model: StateSpace, models: dict[str, StateSpace]) -> np.ndarray:
    """Frequencies to draw `model` at, in rad/s, up to its Nyquist frequency."""
    nyquist = np.pi / model.dt if model.is_discrete else np.inf
    if omega is not None:
        given = np.atleast_1d(np.asarray(omega, float))
        if given.ndim != 1 or not np.all(given >= 0):
            raise ValueError("omega: a one-dimensional array of frequencies from 0 is needed.")
        given = given[given <= nyquist * (1 + 1e-9)]
        if given.size == 0:
            raise ValueError(
                f"omega: none lies below the Nyquist frequency, {nyquist:.4g} rad/s, of a system."
            )
        return given
    low, high = _range(models)
    grid = np.geomspace(low, high, 400)
    poles = continuous_poles(model).ravel()
    # A sharp peak between two points of a plain grid would be cut off.
    upper = poles[poles.imag > 0]
    around = np.linspace(-4.0, 4.0, 17)
    close = (upper.imag[:, None] + np.abs(upper.real)[:, None] * around[None]).ravel()
    if close.size > 2000:
        close = close[:: close.size // 2000 + 1]
    grid = np.union1d(grid, close[(close > low) & (close < high)])
    if nyquist <= high:
        return np.append(grid[grid < nyquist], nyquist)
    return grid


def _range(models: dict[str, StateSpace]) -> tuple[float, float]:
    """From a decade below the slowest pole to a decade above the fastest, in rad/s."""
    lows, highs = [], []
    for model in models.values():
        sizes = np.abs(continuous_poles(model).ravel())
        nyquist = np.pi / model.dt if model.is_discrete else np.inf
        # Integrators and deadbeat poles say nothing about the frequencies of interest.
        sizes = sizes[np.isfinite(sizes) & (sizes > 1e-9 * np.max(sizes, initial=0.0))]
        if sizes.size:
            lows.append(np.min(sizes) / 10.0)
            highs.append(min(np.max(sizes) * 10.0, nyquist))
        elif np.isfinite(nyquist):
            lows.append(1e-3 * nyquist)
            highs.append(nyquist)
    low, high = (min(lows), max(highs)) if lows else (0.1, 10.0)
    return float(min(low, 0.1 * high)), float(high)


def _magnitude(response: np.ndarray, decibels: bool) -> np.ndarray:
    size = np.abs(response)
    size = np.where(size > 0, size, np.nan)
    return 20.0 * np.log10(size) if decibels else size


def _magnitude_label(decibels: bool) -> str:
    return "magnitude (dB)" if decibels else "magnitude"


def _quarter_turns() -> Any:
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(nbins=5, steps=[1, 1.8, 3.6, 4.5, 9, 10])


def _phase(response: np.ndarray) -> np.ndarray:
    if not np.any(response):
        return np.full(response.shape, np.nan)
    return np.rad2deg(np.unwrap(np.angle(response)))
