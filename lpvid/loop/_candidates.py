"""Candidates of a round: every law at every port it suits, on its grid of shapes."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from lpvid.effects import HISTORY, MEMORY, AbstractLaw, Scales, Signals, Size
from lpvid.loop._discretise import Sampled
from lpvid.loop._path import moments, path_of, path_rule
from lpvid.loop._ported import AbstractPortedStructure
from lpvid.loop._program import (
    SHAPES,
    SLOTS,
    Records,
    Setting,
    Slots,
    Trace,
)

_ANGLES = ("", "rad")
"""Units of a coordinate that can be an angle."""

_SPOTS = 7
"""Where a law is read on its way over a sample."""

_AT_ONCE = 6
"""Shapes of one law worked out at once."""


class Place(NamedTuple):
    """One effect's seat: its law, the kind of port and which one, and what its strength follows.

    Attributes:
        law: index into the library.
        port: "input", "force", "output" or "parameter".
        where: of the input, coordinate, output or parameter.
        schedule: index of the schedule that a parameter, or a modulated effect, follows.
        modulated: whether an effect on a signal is multiplied by the schedule: beside the same
            effect of constant strength, one whose strength is a straight line over κ.
    """

    law: int
    port: str
    where: int
    schedule: int = 0
    modulated: bool = False


class Trial(NamedTuple):
    """A place with a shape.

    Attributes:
        place: where and which law.
        shape: (shape,).
    """

    place: Place
    shape: np.ndarray


def port_name(structure: AbstractPortedStructure, place: Place, schedules: Sequence[str]) -> str:
    """In the report's words, such as "force at load".

    Args:
        structure: whose ports they are.
        place: the effect's seat.
        schedules: names of the schedules.
    """
    over = f" over {schedules[place.schedule]}" if place.modulated else ""
    if place.port == "input":
        return f"input {structure.input_names[place.where]}{over}"
    if place.port == "force":
        return f"force at {structure.coordinate_names[place.where]}{over}"
    if place.port == "output":
        return f"output {structure.output_names[place.where]}{over}"
    return f"{structure.parameter_names[place.where]} over {schedules[place.schedule]}"


def places_of(
    structure: AbstractPortedStructure, laws: Sequence[AbstractLaw], schedules: Sequence[str]
) -> list[Place]:
    """Every law at every port it suits.

    Args:
        structure: the model's.
        laws: the library.
        schedules: names of what a parameter may follow.
    """
    counts = {
        "input": len(structure.input_names),
        "force": len(structure.coordinate_names),
        "output": len(structure.output_names),
    }
    found = []
    for number, law in enumerate(laws):
        for port in law.ports:
            if port != "parameter":
                found += [
                    Place(number, port, index)
                    for index in range(counts[port])
                    if not (law.angular and structure.coordinate_units[index] not in _ANGLES)
                ]
                continue
            follows = [
                place
                for place, name in enumerate(schedules)
                if (name == "time") == (law.family == "drift")
            ]
            found += [
                Place(number, port, index, schedule)
                for index in range(len(structure.parameter_names))
                for schedule in follows
            ]
    return found


def modulated_places(
    laws: Sequence[AbstractLaw], taken: Sequence[Place], schedules: Sequence[str]
) -> list[Place]:
    """The effects of a model once more, their strength following what was measured.

    Args:
        laws: the library.
        taken: seats of the model's effects.
        schedules: names of what may be followed.
    """
    measured = [index for index, name in enumerate(schedules) if name != "time"]
    return [
        place._replace(schedule=schedule, modulated=True)
        for place in taken
        if place.port != "parameter" and not laws[place.law].whole
        for schedule in measured
    ]


def slots_of(structure: AbstractPortedStructure, places: Sequence[Place], schedules: int) -> Slots:
    """Arrays that say which effect sits where.

    Args:
        structure: the model's.
        places: at most `SLOTS`.
        schedules: number of schedules.
    """
    arrays = {
        "input": np.zeros((SLOTS, len(structure.input_names))),
        "force": np.zeros((SLOTS, len(structure.coordinate_names))),
        "output": np.zeros((SLOTS, len(structure.output_names))),
        "parameter": np.zeros((SLOTS, len(structure.parameter_names))),
    }
    follow, modulated = np.zeros((SLOTS, schedules)), np.zeros(SLOTS)
    for slot, place in enumerate(places):
        arrays[place.port][slot, place.where] = 1.0
        modulated[slot] = float(place.modulated)
        if place.port == "parameter" or place.modulated:
            follow[slot, place.schedule] = 1.0
    return Slots(
        laws=tuple(place.law for place in places),
        input=jnp.asarray(arrays["input"]),
        force=jnp.asarray(arrays["force"]),
        output=jnp.asarray(arrays["output"]),
        parameter=jnp.asarray(arrays["parameter"]),
        schedule=jnp.asarray(follow),
        modulated=jnp.asarray(modulated),
    )


@eqx.filter_jit
def _signals(matrices: Sampled, weights: Array, u: Array, states: Array):
    """Everything at every port along the record: coordinates', then outputs'."""

    def apply(leaf, signal):
        if leaf.shape[0] == 1:
            return signal @ leaf[0].T
        return jnp.einsum("tj,jps,ts->tp", weights, leaf, signal)

    return {
        "position": apply(matrices.position, states),
        "velocity": apply(matrices.velocity, states),
        "acceleration": apply(matrices.acceleration_state, states)
        + apply(matrices.acceleration_input, u),
        "load": apply(matrices.load_state, states) + apply(matrices.load_input, u),
        "output": apply(matrices.C, states) + apply(matrices.D, u),
    }


def port_signals(
    matrices: Sampled, weights: Array, records: Records, trace: Trace
) -> dict[str, dict[str, np.ndarray]]:
    """What laws can read along a trace: before a sample is seen, then, and at its end.

    Args:
        matrices: at the nodes.
        weights: of the nodes (time, node).
        records: inputs and times.
        trace: of the predictor.
    """
    moved = records.u + records.change
    ends = {
        "before": (records.u, trace.before),
        "start": (records.u, trace.state),
        "end": (moved, trace.end),
    }
    return {
        name: {
            "input": np.asarray(u),
            **{
                key: np.asarray(value)
                for key, value in _signals(matrices, weights, u, states).items()
            },
        }
        for name, (u, states) in ends.items()
    }


def signals_at(
    signals: dict[str, np.ndarray], records: Records, place: Place, dt: float
) -> Signals:
    """The signals that one port's law reads, over time, as NumPy arrays.

    Args:
        signals: of all ports.
        records: inputs and times.
        place: the effect's seat.
        dt: sample time, s.
    """
    count = records.u.shape[0]
    nothing = np.zeros(count)

    def pick(name, port):
        return signals[name][:, place.where] if place.port == port else nothing

    at_input = place.port == "input"
    history = np.asarray(records.history)
    leaves = {
        "position": pick("position", "force"),
        "velocity": pick("velocity", "force"),
        "acceleration": pick("acceleration", "force"),
        "load": pick("load", "force"),
        "input": pick("input", "input"),
        "output": pick("output", "output"),
        "time": np.asarray(records.time),
        "history": history[:, :, place.where] if at_input else np.zeros((count, HISTORY)),
        "sample": np.full(count, dt),
        "step_start": nothing,
        "step": np.full(count, dt),
    }
    return Signals(**{name: jnp.asarray(leaf) for name, leaf in leaves.items()})


def scales_at(signals: Signals, before: Signals, dt: float) -> Scales:
    """Sizes of what a law reads at its port.

    Args:
        signals: over time.
        before: the same before samples are seen: how far these move them says how noisy they are.
        dt: sample time, s.
    """
    names = ("position", "velocity", "acceleration", "load", "input", "output")
    sizes = {}
    for name in names:
        values, earlier = np.asarray(getattr(signals, name)), np.asarray(getattr(before, name))
        sizes[name] = Size(
            float(np.sqrt(np.mean(values**2))),
            float(np.max(np.abs(values))),
            float(np.std(values - earlier)),
        )
    time = np.asarray(signals.time)
    return Scales(**sizes, dt=dt, duration=float(np.ptp(time)) + dt)


@eqx.filter_jit
def _regressors(
    setting: Setting,
    law: Int[Array, ""],
    signals: tuple[Signals, Signals, Signals],
    first: Float[Array, " time"],
    shapes: Float[Array, "candidate shape"],
    remembers: bool,
) -> tuple[Array, Array, Array]:
    branches = [path_of(one) for one in setting.laws]

    def evaluate(*of):
        return lax.switch(law, branches, *of)

    start, end, before = signals
    dt = jnp.asarray(setting.dt)
    shares = jnp.asarray(path_rule(_SPOTS)[0])

    def step(shape, memory, here, there, earlier):
        ahead = eqx.tree_at(lambda s: (s.time, s.history), there, (here.time + dt, here.history))
        # Last, what a sensor says before the sample has corrected the state.
        path = jax.tree.map(
            lambda a, b, c: jnp.concatenate(
                [(1.0 - _column(shares, a)) * a[None] + _column(shares, a) * b[None], c[None]]
            ),
            here,
            ahead,
            earlier,
        )
        middle = jax.tree.map(lambda a, b: 0.5 * (a + b), here, ahead)
        after = jnp.append(shares * dt, 0.0)
        values, following = evaluate(path, middle, after, shape, memory, dt)
        sensed, values = values[-1], values[:-1]
        level, change = moments(values)
        return following, (level, change, sensed)

    def along(shape):
        empty = jnp.zeros(MEMORY)
        if not remembers:
            return jax.vmap(lambda a, b, c: step(shape, empty, a, b, c)[1])(start, end, before)

        def scanned(memory, sample):
            here, there, earlier, begins = sample
            memory = jnp.where(begins > 0.0, empty, memory)
            return step(shape, memory, here, there, earlier)

        return lax.scan(scanned, empty, (start, end, before, first))[1]

    return jax.vmap(along)(shapes)


def _column(shares: Array, leaf: Array) -> Array:
    return shares.reshape((-1,) + (1,) * leaf.ndim)


def regressors(
    setting: Setting,
    place: Place,
    shapes: np.ndarray,
    signals: dict[str, dict[str, np.ndarray]],
    records: Records,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """g at the steps' start, its change over them, and at the samples, for several shapes.

    Args:
        setting: laws and sample time.
        place: law and port.
        shapes: (candidate, shape).
        signals: of all ports.
        records: inputs and starts.

    Returns:
        Three arrays (candidate, time, amplitude).
    """
    law = setting.laws[place.law]
    own = (
        signals_at(signals["start"], records, place, setting.dt),
        signals_at(signals["end"], records, place, setting.dt),
        signals_at(signals["before"], records, place, setting.dt),
    )
    found = []
    for begin in range(0, shapes.shape[0], _AT_ONCE):
        part = shapes[begin : begin + _AT_ONCE]
        padded = np.zeros((_AT_ONCE, SHAPES))
        padded[: part.shape[0], : part.shape[1]] = part
        padded[part.shape[0] :] = padded[0]
        out = _regressors(
            setting,
            jnp.asarray(place.law),
            own,
            records.first,
            jnp.asarray(padded),
            law.memory > 0,
        )
        wanted = len(law.amplitudes)
        found.append([np.asarray(leaf)[: part.shape[0], :, :wanted] for leaf in out])
    level, change, sensed = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return level, change, sensed
