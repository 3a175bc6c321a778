"""All that closing the loop found, on one page."""

from typing import Any

import numpy as np

from lpvid.loop import Loop
from lpvid.plot._figure import Figure, styled
from lpvid.plot._loop_findings import candidate_ranking, error_ladder, virtual_forces
from lpvid.plot._loop_signals import loop_residuals, loop_responses, loop_spectra

# Candidates of a round.
_MOST = 6


@styled
def loop(found: Loop, *, span: tuple[float, float] | None = None) -> Figure:
    """One page: responses, residuals, spectra on the left; forces, errors, ranking on the right.

    Args:
        found: result of `lpvid.loop.close_the_loop`.
        span: first and last time of the responses to show, s; all by default.

    Returns:
        The figure; `lpvid.plot.save_figure` writes it.

    Raises:
        ValueError: nothing lies in `span`.

    Example:
        >>> save_figure(plot.loop(found), "loop.png")  # doctest: +SKIP
    """
    import matplotlib.pyplot as plt

    ny = len(found.output_names)
    forces, rounds = len(found.virtual_forces), [len(r[:_MOST]) for r in found.rounds if r]
    left = [2.0, 1.0] * ny + [1.5] * ny + [1.8] * ny
    right = [2.4] * forces + [2.0] * ny
    ranking = 0.5 + sum(0.4 + 0.36 * count for count in rounds) if rounds else 0.0
    height = max(sum(left), sum(right) + ranking)
    figure = plt.figure(figsize=(10.5, 0.8 + height), layout="constrained")
    figure.suptitle(f"{found.structure}: {found.verdict}", fontweight="bold", fontsize=11)
    halves: Any = figure.subfigures(1, 2)
    axes = _column(halves[0], left, height)
    loop_responses(found, span=span, axes=axes[: 2 * ny])
    loop_residuals(found, axes=axes[2 * ny : 3 * ny])
    loop_spectra(found, axes=axes[3 * ny :])
    # The ranking's long names are to take no width from the others.
    rest = height - sum(right) - ranking
    parts: Any = halves[1].subfigures(3, 1, height_ratios=[sum(right), ranking + 0.01, rest + 0.01])
    axes = _column(parts[0], right, sum(right))
    virtual_forces(found, axes=axes[:forces])
    error_ladder(found, axes=axes[forces:])
    if rounds:
        axes = _column(parts[1], [0.4 + 0.36 * count for count in rounds], 0.0)
        candidate_ranking(found, most=_MOST, axes=axes)
    return figure


def _column(figure: Any, heights: list[float], height: float) -> np.ndarray:
    """Axes one below the other; what is left of the height stays empty."""
    rest = height - sum(heights)
    if rest > 0.3:
        *axes, spare = _column(figure, [*heights, rest], height)
        spare.set_axis_off()
        return np.array(axes, object)
    return figure.subplots(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0]
