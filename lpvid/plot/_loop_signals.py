"""Held-out signals before and after the loop was closed: outputs, residuals, spectra."""

from typing import Any

import numpy as np

from lpvid.loop import Loop
from lpvid.plot._figure import (
    AFTER,
    BEFORE,
    DATA_COLOUR,
    FAINT,
    LOOP_WIDTH,
    NOISE_FLOOR,
    dress,
    few_decades,
    grid_of_axes,
    legend_above,
    styled,
    with_unit,
)
from lpvid.plot._residuals import power_spectrum

# Room beside the measured range that a simulation may use before it is cut.
_ROOM = 0.6


@styled
def loop_responses(
    found: Loop, *, span: tuple[float, float] | None = None, axes: Any = None
) -> np.ndarray:
    """Held-out outputs beside the simulations before and after, with their errors below.

    What runs far out of the measured range is cut; the legend gives the best fit rate (BFT).

    Args:
        found: result of `lpvid.loop.close_the_loop`.
        span: first and last time to show, s; all by default.
        axes: where to draw, two for each output; new ones by default.

    Returns:
        The axes, shape (ny, 2): outputs, errors.

    Raises:
        ValueError: another number of axes is given, or nothing lies in `span`.

    Example:
        >>> loop_responses(loop, span=(20.0, 25.0))  # doctest: +SKIP
    """
    series = found.series
    ny = len(found.output_names)
    time, *signals = _unfolded(series.time, found.dt, series.output, series.before, series.after)
    chosen = np.full(time.size, True) if span is None else (time >= span[0]) & (time <= span[1])
    if not np.any(chosen):
        raise ValueError(f"span: no held-out sample in {span}; time runs {time[0]} … {time[-1]} s.")
    time = time[chosen]
    output, before, after = (signal[chosen] for signal in signals)
    size = (LOOP_WIDTH, 0.7 + 3.4 * ny)
    panels = grid_of_axes(
        2 * ny, 1, axes, size=size, sharex=True, height_ratios=[2.0, 1.0] * ny
    ).reshape(ny, 2)
    for k, (main, rest) in enumerate(panels):
        for panel in (main, rest):
            dress(panel)
            panel.margins(x=0.01)
        measured = output[:, k]
        main.plot(time, measured, color=DATA_COLOUR, linewidth=1.6, label="measured")
        for name, simulated, errors, look in (
            ("before", before[:, k], found.before, BEFORE),
            ("after", after[:, k], found.after, AFTER),
        ):
            fit = float(errors.bft[k])
            text = f"{name}: BFT {fit:.2f} %" if np.isfinite(fit) else name
            main.plot(time, simulated, linewidth=1.0, label=text, **look)
            rest.plot(time, measured - simulated, linewidth=0.9, label=name, **look)
        low, high = np.nanmin(measured), np.nanmax(measured)
        room = _ROOM * (high - low)
        _keep_readable(main, low - room, high + room)
        _keep_readable(rest, low - high - room, high - low + room)
        main.set_ylabel(_output(found, k))
        rest.set_ylabel(with_unit("error", found.output_units[k]))
        legend_above(main)
    panels[-1, 1].set_xlabel("time (s)")
    return panels


@styled
def loop_residuals(found: Loop, *, axes: Any = None) -> np.ndarray:
    """One-step prediction errors on held-out data, before and after, one panel for each output.

    Args:
        found: result of `lpvid.loop.close_the_loop`.
        axes: where to draw, one for each output; new ones by default.

    Returns:
        The axes, shape (ny,).

    Raises:
        ValueError: another number of axes is given.

    Example:
        >>> loop_residuals(loop)  # doctest: +SKIP
    """
    series = found.series
    ny = len(found.output_names)
    time, before, after = _unfolded(
        series.time, found.dt, series.residual_before, series.residual_after
    )
    panels = grid_of_axes(ny, 1, axes, size=(LOOP_WIDTH, 0.8 + 1.9 * ny), sharex=True)[:, 0]
    for k, panel in enumerate(panels):
        dress(panel)
        panel.margins(x=0.01)
        for name, values, errors, look in (
            ("before", before, found.before, BEFORE),
            ("after", after, found.after, AFTER),
        ):
            text = f"{name}: RMS {float(errors.one_step[k]):.3g} {found.output_units[k]}".rstrip()
            # Solid: the gaps of a dashed line would hide samples.
            panel.plot(time, values[:, k], color=look["color"], linewidth=0.7, label=text)
        panel.set_ylabel(_output(found, k))
        legend_above(panel)
    panels[-1].set_xlabel("time (s)")
    return panels


@styled
def loop_spectra(found: Loop, *, axes: Any = None) -> np.ndarray:
    """Power spectral density of the one-step prediction errors, before and after.

    Welch's estimate, one panel for each output, beside the measured output's and that of white
    noise as large as the noise floor.

    Args:
        found: result of `lpvid.loop.close_the_loop`.
        axes: where to draw, one for each output; new ones by default.

    Returns:
        The axes, shape (ny,).

    Raises:
        ValueError: another number of axes is given.

    Example:
        >>> loop_spectra(loop)  # doctest: +SKIP
    """
    series = found.series
    ny = len(found.output_names)
    panels = grid_of_axes(ny, 1, axes, size=(LOOP_WIDTH, 0.8 + 2.3 * ny), sharex=True)[:, 0]
    for k, panel in enumerate(panels):
        dress(panel)
        for name, values, look in (
            ("measured", series.output, {"color": FAINT}),
            ("before", series.residual_before, BEFORE),
            ("after", series.residual_after, AFTER),
        ):
            frequency, power = power_spectrum(values[:, k], found.dt)
            panel.plot(frequency, power, linewidth=1.0, label=name, **look)
        floor = float(found.noise_floor[k])
        if np.isfinite(floor) and floor > 0.0:
            # White noise spreads its variance evenly from 0 to half the sampling frequency.
            panel.axhline(2.0 * found.dt * floor**2, **NOISE_FLOOR)
        panel.set_xscale("log")
        panel.set_yscale("log")
        few_decades(panel.xaxis)
        unit = found.output_units[k]
        panel.set_ylabel(f"{found.output_names[k]}: PSD{f' (({unit})²/Hz)' if unit else ''}")
        legend_above(panel)
    panels[-1].set_xlabel("frequency (Hz)")
    return panels


def _output(found: Loop, k: int) -> str:
    return with_unit(found.output_names[k], found.output_units[k])


def _unfolded(time: np.ndarray, dt: float, *signals: np.ndarray) -> tuple[np.ndarray, ...]:
    """Records one after another: time runs on where it starts anew, with a NaN at every break."""
    time = np.asarray(time, float)
    step = np.diff(time)
    again = np.flatnonzero(step <= 0.0) + 1
    breaks = np.flatnonzero((step <= 0.0) | (step > 1.5 * dt)) + 1
    shift = np.zeros(time.size)
    for start in again:
        shift[start:] += time[start - 1] + dt - time[start]
    whole = time + shift
    gaps = (np.insert(np.asarray(signal, float), breaks, np.nan, axis=0) for signal in signals)
    return (np.insert(whole, breaks, whole[breaks]), *gaps)


def _keep_readable(panel: Any, low: float, high: float) -> None:
    bottom, top = panel.get_ylim()
    if high > low:
        panel.set_ylim(max(bottom, low), min(top, high))
