"""Sensitivities of the innovations to candidates: injected along the trace, in one batch."""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.effects import PeriodicDisturbance, Scales
from lpvid.loop._candidates import Place, Trial, port_signals, regressors, scales_at, signals_at
from lpvid.loop._discretise import Sampled, sampled_at
from lpvid.loop._program import Injection, Records, Setting, Slots, Unknowns, node_matrices
from lpvid.loop._search import COLUMNS, injected, run

_BETWEEN = 4
"""Frequencies that count as tested for each spectral line of a record."""

Signal = tuple[np.ndarray, np.ndarray]
"""What is added to the state (time, state) and to the output (time, ny)."""


class Along(NamedTuple):
    """A trace, and what candidates read along it.

    Attributes:
        setting: structure, laws, sample time.
        records: signals.
        slots: which effects are in.
        unknowns: their numbers and the model's.
        gain: L at the nodes of κ.
        matrices: at the nodes.
        weights: of the nodes (time, node).
        signals: at all ports.
        drive: Γ at the nodes, as NumPy array.
        ramp: Γ̇ at the nodes, as NumPy array.
        states: with the sample seen, and before it (time, state).
        forces: inputs with what effects add to them, then forces at the coordinates (time, drive).
        errors: innovations, padding left out (time, ny).
    """

    setting: Setting
    records: Records
    slots: Slots
    unknowns: Unknowns
    gain: Array
    matrices: Sampled
    weights: Array
    signals: dict[str, dict[str, np.ndarray]]
    drive: np.ndarray
    ramp: np.ndarray
    states: tuple[Array, Array]
    forces: Array
    errors: np.ndarray


@eqx.filter_jit
def _nodes(setting, slots, unknowns, records):
    return node_matrices(setting, slots, unknowns, records, jnp.asarray(setting.dt))


def along(setting: Setting, records: Records, slots: Slots, unknowns: Unknowns, gain) -> Along:
    """Run the predictor and prepare what candidates read.

    Args:
        setting: structure, laws, sample time.
        records: signals.
        slots: which effects are in.
        unknowns: their numbers and the model's.
        gain: L at the nodes of κ.
    """
    trace = run(setting, records, slots, unknowns, gain)
    # The laws do not matter here, and would make a program for each set of them.
    matrices, weights = _nodes(setting, dataclasses.replace(slots, laws=()), unknowns, records)
    signals = port_signals(matrices, weights, records, trace)
    nu = records.u.shape[1]
    return Along(
        setting,
        records,
        slots,
        unknowns,
        gain,
        matrices,
        weights,
        signals,
        np.asarray(matrices.drive),
        np.asarray(matrices.ramp),
        (trace.state, trace.before),
        trace.forces.at[:, :nu].add(records.u),
        np.asarray(trace.innovations)[: int(np.sum(np.asarray(records.counts)))],
    )


def _over_nodes(weights: np.ndarray, leaf: np.ndarray, signal: np.ndarray) -> np.ndarray:
    if leaf.shape[0] == 1:
        return signal @ leaf[0].T
    return np.einsum("tj,jpc,tc->tp", weights, leaf, signal, optimize=True)


@eqx.filter_jit
def _parameter_matrices(setting: Setting, theta: Float[Array, " parameter"], nodes: Array):
    """Derivatives of the matrices at the nodes by each parameter, times the parameter."""

    def at(values):
        thetas = jnp.broadcast_to(values, (nodes.shape[0], values.shape[0]))
        return sampled_at(setting.structure, thetas, nodes, jnp.asarray(setting.dt))

    return jax.vmap(lambda direction: jax.jvp(at, (theta,), (direction,))[1])(jnp.diag(theta))


def _varied(trace: Along, place: Place, varying: Sampled) -> Signal:
    """What a parameter that follows a schedule adds to state and output, at first order."""
    records = trace.records
    own = jax.tree.map(lambda leaf: np.asarray(leaf[place.where]), varying)
    follow = np.asarray(records.schedules[:, place.schedule])[:, None]
    weights = np.asarray(records.weights)
    seen, before = (np.asarray(states) for states in trace.states)
    moved = _over_nodes(weights, own.transition, seen)
    moved = moved + _over_nodes(weights, own.drive, np.asarray(trace.forces))
    change = np.asarray(records.change)
    moved = moved + _over_nodes(weights, own.ramp[:, :, : change.shape[1]], change)
    said = _over_nodes(weights, own.C, before)
    said = said + _over_nodes(weights, own.D, np.asarray(records.u))
    return moved * follow, said * follow


def _driven(trace: Along, columns: Sequence[int], level, change, sensed) -> list[Signal]:
    """Injections of signals (time, amplitude) into columns of the drive."""
    weights = np.asarray(trace.weights)
    nu = trace.records.u.shape[1]
    found = []
    for number in range(level.shape[1]):
        for column in columns:
            pick = slice(column, column + 1)
            state = _over_nodes(weights, trace.drive[:, :, pick], level[:, number, None])
            state = state + _over_nodes(weights, trace.ramp[:, :, pick], change[:, number, None])
            output = np.zeros(trace.records.y.shape)
            if column < nu:
                through = np.asarray(trace.matrices.D)[:, :, pick]
                output = _over_nodes(weights, through, sensed[:, number, None])
            found.append((state, output))
    return found


def _sensed(trace: Along, output: int, sensed: np.ndarray) -> list[Signal]:
    """Injections of signals (time, amplitude) into an output."""
    found = []
    for number in range(sensed.shape[1]):
        signal = np.zeros(trace.records.y.shape)
        signal[:, output] = sensed[:, number]
        found.append((np.zeros_like(np.asarray(trace.states[0])), signal))
    return found


def _injections(
    trace: Along, place: Place, shapes: np.ndarray, varying: Sampled
) -> list[list[Signal]]:
    """For each shape, one injection for each amplitude and direction."""
    if place.port == "parameter":
        return [[_varied(trace, place, varying)]]
    along_record = regressors(trace.setting, place, shapes, trace.signals, trace.records)
    if place.modulated:
        follow = np.asarray(trace.records.schedules)[None, :, place.schedule, None]
        along_record = tuple(part * follow for part in along_record)
    every = zip(*along_record, strict=True)
    if place.port == "output":
        return [_sensed(trace, place.where, sensed) for _, _, sensed in every]
    nu, directions = trace.records.u.shape[1], trace.unknowns.amplitude.shape[2]
    columns = [place.where]
    if place.port == "force":
        columns = [nu + place.where * directions + number for number in range(directions)]
    return [_driven(trace, columns, *one) for one in every]


def _sensitivities(trace: Along, every: list[Signal]) -> np.ndarray:
    """Derivatives of the innovations by injections (time, ny, column), padding left out."""
    batch, wanted = COLUMNS, len(every)
    every = every + [every[-1]] * (-wanted % batch)
    parts = []
    for begin in range(0, len(every), batch):
        states, outputs = zip(*every[begin : begin + batch], strict=True)
        stacked = Injection(jnp.asarray(np.stack(states)), jnp.asarray(np.stack(outputs)))
        parts.append(
            injected(trace.setting, trace.records, trace.slots, trace.unknowns, trace.gain, stacked)
        )
    count = int(np.sum(np.asarray(trace.records.counts)))
    columns = np.concatenate([np.asarray(part) for part in parts])
    return np.moveaxis(columns, 0, 2)[:count, :, :wanted]


def trial_columns(trace: Along, places: Sequence[Place]) -> Iterator[tuple[Trial, np.ndarray]]:
    """Each place with each shape of its law's grid, and the innovations' derivatives.

    Args:
        trace: of the model as it stands.
        places: where and which law.

    Yields:
        Trials with derivatives by their amplitudes (time, ny, column).
    """
    varying = _parameter_matrices(trace.setting, trace.unknowns.theta, trace.records.kappa_nodes)
    waiting: list[tuple[Trial, list[Signal]]] = []

    def flush():
        columns = _sensitivities(trace, [one for _, group in waiting for one in group])
        place = 0
        for trial, group in waiting:
            yield trial, columns[:, :, place : place + len(group)]
            place += len(group)

    held = 0
    for place in places:
        shapes = grid_of(trace, place)
        groups = _injections(trace, place, shapes, varying)
        for shape, group in zip(shapes, groups, strict=True):
            if held and held + len(group) > COLUMNS:
                yield from flush()
                waiting, held = [], 0
            waiting.append((Trial(place, shape), group))
            held += len(group)
    if waiting:
        yield from flush()


def force_columns(
    trace: Along, coordinate: int, level: np.ndarray, change: np.ndarray
) -> np.ndarray:
    """Derivatives of the innovations by amplitudes of given forces (time, ny, column).

    Args:
        trace: of the model as it stands.
        coordinate: that the forces act on.
        level: forces at the steps' starts (time, column).
        change: over the steps (time, column).
    """
    nu, directions = trace.records.u.shape[1], trace.unknowns.amplitude.shape[2]
    columns = [nu + coordinate * directions + number for number in range(directions)]
    return _sensitivities(trace, _driven(trace, columns, level, change, level))


def scales_of(trace: Along, place: Place) -> Scales:
    """Sizes of what the law at a place reads.

    Args:
        trace: whose signals set the scales.
        place: where and which law.
    """
    # What only pads the record to its length says nothing of sizes.
    count = int(np.sum(np.asarray(trace.records.counts)))
    own, before = (
        jax.tree.map(
            lambda leaf: leaf[:count],
            signals_at(trace.signals[name], trace.records, place, trace.setting.dt),
        )
        for name in ("start", "before")
    )
    return scales_at(own, before, trace.setting.dt)


def grid_of(trace: Along, place: Place) -> np.ndarray:
    """Shapes to try at a place (candidate, shape).

    Args:
        trace: whose signals set the scales.
        place: where and which law.
    """
    law, scales = trace.setting.laws[place.law], scales_of(trace, place)
    if isinstance(law, PeriodicDisturbance):
        return law.loudest(trace.errors, scales)
    return np.asarray(law.grid(scales)) if law.shapes else np.zeros((1, 0))


def tests_at(trace: Along, place: Place, tried: int) -> int:
    """How many hypotheses a place stands for.

    Args:
        trace: whose signals set the scales.
        place: where and which law.
        tried: shapes tried there.
    """
    law = trace.setting.laws[place.law]
    if isinstance(law, PeriodicDisturbance):
        # Picked from the residual's own spectrum: every line was looked at, and between them.
        return _BETWEEN * law.lines(scales_of(trace, place)).size
    return tried
