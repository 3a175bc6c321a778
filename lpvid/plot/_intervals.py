"""How well parameters are known: intervals, and the likelihood along one of them."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from lpvid.plot._bands import normal_quantile
from lpvid.plot._figure import (
    FAINT,
    MARKERS,
    REFERENCE_COLOUR,
    Axes,
    Values,
    channel_names,
    colour,
    dress,
    grid_of_axes,
    labelled,
    legend_above,
    styled,
)


@styled
def parameter_intervals(
    results: Any,
    labels: Sequence[str] | str | None = None,
    *,
    reference: Values | None = None,
    names: Sequence[str] | None = None,
    which: Sequence[int] | None = None,
    level: float = 0.95,
    robust: bool = False,
    axes: Axes | None = None,
) -> Axes:
    """Estimated parameters with their confidence intervals, one row each.

    Drawn relative to the reference in percent, so that parameters of any size and unit share an
    axis; relative to the first result where there is no reference, and in their own units where a
    reference is zero. A dotted line through the panel is a parameter that the data do not identify.

    Args:
        results: one, a sequence or a mapping from label to one, of: a result with `parameters` and
            `covariance` such as a `Refined`; a pair (parameters, covariance).
        labels: one for each result of a sequence.
        reference: true or nominal parameters, drawn as a line.
        names: of the parameters; those of the result by default.
        which: indices of the parameters to draw; all by default.
        level: probability of the intervals.
        robust: take the result's `robust_covariance`, which holds for coloured residuals.
        axes: where to draw; new ones by default.

    Raises:
        ValueError: results of different numbers of parameters, or names or reference that do not
            fit.

    Example:
        >>> import numpy as np
        >>> from lpvid.plot import parameter_intervals
        >>> result = ([10.0, 0.1], np.diag([0.04, 1e-6]))
        >>> parameter_intervals({"fit": result}, names=["mass", "damping"]).get_xlabel()
        'deviation from the first result (%)'
    """
    if isinstance(results, tuple) and len(results) == 2 and np.ndim(results[1]) == 2:
        results = [results]
    found = labelled(results, labels, "results", "estimate")
    estimates = {label: _estimate(item, level, robust) for label, item in found.items()}
    counts = {values.size for values, _ in estimates.values()}
    if len(counts) > 1:
        raise ValueError(f"results: {sorted(counts)} parameters do not share a plot.")
    count = counts.pop()
    own_names = getattr(next(iter(found.values())), "parameter_names", None)
    rows = channel_names(own_names if names is None else names, count, "p", "names")
    chosen = np.arange(count) if which is None else np.asarray(which, int)
    truth = None if reference is None else np.asarray(reference, float)
    if truth is not None and truth.shape != (count,):
        raise ValueError(f"reference: shape {truth.shape} given for {count} parameters.")
    base = next(iter(estimates.values()))[0] if truth is None else truth
    relative = bool(np.all(base[chosen] != 0.0))
    zero = base[chosen] if relative else np.zeros(chosen.size)
    unit = 100.0 / np.abs(base[chosen]) if relative else np.ones(chosen.size)

    panel = grid_of_axes(1, 1, axes, size=(6.0, 1.2 + 0.32 * chosen.size))[0, 0]
    dress(panel)
    panel.grid(False, axis="y")
    place = np.arange(chosen.size, dtype=float)
    if truth is not None and relative:
        panel.axvline(0.0, color=REFERENCE_COLOUR, linewidth=1.0, label="reference", zorder=2)
    elif truth is not None:
        panel.plot(
            truth[chosen],
            place,
            linestyle="none",
            marker="|",
            markersize=11.0,
            markeredgewidth=1.4,
            color=REFERENCE_COLOUR,
            label="reference",
            zorder=4,
        )
    for index, (label, (values, half)) in enumerate(estimates.items()):
        offset = 0.5 * (index - (len(estimates) - 1) / 2.0) / len(estimates)
        panel.errorbar(
            (values[chosen] - zero) * unit,
            place + offset,
            xerr=np.where(np.isfinite(half), half, 0.0)[chosen] * unit,
            linestyle="none",
            marker=MARKERS[index % len(MARKERS)],
            markersize=4.5,
            capsize=2.5,
            linewidth=1.2,
            color=colour(index),
            label=f"{label}, {100.0 * level:g} %",
            zorder=3,
        )
        for row in np.flatnonzero(~np.isfinite(half[chosen])):
            # Known to no side: a line through the whole panel.
            panel.axhline(place[row] + offset, color=colour(index), linewidth=0.9, linestyle=":")
    if truth is None and relative:
        panel.axvline(0.0, color=FAINT, linewidth=0.8)
    panel.set_yticks(place, [rows[index] for index in chosen])
    panel.set_ylim(chosen.size - 0.4, -0.6)
    if relative:
        against = "the first result" if truth is None else "the reference"
        panel.set_xlabel(f"deviation from {against} (%)")
    else:
        panel.set_xlabel("parameter")
    legend_above(panel)
    return panel


def _estimate(item: Any, level: float, robust: bool) -> tuple[np.ndarray, np.ndarray]:
    """Parameters and the half-widths of their intervals; infinite where nothing is known."""
    if hasattr(item, "confidence_intervals"):
        ends = np.asarray(item.confidence_intervals(level, robust=robust))
        return np.asarray(item.parameters, float), 0.5 * (ends[:, 1] - ends[:, 0])
    if isinstance(item, tuple):
        values, covariance = item
    else:
        values = item.parameters
        covariance = item.robust_covariance if robust else item.covariance
    values, variance = np.asarray(values, float), np.diagonal(np.asarray(covariance, float))
    if values.shape != variance.shape:
        raise ValueError(
            f"results: {values.shape} parameters with a covariance of {np.shape(covariance)}."
        )
    return values, normal_quantile(level) * np.sqrt(np.maximum(variance, 0.0))


@styled
def profile_likelihood(
    profile: Any, *, level: float = 0.95, name: str | None = None, axes: Axes | None = None
) -> Axes:
    """Likelihood along one parameter, the others fitted anew at each of its values.

    The interval (grey lines) is where the curve stays below the dotted line. A parabola of the
    standard error's width (dashed) on the curve says that the usual interval is right; a curve that
    does not reach the line on one side says that the data do not bound the parameter there.

    Args:
        profile: result of `lpvid.refinement.profile_likelihood`.
        level: probability of the interval.
        name: of the parameter; that of the profile by default.
        axes: where to draw; new ones by default.

    Raises:
        ValueError: a level that is no probability.

    Example:
        >>> import numpy as np
        >>> from types import SimpleNamespace
        >>> from lpvid.plot import profile_likelihood
        >>> mass = np.linspace(1.0, 3.0, 21)
        >>> profile = SimpleNamespace(
        ...     name="mass", estimate=2.0, values=mass, increase=20.0 * np.log(mass / 2.0) ** 2,
        ...     standard_error=0.3, interval=lambda level: (1.47, 2.73),
        ... )
        >>> profile_likelihood(profile, name="mass (kg)").get_xlabel()
        'mass (kg)'
    """
    low, high = (float(end) for end in profile.interval(level))
    where, ratio = np.asarray(profile.values), 2.0 * np.asarray(profile.increase)
    estimate, error = float(profile.estimate), float(profile.standard_error)
    limit = normal_quantile(level) ** 2
    panel = grid_of_axes(1, 1, axes, size=(5.5, 3.4))[0, 0]
    dress(panel)
    look = {"color": colour(0), "linewidth": 1.4, "marker": "o", "markersize": 3.5}
    panel.plot(where, ratio, label="profile", **look)
    if np.isfinite(error) and error > 0.0:
        fine = np.linspace(where[0], where[-1], 201)
        parabola = ((fine - estimate) / error) ** 2
        panel.plot(
            fine, parabola, color=colour(1), linestyle="--", linewidth=1.1, label="from covariance"
        )
    panel.axhline(limit, color=FAINT, linewidth=1.0, linestyle=":", label=f"{100.0 * level:g} %")
    for end in (low, high):
        if np.isfinite(end):
            panel.axvline(end, color=FAINT, linewidth=0.8)
    panel.axvline(estimate, color=REFERENCE_COLOUR, linewidth=0.8, label="estimate")
    panel.set_ylim(0.0, max(1.4 * limit, min(1.1 * float(np.nanmax(ratio)), 3.0 * limit)))
    panel.set_xlabel(profile.name if name is None else name)
    panel.set_ylabel("likelihood ratio, 2 × increase")
    legend_above(panel)
    return panel
