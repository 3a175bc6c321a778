"""Closed loops: Bode plot with margins, Nyquist plot, response to set-points."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from lpvid.control import ClosedLoopMotion, margins
from lpvid.models import StateSpace
from lpvid.plot._figure import (
    FAINT,
    REFERENCE_COLOUR,
    Axes,
    Values,
    channel_names,
    colour,
    dashes,
    dress,
    grid_of_axes,
    labelled,
    legend,
    legend_above,
    styled,
)
from lpvid.plot._frequency import bode
from lpvid.plot._systems import HZ, continuous_poles, response_of, state_spaces


@styled
def loop_bode(
    loops: Any,
    omega: Values | None = None,
    labels: Sequence[str] | str | None = None,
    *,
    axes: Any = None,
) -> np.ndarray:
    """Bode plot of loop transfers, their gain and phase margins marked and written in the legend.

    Args:
        loops: a `StateSpace` with one input and one output (see `lpvid.control.loop_transfer`), or
            several in a sequence or a mapping from label to loop.
        omega: frequencies in rad/s; by default a decade around the poles.
        labels: one for each loop of a sequence.
        axes: where to draw, two of them; new ones by default.

    Returns:
        The axes of magnitude and phase, shape (2, 1).

    Raises:
        ValueError: a loop with several inputs or outputs, or a batch of loops; else as for `bode`.

    Example:
        >>> from lpvid.models import StateSpace
        >>> from lpvid.plot import loop_bode
        >>> servo = StateSpace([[0.0, 1.0], [0.0, -1.0]], [[0.0], [1.0]], [[1.0, 0.0]])
        >>> loop_bode(servo)[1, 0].get_ylabel()
        'phase (deg)'
    """
    models = _single_loops(loops, labels)
    panels = bode(models, omega, phase=True, axes=axes)
    size, turn = panels[0, 0], panels[1, 0]
    size.axhline(0.0, color=REFERENCE_COLOUR, linewidth=0.8)
    turn.axhline(-180.0, color=REFERENCE_COLOUR, linewidth=0.8)
    size.set_title("loop transfer", loc="left")
    for index, (label, model) in enumerate(models.items()):
        found = margins(model)
        gain, phase = float(found.gain_margin_decibels), float(found.phase_margin)
        at_gain, at_phase = float(found.phase_crossover) / HZ, float(found.gain_crossover) / HZ
        look = {"color": colour(index), "linewidth": 2.2, "solid_capstyle": "butt"}
        # The drawn phase is unwrapped: the margin stands on the branch that it is drawn on.
        line = turn.lines[index]
        line.set_ydata(_near_half_turn(line.get_xdata(), line.get_ydata(), at_phase))
        if np.isfinite(gain) and at_gain > 0.0:
            size.plot([at_gain, at_gain], [-gain, 0.0], **look)
            size.plot(at_gain, -gain, "o", color=colour(index), markersize=4)
        if np.isfinite(phase):
            turn.plot([at_phase, at_phase], [-180.0, phase - 180.0], **look)
            turn.plot(at_phase, phase - 180.0, "o", color=colour(index), markersize=4)
        words = "stable" if bool(found.stable) else "UNSTABLE"
        size.lines[index].set_label(f"{label}: GM {gain:.1f} dB, PM {phase:.1f}°, {words}")
    turn.relim()
    turn.autoscale_view()
    legend(size)
    return panels


@styled
def nyquist(
    loops: Any,
    omega: Values | None = None,
    labels: Sequence[str] | str | None = None,
    *,
    reach: float = 2.5,
    axes: Axes | None = None,
) -> Axes:
    """Nyquist plot of loop transfers near −1, with the circle that the modulus margin leaves free.

    Args:
        loops: as for `loop_bode`.
        omega: frequencies in rad/s; by default dense ones around the poles.
        labels: as for `loop_bode`.
        reach: how far the picture reaches from the origin; the curves go on beyond it.
        axes: where to draw; new ones by default.

    Returns:
        The axes.

    Raises:
        ValueError: as for `loop_bode`, or a reach that is not positive.

    Example:
        >>> from lpvid.models import StateSpace
        >>> from lpvid.plot import nyquist
        >>> servo = StateSpace([[0.0, 1.0], [0.0, -1.0]], [[0.0], [1.0]], [[1.0, 0.0]])
        >>> nyquist({"servo": servo}).get_xlabel()
        'real part'
    """
    if not reach > 0.0:
        raise ValueError(f"reach={reach} must be positive.")
    models = _single_loops(loops, labels)
    panel = grid_of_axes(1, 1, axes, size=(4.8, 4.6))[0, 0]
    dress(panel)
    turn = 2.0 * np.pi * np.linspace(0.0, 1.0, 181)
    panel.plot(np.cos(turn), np.sin(turn), color=FAINT, linewidth=0.8, linestyle=":")
    for index, (label, model) in enumerate(models.items()):
        found = margins(model)
        grid = _nyquist_grid(model, found) if omega is None else np.asarray(omega, float)
        response = response_of(model, grid)[0, :, 0, 0]
        # An integrator's branch leaves the picture; drawn to its end it would dwarf the rest.
        response = np.where(np.abs(response) < 20.0 * reach, response, np.nan)
        look = {"color": colour(index), "linestyle": dashes(index)}
        distance = float(found.modulus_margin)
        text = f"{label}: modulus margin {distance:.2f}"
        real, imaginary = np.real(response), np.imag(response)
        panel.plot(real, imaginary, linewidth=1.4, label=text, **look)
        panel.plot(real, -imaginary, linewidth=0.7, alpha=0.6, **look)
        free = distance * np.cos(turn) - 1.0, distance * np.sin(turn)
        panel.plot(*free, linewidth=0.8, color=colour(index), alpha=0.7)
    panel.plot(-1.0, 0.0, "+", color=REFERENCE_COLOUR, markersize=9, markeredgewidth=1.6)
    panel.set_aspect("equal")
    panel.set_xlim(-reach, reach)
    panel.set_ylim(-reach, reach)
    panel.set_xlabel("real part")
    panel.set_ylabel("imaginary part")
    legend_above(panel)
    return panel


@styled
def closed_loop_response(
    motions: Any,
    labels: Sequence[str] | str | None = None,
    *,
    output_names: Sequence[str] | None = None,
    axes: Any = None,
) -> np.ndarray:
    """Outputs and commands of closed loops over time, the set-point beside the first output.

    Args:
        motions: a `ClosedLoopMotion`, or several in a sequence or a mapping from label to motion.
        labels: one for each motion of a sequence.
        output_names: one for each output; y1, y2, ... by default.
        axes: where to draw, as many as returned; new ones by default.

    Returns:
        The axes, shape (ny + nu, 1).

    Raises:
        ValueError: something else than motions, a batch of them, or different numbers of channels.

    Example:
        >>> import jax.numpy as jnp
        >>> from lpvid.control import simulate_closed_loop
        >>> from lpvid.mechanics import OpenLoop
        >>> from lpvid.models import StateSpace
        >>> from lpvid.plot import closed_loop_response
        >>> lag = StateSpace([[0.5]], [[1.0]], [[1.0]], dt=0.1)
        >>> motion = simulate_closed_loop(lag, OpenLoop(), reference=jnp.ones(9))
        >>> closed_loop_response(motion).shape
        (2, 1)
    """
    found = labelled(motions, labels, "motions", "closed loop")
    for label, motion in found.items():
        if not isinstance(motion, ClosedLoopMotion) or motion.y.ndim != 2:
            raise ValueError(
                f"motions: {label!r} is no single ClosedLoopMotion; of a batch take one by "
                "jax.tree.map(lambda leaf: leaf[0], motion)."
            )
    sizes = {(motion.y.shape[1], motion.u.shape[1]) for motion in found.values()}
    if len(sizes) > 1:
        raise ValueError(f"motions: numbers of outputs and commands differ, {sorted(sizes)}.")
    ny, nu = sizes.pop()
    names = channel_names(output_names, ny, "y", "output_names")
    names += ["u"] if nu == 1 else channel_names(None, nu, "u", "inputs")
    panels = grid_of_axes(ny + nu, 1, axes, size=(6.0, 0.8 + 1.3 * (ny + nu)), sharex=True)
    first = next(iter(found.values()))
    panels[0, 0].plot(
        np.asarray(first.time),
        np.asarray(first.reference)[:, 0],
        color=REFERENCE_COLOUR,
        linewidth=0.9,
        linestyle=dashes(2),
        label="set-point",
    )
    for index, (label, motion) in enumerate(found.items()):
        signals = np.concatenate([np.asarray(motion.y), np.asarray(motion.u)], axis=1)
        look = {"color": colour(index), "linestyle": dashes(index), "linewidth": 1.1}
        for panel, signal in zip(panels[:, 0], signals.T, strict=True):
            panel.plot(np.asarray(motion.time), signal, label=label, **look)
    for panel, name in zip(panels[:, 0], names, strict=True):
        dress(panel)
        panel.set_ylabel(name)
        panel.margins(x=0.01)
    legend_above(panels[0, 0])
    panels[-1, 0].set_xlabel("time (s)")
    return panels


def _single_loops(loops: Any, labels: Sequence[str] | str | None) -> dict[str, StateSpace]:
    models = state_spaces(loops, labels)
    for label, model in models.items():
        if model.batch_shape or (model.nu, model.ny) != (1, 1):
            raise ValueError(
                f"loops: {label!r} is no single loop of one input and one output; take "
                "loop_transfer, and the members of a batch one by one."
            )
    return models


def _near_half_turn(hertz: Any, phase: Any, at: float) -> np.ndarray:
    """The phase moved by whole turns, so that at the gain crossover it lies within ±180° of −180°.

    Without one, at the lowest frequency.
    """
    hertz, phase = np.asarray(hertz, float), np.asarray(phase, float)
    here = np.interp(at, hertz, phase) if np.isfinite(at) else phase[0]
    if not np.isfinite(here):
        return phase
    return phase - 360.0 * np.round((here + 180.0) / 360.0)


def _nyquist_grid(model: StateSpace, found: Any) -> np.ndarray:
    """Frequencies of a curve without corners: even in the logarithm, dense where L turns fast."""
    known = [found.gain_crossover, found.phase_crossover, found.modulus_frequency]
    poles = continuous_poles(model)
    sizes = np.abs(poles)
    sizes = np.append(sizes[np.isfinite(sizes)], [float(w) for w in known])
    sizes = sizes[np.isfinite(sizes) & (sizes > 1e-6 * np.max(sizes, initial=0.0))]
    low, high = (sizes.min() / 30.0, sizes.max() * 30.0) if sizes.size else (1e-2, 1e2)
    high = min(high, np.pi / model.dt) if model.is_discrete else high
    upper = poles[(np.imag(poles) > 0.0) & np.isfinite(poles)]
    around = np.sinh(np.linspace(-4.0, 4.0, 121))
    width = np.maximum(np.abs(np.real(upper)), 1e-6 * np.imag(upper))
    close = (np.imag(upper)[:, None] + width[:, None] * around[None]).ravel()
    grid = np.union1d(np.geomspace(low, high, 1200), close)
    return grid[(grid >= low) & (grid <= high)]
