"""Residual tests: correlations with their bands and p-values."""

from typing import Any

import numpy as np

from lpvid.analysis import ResidualTests
from lpvid.plot._figure import FAINT, colour, dress, grid_of_axes, p_value_text, styled


@styled
def residual_tests(tests: ResidualTests, *, axes: Any = None) -> np.ndarray:
    """Autocorrelation of each residual and its correlation with each input, with bands.

    Lags outside their band are drawn in the second colour. The titles give the p-values: of lags
    0 … L for the dynamics from the input, of the negative lags for feedback.

    Args:
        tests: result of `lpvid.analysis.residual_tests`.
        axes: where to draw, as many as returned; new ones by default.

    Returns:
        The axes, shape (ny, 1 + nu).

    Raises:
        ValueError: another number of axes is given.

    Example:
        >>> import numpy as np
        >>> from lpvid.analysis import residual_tests
        >>> from lpvid.plot import residual_tests as draw
        >>> residual, u = np.random.default_rng(0).standard_normal((2, 300))
        >>> draw(residual_tests(residual, u)).shape
        (1, 2)
    """
    ny, nu = len(tests.output_names), len(tests.input_names)
    panels = grid_of_axes(
        ny, 1 + nu, axes, size=(max(5.0, 3.6 * (1 + nu)), 0.7 + 2.4 * ny), sharex="col"
    )
    for k, output in enumerate(tests.output_names):
        band = np.asarray(tests.autocorrelation_band)
        panel: Any = panels[k, 0]
        _draw(panel, np.asarray(tests.lags), np.asarray(tests.autocorrelation)[:, k], band)
        panel.set_ylabel(f"residual of {output}")
        _title(panel, "autocorrelation", p_value_text(tests.whiteness_p[k]))
        for j, source in enumerate(tests.input_names):
            panel = panels[k, 1 + j]
            band = np.asarray(tests.cross_band)[:, k, j]
            values = np.asarray(tests.cross_correlation)[:, k, j]
            _draw(panel, np.asarray(tests.cross_lags), values, band)
            panel.axvline(0.0, color=FAINT, linewidth=0.8)
            dynamics, feedback = tests.dynamics_p[k, j], tests.feedback_p[k, j]
            found = f"{p_value_text(dynamics)} (lags < 0: {p_value_text(feedback)})"
            _title(panel, f"with {source}", found)
    for panel in panels[-1]:
        panel.set_xlabel(f"lag (samples); grey: {100.0 * tests.level:g} %")
    return panels


def _draw(panel: Any, lag: np.ndarray, values: np.ndarray, band: np.ndarray) -> None:
    dress(panel)
    # Half a lag of room on both sides, so that the band is seen at the last lags too.
    where = np.concatenate([[lag[0] - 0.5], lag, [lag[-1] + 0.5]])
    edge = np.concatenate([band[:1], band, band[-1:]])
    panel.fill_between(where, -edge, edge, color=FAINT, alpha=0.25, linewidth=0)
    outside = np.abs(values) > band
    for chosen, shade, name in ((~outside, colour(0), "_inside"), (outside, colour(1), "_outside")):
        panel.vlines(lag[chosen], 0.0, values[chosen], color=shade, linewidth=1.0, label=name)
        panel.plot(
            lag[chosen],
            values[chosen],
            linestyle="none",
            marker="o",
            markersize=2.8,
            color=shade,
            label=name,
        )
    panel.axhline(0.0, color=FAINT, linewidth=0.8)
    reach = 1.1 * max(np.max(np.abs(values)), 2.0 * np.max(band))
    panel.set_ylim(-reach, reach)
    panel.set_xlim(where[0], where[-1])


def _title(panel: Any, name: str, found: str) -> None:
    panel.set_title(name, loc="left")
    panel.set_title(found, loc="right", fontweight="normal", fontsize=8.0)
