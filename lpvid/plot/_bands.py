"""Confidence regions: bands around responses, ellipses around poles."""

import math
from statistics import NormalDist
from typing import Any

import numpy as np

from lpvid.analysis import PoleUncertainty

# A lower limit at or below zero has no place on a logarithmic axis: it is drawn this far down.
_LOWEST_SHARE = 1e-3
_SHADE = 0.2


def normal_quantile(level: float) -> float:
    """Half-width that holds a probability, in standard deviations."""
    return NormalDist().inv_cdf(0.5 + 0.5 * level)


def draw_bands(
    panels: np.ndarray,
    rows: int,
    hertz: np.ndarray,
    known: tuple[np.ndarray, np.ndarray, np.ndarray],
    level: float,
    decibels: bool,
    shade: str,
) -> None:
    """Bands of magnitude (and of phase, with two rows an output) on axes that have their lines."""
    width = normal_quantile(level)
    response, size_std, phase_std = known
    size, spread, turn = np.abs(response), width * size_std, width * np.rad2deg(phase_std)
    for (row, j), panel in np.ndenumerate(panels):
        k = row // rows
        if rows == 2 and row % 2 == 1:
            if not np.any(response[:, k, j]):
                continue
            middle = np.rad2deg(np.unwrap(np.angle(response[:, k, j])))
            # Beyond half a turn nothing is known of the phase.
            half = np.minimum(turn[:, k, j], 180.0)
            low, high, label = middle - half, middle + half, "_band"
        else:
            middle = size[:, k, j]
            low = np.maximum(middle - spread[:, k, j], _LOWEST_SHARE * middle)
            high = middle + spread[:, k, j]
            if not np.any(high):
                continue
            if decibels:
                middle, low, high = (
                    20.0 * np.log10(np.where(value > 0, value, np.nan))
                    for value in (middle, low, high)
                )
            label = f"{100.0 * level:g} % band"
        _fill(panel, hertz, low, high, label, shade)


def _fill(panel: Any, hertz, low, high, label: str, shade: str) -> None:
    """A band that widens the axes for its upper edge alone."""
    limits = panel.dataLim.frozen()
    panel.fill_between(hertz, low, high, color=shade, alpha=_SHADE, linewidth=0, label=label)
    reach = np.array([[hertz[0], np.nanmax(high)], [hertz[-1], np.nanmin(high)]])
    panel.dataLim.set(limits)
    panel.update_datalim(reach)
    panel.autoscale_view()


def draw_regions(
    panel: Any, known: PoleUncertainty, level: float, scale: float, shade: str
) -> None:
    """Ellipse around each complex pole, an interval around each real one.

    Args:
        panel: where to draw.
        known: poles and their covariances.
        level: probability that a region holds its pole.
        scale: what the plane is divided by.
        shade: colour.
    """
    radius, width = math.sqrt(-2.0 * math.log1p(-level)), normal_quantile(level)
    angle = np.linspace(0.0, 2.0 * np.pi, 73)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    label = f"{100.0 * level:g} % region"
    for pole, covariance in zip(
        np.asarray(known.poles) / scale, np.asarray(known.covariance) / scale**2, strict=True
    ):
        if not np.all(np.isfinite(covariance)):
            continue
        if abs(pole.imag) <= 1e-9 * abs(pole):
            half = width * math.sqrt(covariance[0, 0])
            x, y = np.array([pole.real - half, pole.real + half]), np.zeros(2)
        else:
            values, vectors = np.linalg.eigh(covariance)
            edge = vectors @ (radius * np.sqrt(np.maximum(values, 0.0))[:, None] * circle)
            x, y = pole.real + edge[0], pole.imag + edge[1]
            panel.fill(x, y, color=shade, alpha=_SHADE, linewidth=0, label="_region", zorder=2)
        # A bar at both ends: a real pole's interval lies on the axis.
        ends = {"marker": "|", "markersize": 9.0} if len(x) == 2 else {}
        panel.plot(x, y, color=shade, linewidth=1.1, label=label, zorder=2, **ends)
        label = "_region"
