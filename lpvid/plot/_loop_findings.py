"""What closing the loop found: virtual forces, errors over horizons, candidates ranked."""

from typing import Any

import numpy as np

from lpvid.loop import Candidate, Loop, VirtualForce
from lpvid.plot._figure import (
    AFTER,
    BEFORE,
    DATA_COLOUR,
    FAINT,
    LOOP_WIDTH,
    NOISE_FLOOR,
    colour,
    dress,
    few_decades,
    grid_of_axes,
    legend_above,
    p_value_text,
    styled,
    with_unit,
)

# Points of a cloud, bins of its means, points of a law's curve.
_CLOUD, _BINS, _LAW = 3000, 30, 300


@styled
def virtual_forces(found: Loop, *, axes: Any = None) -> np.ndarray:
    """What the model lacks at each effect's port against what it depends on, and the law found.

    Dots are held-out samples, circles their means over equal shares of the samples, the line is
    the law; a law with memory goes round in loops.

    Args:
        found: result of `lpvid.loop.close_the_loop`.
        axes: where to draw, one for each effect; new ones by default.

    Returns:
        The axes, shape (effect,); empty where no effect was found.

    Raises:
        ValueError: another number of axes is given.

    Example:
        >>> virtual_forces(loop)  # doctest: +SKIP
    """
    count = len(found.virtual_forces)
    if count == 0:
        return np.empty(0, object)
    panels = grid_of_axes(count, 1, axes, size=(LOOP_WIDTH, 0.4 + 2.8 * count))[:, 0]
    for panel, force in zip(panels, found.virtual_forces, strict=True):
        dress(panel)
        _draw_force(panel, force)
    return panels


@styled
def error_ladder(found: Loop, *, axes: Any = None) -> np.ndarray:
    """Error over the prediction horizon up to simulation, before and after, and the noise floor.

    Args:
        found: result of `lpvid.loop.close_the_loop`.
        axes: where to draw, one for each output; new ones by default.

    Returns:
        The axes, shape (ny,).

    Raises:
        ValueError: another number of axes is given.

    Example:
        >>> error_ladder(loop)  # doctest: +SKIP
    """
    ny = len(found.output_names)
    panels = grid_of_axes(ny, 1, axes, size=(LOOP_WIDTH, 0.9 + 2.3 * ny), sharex=True)[:, 0]
    count = len(found.ladder.steps)
    # As far from one another as the axis shows them.
    marked = np.unique(np.geomspace(1, max(count, 1), 14).astype(int)) - 1
    dots = {"marker": "o", "markersize": 2.8, "markevery": marked.tolist()}
    ahead = found.dt * np.asarray(found.ladder.steps, float)
    for k, panel in enumerate(panels):
        dress(panel)
        shown = []
        for name, ladder, errors, look in (
            ("before", found.ladder.before, found.before, BEFORE),
            ("after", found.ladder.after, found.after, AFTER),
        ):
            curve, last = np.asarray(ladder, float)[:, k], float(errors.free_run[k])
            panel.plot(ahead, curve, linewidth=1.2, label=name, **dots, **look)
            if np.isfinite(last):
                panel.axhline(last, color=look["color"], linestyle=":", linewidth=1.6)
            shown += [*curve, last]
        floor = float(found.noise_floor[k])
        if np.isfinite(floor) and floor > 0.0:
            panel.axhline(floor, **NOISE_FLOOR)
            shown.append(floor)
        panel.plot([], [], color=DATA_COLOUR, linestyle=":", linewidth=1.6, label="free run")
        panel.set_xscale("log")
        _fit_scale(panel, np.array(shown))
        few_decades(panel.xaxis)
        panel.set_xlabel("prediction horizon (s)" if k == ny - 1 else "")
        panel.set_ylabel(f"{found.output_names[k]}: {with_unit('error', found.output_units[k])}")
        legend_above(panel)
    return panels


@styled
def candidate_ranking(found: Loop, *, most: int = 8, axes: Any = None) -> np.ndarray:
    """The best candidates of each round by their gain less the penalty for their complexity.

    Filled: among the effects found; hatched: what the records cannot tell from one of these.

    Args:
        found: result of `lpvid.loop.close_the_loop`.
        most: how many of a round are shown.
        axes: where to draw, one for each round; new ones by default.

    Returns:
        The axes, shape (round,); empty where no round was held.

    Raises:
        ValueError: another number of axes is given.

    Example:
        >>> candidate_ranking(loop, most=5)  # doctest: +SKIP
    """
    rounds = [round_[:most] for round_ in found.rounds if round_]
    if not rounds:
        return np.empty(0, object)
    heights = [1.0 + len(round_) for round_ in rounds]
    size = (LOOP_WIDTH, 0.5 + 0.36 * sum(heights))
    panels = grid_of_axes(len(rounds), 1, axes, size=size, height_ratios=heights)[:, 0]
    named = {(effect.name, effect.port) for effect in found.effects}
    alike = {other for effect in found.effects for other in effect.confusable_with}
    for number, (panel, round_) in enumerate(zip(panels, rounds, strict=True), 1):
        dress(panel)
        panel.grid(False, axis="y")
        for place, candidate in enumerate(round_):
            _draw_candidate(panel, place, candidate, named, alike)
        panel.axvline(0.0, color=FAINT, linewidth=0.8)
        panel.margins(x=0.2)
        panel.set_yticks(range(len(round_)), [f"{one.name}\n{one.port}" for one in round_])
        panel.set_ylim(len(round_) - 0.4, -0.6)
        panel.set_title(f"round {number}", loc="left")
    panels[-1].set_xlabel("gain in log-likelihood, penalised")
    return panels


def _fit_scale(panel: Any, values: np.ndarray) -> None:
    """Logarithmic where the values differ by far, else from zero."""
    values = values[np.isfinite(values) & (values > 0.0)]
    if not values.size:
        return
    low, high = float(np.min(values)), float(np.max(values))
    if high > 5.0 * low:
        panel.set_yscale("log")
        panel.set_ylim(0.8 * low, 1.25 * high)
        few_decades(panel.yaxis)
    else:
        panel.set_ylim(0.0, 1.1 * high)


def _draw_force(panel: Any, force: VirtualForce) -> None:
    where, lacking, law = (
        np.asarray(values, float) for values in (force.regressor, force.residual, force.law)
    )
    known = np.isfinite(where) & np.isfinite(lacking) & np.isfinite(law)
    where, lacking, law = where[known], lacking[known], law[known]
    # A stride and not a draw: the same picture every time.
    stride = max(1, where.size // _CLOUD)
    panel.plot(
        where[::stride],
        lacking[::stride],
        linestyle="none",
        marker=".",
        markersize=2.5,
        alpha=0.35,
        color=FAINT,
        label="lacking",
        rasterized=True,
    )
    order = np.argsort(where, kind="stable")
    if where.size >= 2 * _BINS:
        parts = np.array_split(order, _BINS)
        panel.plot(
            [np.mean(where[part]) for part in parts],
            [np.mean(lacking[part]) for part in parts],
            linestyle="none",
            marker="o",
            markersize=4.0,
            markerfacecolor="white",
            color=DATA_COLOUR,
            label="mean",
        )
    if _is_function(law[order]):
        # Means of neighbours: a steep law of a noisy speed would be drawn up and down.
        parts = np.array_split(order, min(_LAW, order.size)) if order.size else []
        curve = [(np.mean(where[part]), np.mean(law[part])) for part in parts]
    else:
        curve = np.stack([where, law], axis=1)
    drawn = np.asarray(curve, float).reshape(-1, 2)
    panel.plot(drawn[:, 0], drawn[:, 1], color=colour(0), linewidth=1.3, label="law found")
    # Noise may reach far beyond; the law and the bulk of the cloud are what is to be seen.
    if where.size:
        ends = np.append(np.percentile(lacking, [0.5, 99.5]), [law.min(), law.max()])
        room = 0.08 * (ends.max() - ends.min())
        if room > 0.0:
            panel.set_ylim(ends.min() - room, ends.max() + room)
    panel.set_xlabel(force.regressor_name)
    panel.set_ylabel(with_unit(force.effect, force.unit))
    legend_above(panel)


def _is_function(law: np.ndarray) -> bool:
    """Whether values in the order of their regressor make one curve and no loops."""
    if law.size < 3:
        return True
    # Neighbours lie on one branch, or by turns on the two branches of a loop.
    return float(np.median(np.abs(np.diff(law)))) <= 0.05 * float(np.ptp(law))


def _draw_candidate(
    panel: Any, place: int, candidate: Candidate, named: set[tuple[str, str]], alike: set[str]
) -> None:
    chosen = (candidate.name, candidate.port) in named
    same = f"{candidate.name} at {candidate.port}" in alike
    panel.barh(
        place,
        candidate.penalised,
        height=0.66,
        color=colour(0) if chosen else "white" if same else "#D0D0D0",
        edgecolor=colour(0) if chosen or same else FAINT,
        hatch="////" if same and not chosen else None,
        linewidth=0.8,
    )
    panel.annotate(
        p_value_text(candidate.p_value),
        (max(candidate.penalised, 0.0), place),
        xytext=(4, 0),
        textcoords="offset points",
        va="center",
        fontsize=7.0,
        color=DATA_COLOUR,
    )
