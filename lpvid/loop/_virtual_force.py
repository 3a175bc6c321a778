"""What an effect adds against what it depends on, and what the model lacks without it."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from lpvid.loop._bench import Bench
from lpvid.loop._candidates import Place, regressors, signals_at
from lpvid.loop._columns import Along, along
from lpvid.loop._gain import gains
from lpvid.loop._result import VirtualForce
from lpvid.loop._search import run
from lpvid.loop._tune import Fitted, with_starts

_FAST = 100.0
"""Diffusion, relative to the fitted one, of the observer that the missing force is read from."""

_READS = {
    "friction": "velocity",
    "drag": "velocity",
    "hysteresis": "position",
    "stiffness": "position",
    "backlash": "position",
    "gravity": "position",
    "ripple": "position",
    "inertia": "acceleration",
    "mode": "acceleration",
    "disturbance": "time",
    "bias": "time",
    "drift": "time",
}


def virtual_forces(bench: Bench, fitted: Fitted) -> tuple[VirtualForce, ...]:
    """For each effect on a force, an input or an output: its law and what is lacking without it.

    Args:
        bench: what the call works with.
        fitted: the model with its effects.
    """
    return tuple(
        _one(bench, fitted, slot, place)
        for slot, place in enumerate(fitted.places)
        if place.port != "parameter"
    )


def _one(bench: Bench, fitted: Fitted, slot: int, place: Place) -> VirtualForce:
    records, structure = bench.held_out, bench.setting.structure
    count = int(np.sum(np.asarray(records.counts)))
    full = eqx.tree_at(lambda model: model.unknowns, fitted, with_starts(fitted, records))
    own = along(full.setting, records, full.slots, full.unknowns, full.gain)
    law = _contribution(own, full, slot, place)
    amplitude = full.unknowns.amplitude.at[slot].set(0.0)
    lacking = eqx.tree_at(lambda tree: tree.amplitude, full.unknowns, amplitude)
    gain = full.gain
    if place.port != "output":
        ratio = max(fitted.ratio, 1e-2) * _FAST
        gain = gains(
            full.setting, records, lacking.theta, jnp.asarray(fitted.noise), jnp.asarray(ratio)
        )
    trace = run(full.setting, records, full.slots, lacking, gain)
    errors = np.asarray(trace.innovations)
    if place.port == "output":
        residual = errors[:, place.where]
    else:
        # The force that would have moved the state as the measurements say it moved.
        moved = np.asarray(trace.state - trace.before)
        column = _column(own, place)
        weight = 1.0 / np.maximum(np.var(moved, axis=0), 1e-300)
        residual = moved @ (weight * column) / max(float(column @ (weight * column)), 1e-300)
    family = bench.setting.laws[place.law].family
    reads = {"input": "input", "output": "output"}.get(place.port, _READS.get(family, "velocity"))
    signals = signals_at(own.signals["before"], records, place, full.setting.dt)
    regressor = np.asarray(getattr(signals, reads))
    unit, named = _named(structure, place, reads)
    return VirtualForce(
        effect=bench.setting.laws[place.law].name,
        regressor_name=named,
        regressor=regressor[:count],
        residual=residual[:count],
        law=law[:count],
        unit=unit,
    )


def _contribution(own: Along, fitted: Fitted, slot: int, place: Place) -> np.ndarray:
    """What the effect adds at its port (time,), along the model's first direction."""
    law = fitted.setting.laws[place.law]
    shape = np.asarray(fitted.unknowns.shape[slot])[None, : len(law.shapes)]
    # At the samples, not the mean over the steps, in which a velocity may turn.
    _, _, sensed = regressors(fitted.setting, place, shape, own.signals, own.records)
    values = sensed[0]
    if place.modulated:
        values = values * np.asarray(own.records.schedules)[:, place.schedule, None]
    return values @ np.asarray(fitted.unknowns.amplitude[slot, : values.shape[1], 0])


def _column(own: Along, place: Place) -> np.ndarray:
    nu, directions = own.records.u.shape[1], own.unknowns.amplitude.shape[2]
    column = place.where if place.port == "input" else nu + place.where * directions
    return np.mean(own.drive[:, :, column], axis=0)


def _named(structure, place: Place, reads: str) -> tuple[str, str]:
    """Unit of what is added, and what it is drawn against, with its unit."""
    index = place.where
    if place.port == "input":
        unit, what = structure.input_units[index], f"input {structure.input_names[index]}"
        own = unit
    elif place.port == "output":
        unit, what = structure.output_units[index], f"ideal {structure.output_names[index]}"
        own = unit
    else:
        unit, position = structure.force_units[index], structure.coordinate_units[index]
        what = f"{reads} at {structure.coordinate_names[index]}"
        own = {"velocity": f"{position}/s", "acceleration": f"{position}/s²"}.get(reads, position)
    return (unit, "time (s)") if reads == "time" else (unit, f"{what} ({own})")
