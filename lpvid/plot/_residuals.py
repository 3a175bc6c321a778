"""Residuals: what a model leaves unexplained, over time, lag and frequency."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy  # its parts load when first used

from lpvid.plot._figure import (
    DATA_COLOUR,
    FAINT,
    Values,
    channel_names,
    colour,
    dress,
    grid_of_axes,
    legend,
    styled,
    with_unit,
)


@styled
def residuals(
    y: Values,
    y_hat: Values,
    dt: float,
    *,
    names: Sequence[str] | None = None,
    units: Sequence[str] | None = None,
    lags: int = 50,
    axes: Any = None,
) -> np.ndarray:
    """Residual y − ŷ of each output: over time, its autocorrelation, its spectrum.

    The band of the autocorrelation holds 95 % of the lags of white noise (±1.96 / √N). The
    spectrum (Welch) is that of the residual beside that of the measured output.

    Args:
        y: measured output of one record, (time,) or (time, ny).
        y_hat: simulated output, same shape.
        dt: sample time in seconds.
        names: one for each output; y1, y2, ... by default.
        units: one for each output; none by default.
        lags: how many lags are shown, from 1, at most half the record.
        axes: where to draw, as many as returned; new ones by default.

    Returns:
        The axes, shape (ny, 3).

    Raises:
        ValueError: shapes that differ, or names, units or axes that do not fit.

    Example:
        >>> import numpy as np
        >>> from lpvid.plot import residuals
        >>> y = np.random.default_rng(0).standard_normal(200)
        >>> residuals(y, np.zeros(200), 0.1).shape
        (1, 3)
    """
    measured, simulated = np.asarray(y, float), np.asarray(y_hat, float)
    if measured.shape != simulated.shape or measured.ndim not in (1, 2):
        raise ValueError(
            f"y_hat: shape {simulated.shape} does not fit y of shape {measured.shape}; both are "
            "(time,) or (time, ny)."
        )
    if measured.ndim == 1:
        measured, simulated = measured[:, None], simulated[:, None]
    count, ny = measured.shape
    outputs = channel_names(names, ny, "y", "names")
    unit = [""] * ny if units is None else channel_names(units, ny, "", "units")
    residual = measured - simulated
    panels = grid_of_axes(ny, 3, axes, size=(10.0, 0.6 + 2.5 * ny))
    for k in range(ny):
        time, lag, spectrum = panels[k]
        for panel in panels[k]:
            dress(panel)
        time.plot(dt * np.arange(count), residual[:, k], color=colour(1), linewidth=0.8)
        time.margins(x=0.01)
        time.set_title(f"residual of {outputs[k]}", loc="left")
        time.set_ylabel(with_unit("residual", unit[k]))
        _draw_autocorrelation(lag, residual[:, k], min(lags, count // 2))
        _draw_spectrum(spectrum, measured[:, k], residual[:, k], dt, unit[k])
    panels[-1, 0].set_xlabel("time (s)")
    panels[-1, 1].set_xlabel("lag (samples)")
    panels[-1, 2].set_xlabel("frequency (Hz)")
    return panels


def _draw_autocorrelation(panel: Any, residual: np.ndarray, lags: int) -> None:
    # Lag 0 is 1 for any signal: without it the rest has room.
    values = _autocorrelation(residual, lags)[1:]
    lag = np.arange(1, lags + 1)
    band = 1.96 / np.sqrt(residual.size)
    panel.axhspan(
        -band, band, color=colour(0), alpha=0.18, linewidth=0, label="95 % of white noise"
    )
    panel.vlines(lag, 0.0, values, color=colour(1), linewidth=1.0)
    panel.plot(
        lag,
        values,
        linestyle="none",
        marker="o",
        markersize=2.5,
        color=colour(1),
        label="_autocorrelation",
    )
    panel.axhline(0.0, color=FAINT, linewidth=0.8)
    # Room around the band, so that a white residual is seen to lie well inside.
    reach = np.nanmax(np.append(np.abs(values), 2.0 * band)) * 1.1
    panel.set_ylim(-reach, reach)
    panel.set_title("autocorrelation", loc="left")
    legend(panel, loc="upper right")


def _autocorrelation(residual: np.ndarray, lags: int) -> np.ndarray:
    """Biased sample autocorrelation at lags 0 to `lags`; NaN for a constant."""
    centred = residual - residual.mean()
    power = centred @ centred
    if power == 0:
        return np.full(lags + 1, np.nan)
    full = scipy.signal.correlate(centred, centred, mode="full", method="fft")
    return full[residual.size - 1 : residual.size + lags] / power


def _draw_spectrum(
    panel: Any, measured: np.ndarray, residual: np.ndarray, dt: float, unit: str
) -> None:
    for signal, label, shade in (
        (measured, "measured", DATA_COLOUR),
        (residual, "residual", colour(1)),
    ):
        panel.plot(*power_spectrum(signal, dt), color=shade, linewidth=0.9, label=label)
    panel.set_xscale("log")
    panel.set_yscale("log")
    density = f", ({unit})²/Hz" if unit else ""
    panel.set_title(f"power spectral density{density}", loc="left")
    legend(panel, loc="lower left")


def power_spectrum(signal: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies in Hz, without zero, and Welch's power spectral density; NaN where it is zero."""
    segment = min(signal.size, max(16, min(signal.size // 4, 1024)))
    frequency, power = scipy.signal.welch(signal, fs=1.0 / dt, nperseg=segment)
    return frequency[1:], np.where(power[1:] > 0, power[1:], np.nan)
