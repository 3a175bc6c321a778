"""Scheduled control: gains over κ, what fixed and scheduled loops keep in hand, and motions."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from lpvid.control import ClosedLoopMotion, ScheduleCheck, ScheduleDesign
from lpvid.control import gains_of as gains_of_controller
from lpvid.plot._figure import (
    FAINT,
    channel_names,
    colour,
    dashes,
    dress,
    grid_of_axes,
    labelled,
    legend_above,
    styled,
)

_GRID = 200


@styled
def scheduled_gains(
    design: ScheduleDesign,
    *,
    names: Sequence[str] | None = None,
    scheduling: str = "κ",
    axes: Any = None,
) -> np.ndarray:
    """Gains over one scheduling variable: dots where they were designed, a line in between.

    Args:
        design: result of `lpvid.control.schedule_design` with one scheduling variable.
        names: of the gains, in the order of `design.gains`; by default g1, g2, … Gains that are
            the same at all points are left out.
        scheduling: name of the scheduling variable.
        axes: where to draw, one for each gain that varies; new ones by default.

    Returns:
        The axes, shape (gains that vary,).

    Raises:
        ValueError: several scheduling variables, no gain that varies, names or axes of another
            number.

    Example:
        >>> from lpvid.control import PDP, schedule_design
        >>> from lpvid.models import StateSpace
        >>> from lpvid.plot import scheduled_gains
        >>> def plant(kappa):
        ...     return StateSpace(0.9 * kappa[:, None], [[1.0]], [[1.0], [0], [0], [0]], dt=0.1)
        >>> def design(model):
        ...     return PDP(model.A[0, 0], 0.0, 0.0)
        >>> found = schedule_design(plant, design, [0.5, 1.0], between=1)
        >>> scheduled_gains(found, names=["K_P", "K_d", "K_sg"]).shape
        (1,)
    """
    points, gains = np.asarray(design.kappas), np.asarray(design.gains)
    if points.shape[1] != 1:
        raise ValueError(
            f"design has {points.shape[1]} scheduling variables: gains are drawn over one."
        )
    names = channel_names(names, gains.shape[1], "g", "names")
    varying = np.flatnonzero(np.ptp(gains, axis=0) > 0.0)
    if not varying.size:
        raise ValueError("design: no gain varies with κ; there is nothing to draw.")
    kappa = np.linspace(points.min(), points.max(), _GRID)
    lines = jax.vmap(lambda k: gains_of_controller(design.controller.at(k)))(jnp.asarray(kappa))
    columns = 2 if varying.size > 3 and varying.size % 2 == 0 else 1
    rows = varying.size // columns
    size = (4.0 * columns + 1.0, 0.8 + 1.5 * rows)
    panels = grid_of_axes(rows, columns, axes, size=size, sharex=True)
    for panel, gain in zip(panels.ravel(), varying, strict=True):
        dress(panel)
        panel.plot(kappa, np.asarray(lines)[:, gain], color=colour(0))
        panel.plot(points[:, 0], gains[:, gain], "o", color=colour(0), markersize=5)
        panel.set_ylabel(names[gain])
    for panel in panels[-1]:
        panel.set_xlabel(scheduling)
    return panels.ravel()


@styled
def schedule_margins(
    checks: Any,
    *,
    labels: Sequence[str] | str | None = None,
    scheduling: str = "κ",
    along: ArrayLike | None = None,
    axes: Any = None,
) -> np.ndarray:
    """Disc margin and slowest decay of frozen loops over the scheduling variable.

    Args:
        checks: one `lpvid.control.ScheduleCheck`, several, or a mapping from label to check.
        labels: of several ones.
        scheduling: name of what is drawn to the right.
        along: values to draw to the right instead of κ, such as θ2 (grid,).
        axes: where to draw, two; new ones by default.

    Returns:
        The axes, shape (2,): disc margin, decay rate.

    Raises:
        ValueError: several scheduling variables without `along`, or labels that do not fit.

    Example:
        >>> from lpvid.control import PDP, check_schedule
        >>> from lpvid.models import StateSpace
        >>> from lpvid.plot import schedule_margins
        >>> def plant(kappa):
        ...     return StateSpace(kappa[:, None], [[1.0]], [[1.0], [0.0], [0.0], [0.0]], dt=0.1)
        >>> check = check_schedule(plant, PDP(0.5, 0.0, 0.0), [0.5, 0.75, 1.0])
        >>> schedule_margins(check).shape
        (2,)
    """
    found: dict[str, ScheduleCheck] = labelled(checks, labels, "checks", "loop")
    panels = grid_of_axes(2, 1, axes, size=(6.2, 4.8), sharex=True)[:, 0]
    for k, (label, check) in enumerate(found.items()):
        kappas = np.asarray(check.kappas)
        if along is None and kappas.shape[1] != 1:
            raise ValueError("along: with several scheduling variables, give what to draw over.")
        right = kappas[:, 0] if along is None else np.asarray(along, float)
        look = {"color": colour(k), "linestyle": dashes(k), "label": label}
        for panel, values in zip(panels, (check.disc_margin, check.decay), strict=True):
            panel.plot(right, np.asarray(values), **look)
            worst = int(np.argmin(values))
            panel.plot(right[worst], float(values[worst]), "v", color=colour(k), markersize=6)
    for panel, name in zip(panels, ("disc margin", "slowest decay (1/s)"), strict=True):
        dress(panel)
        panel.set_ylabel(name)
    if len(found) > 1:
        legend_above(panels[0])
    panels[-1].set_xlabel(scheduling)
    return panels


@styled
def closed_loop_motions(
    motions: Any,
    *,
    labels: Sequence[str] | str | None = None,
    outputs: Sequence[int] = (0,),
    names: Sequence[str] | None = None,
    axes: Any = None,
) -> np.ndarray:
    """Outputs with their set-points, and the commands, of one or several closed loops.

    Args:
        motions: one `lpvid.control.ClosedLoopMotion`, several, or a mapping from label to motion.
        labels: of several ones.
        outputs: which outputs; output i follows set-point i.
        names: of those outputs and then of all commands.
        axes: where to draw, one for each output and command; new ones by default.

    Returns:
        The axes, shape (outputs + commands,).

    Raises:
        ValueError: a motion with batch axes, an output without a set-point, names that do not fit.

    Example:
        >>> import numpy as np
        >>> from lpvid.control import ProportionalIntegral, simulate_closed_loop
        >>> from lpvid.models import StateSpace
        >>> from lpvid.plot import closed_loop_motions
        >>> lag = StateSpace([[0.5]], [[1.0]], [[1.0]], dt=0.1)
        >>> pi = ProportionalIntegral(0.2, 1.0, dt=0.1)
        >>> closed_loop_motions(simulate_closed_loop(lag, pi, reference=np.ones(20))).shape
        (2,)
    """
    found: dict[str, ClosedLoopMotion] = labelled(motions, labels, "motions", "loop")
    first = next(iter(found.values()))
    outputs = tuple(int(i) for i in outputs)
    if any(one.y.ndim != 2 for one in found.values()):
        raise ValueError("motions: draw one motion at a time, without batch axes.")
    channels = min(min(one.reference.shape[1], one.y.shape[1]) for one in found.values())
    if not all(0 <= i < channels for i in outputs):
        raise ValueError(f"outputs={outputs}: give outputs that have a set-point, from 0 on.")
    nu = first.u.shape[1]
    count = len(outputs) + nu
    if names is None:
        names = [f"y{i + 1}" for i in outputs] + [f"u{i + 1}" for i in range(nu)]
    names = channel_names(names, count, "", "names")
    panels = grid_of_axes(count, 1, axes, size=(7.0, 0.8 + 1.7 * count), sharex=True)[:, 0]
    for panel, i in zip(panels, outputs, strict=False):
        look = {"color": FAINT, "linewidth": 1.6, "label": "set-point", "drawstyle": "steps-post"}
        panel.plot(np.asarray(first.time), np.asarray(first.reference)[:, i], **look)
    for k, (label, motion) in enumerate(found.items()):
        look = {"color": colour(k), "linestyle": dashes(k), "label": label, "linewidth": 1.3}
        time, y, u = (np.asarray(part) for part in (motion.time, motion.y, motion.u))
        for panel, i in zip(panels, outputs, strict=False):
            panel.plot(time, y[:, i], **look)
        for panel, command in zip(panels[len(outputs) :], u.T, strict=True):
            panel.plot(time, command, drawstyle="steps-post", **look)
    for panel, name in zip(panels, names, strict=True):
        dress(panel)
        panel.set_ylabel(name)
    legend_above(panels[0])
    panels[-1].set_xlabel("time (s)")
    return panels
