"""The predictor with its effects, one compiled program for every set of laws."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from lpvid.effects import HISTORY, MEMORY, AbsoluteValueSensor, AbstractLaw, Signals
from lpvid.loop._discretise import Sampled, sampled_at
from lpvid.loop._path import moments, path_of, path_rule
from lpvid.loop._ported import AbstractPortedStructure
from lpvid.mechanics import SampledController

SLOTS = 3
"""Effects that a model can hold at once."""

SHAPES = 2

SUBSTEPS = 4
"""Steps that a sample is taken in where there are effects: a law that holds a body still needs
them shorter."""


FRACTIONS = path_rule(3)[0]


class Setting(eqx.Module):
    """What does not change within a search: the structure, the laws and the sample time.

    Attributes:
        structure: the model.
        laws: the library.
        dt: sample time, s.
        varying: whether an effect of the program may let a parameter vary.
        hold: what the inputs do between samples, "zero" or "linear".
    """

    structure: AbstractPortedStructure
    laws: tuple[AbstractLaw, ...] = eqx.field(static=True)
    dt: float = eqx.field(static=True)
    varying: bool = eqx.field(static=True, default=False)
    hold: str = eqx.field(static=True, default="zero")


class Records(eqx.Module):
    """Records laid one after another, with what every sample needs.

    Attributes:
        u: (time, nu).
        change: how far the inputs move until the next sample, zero where held (time, nu).
        y: (time, ny).
        history: of the inputs, the present sample first (time, lag, nu).
        time: s since the record's start (time,).
        kappa_nodes: scheduling nodes (node, nk).
        weights: of the nodes (time, node).
        schedules: what a varying parameter may follow, each within ±1 (time, schedule).
        record: index of the sample's record (time,).
        first: whether the sample starts its record (time,).
        counts: 1 where the sample enters a criterion, 0 where it is padding (time,).
        memory: internal states of the effects at each record's start (record, slot, memory).
    """

    u: Float[Array, "time nu"]
    change: Float[Array, "time nu"]
    y: Float[Array, "time ny"]
    history: Float[Array, "time lag nu"]
    time: Float[Array, " time"]
    kappa_nodes: Float[Array, "node nk"]
    weights: Float[Array, "time node"]
    schedules: Float[Array, "time schedule"]
    record: Int[Array, " time"]
    first: Float[Array, " time"]
    counts: Float[Array, " time"]
    memory: Float[Array, "record slot memory"]


class Slots(eqx.Module):
    """Which effect sits where; arrays, so that other ports need no new compilation.

    Attributes:
        laws: index of the law of each effect; the program is compiled for each set of laws.
        input: 1 at the input it acts on (slot, nu).
        force: 1 at the coordinate it acts on (slot, coordinate).
        output: 1 at the output it acts on (slot, ny).
        parameter: 1 at the parameter it lets vary (slot, parameter).
        schedule: 1 at the schedule that the parameter or the effect follows (slot, schedule).
        modulated: 1 where the effect is multiplied by its schedule (slot,).
    """

    laws: tuple[int, ...] = eqx.field(static=True)
    input: Float[Array, "slot nu"]
    force: Float[Array, "slot coordinate"]
    output: Float[Array, "slot ny"]
    parameter: Float[Array, "slot parameter"]
    schedule: Float[Array, "slot schedule"]
    modulated: Float[Array, " slot"]


class Unknowns(eqx.Module):
    """What is estimated.

    Attributes:
        theta: parameters of the model (parameter,).
        amplitude: a (slot, amplitude, direction).
        shape: s (slot, shape).
        start: initial state of each record (record, state).
    """

    theta: Float[Array, " parameter"]
    amplitude: Float[Array, "slot amplitude direction"]
    shape: Float[Array, "slot shape"]
    start: Float[Array, "record state"]


class Injection(eqx.Module):
    """Signals added to the state and to the output, for sensitivities to effects not yet in.

    Attributes:
        state: added to the next state (time, state), with a leading axis where there are several.
        output: added to the predicted output (time, ny), the same.
    """

    state: Float[Array, "*column time state"]
    output: Float[Array, "*column time ny"]


class Feedback(eqx.Module):
    """A sampled controller in place of the recorded inputs.

    Attributes:
        controller: sees the model's outputs at every sample.
        reference: what it is to follow (time, nr).
    """

    controller: SampledController
    reference: Float[Array, "time nr"]


class Trace(eqx.Module):
    """What the predictor went through.

    Attributes:
        u: inputs, recorded or a controller's (time, nu).
        innovations: y − ŷ (time, ny).
        before: state before the sample was seen (time, state).
        state: state with the sample seen (time, state).
        end: state at the sample's end, the next sample not seen (time, state).
        forces: what the effects added, inputs, then coordinates' directions (time, drive).
        memory: internal states of the effects before the sample (time, slot, memory).
    """

    u: Float[Array, "time nu"]
    innovations: Float[Array, "time ny"]
    before: Float[Array, "time state"]
    state: Float[Array, "time state"]
    end: Float[Array, "time state"]
    forces: Float[Array, "time drive"]
    memory: Float[Array, "time slot memory"]


def node_matrices(
    setting: Setting, slots: Slots, unknowns: Unknowns, records: Records, step: Float[Array, ""]
) -> tuple[Sampled, Float[Array, "time all_nodes"]]:
    """Matrices at the nodes of κ and, where parameters vary, of their schedules; with weights.

    A parameter that follows a schedule φ within ±1 is worked out at φ = −1, 0 and 1 and
    interpolated by the parabola through them, its error of third order in the amplitude.

    Args:
        setting: structure, laws, sample time.
        slots: which effects.
        unknowns: parameters and amplitudes.
        records: the nodes and their weights.
        step: that the matrices are for, s.
    """
    nodes = records.kappa_nodes.shape[0]
    thetas = unknowns.theta[None]
    factors = jnp.ones((records.u.shape[0], 1))
    if setting.varying:
        amounts = unknowns.amplitude[:, :1, 0] * slots.parameter
        follow = records.schedules @ slots.schedule.T
        thetas = jnp.concatenate([thetas, thetas * (1.0 + amounts), thetas * (1.0 - amounts)])
        up, down = 0.5 * (follow**2 + follow), 0.5 * (follow**2 - follow)
        middle = 1.0 - jnp.sum(follow**2, axis=1, keepdims=True)
        factors = jnp.concatenate([middle, up, down], axis=1)
    every = jnp.repeat(thetas, nodes, axis=0)
    kappas = jnp.tile(records.kappa_nodes, (thetas.shape[0], 1))
    matrices = sampled_at(setting.structure, every, kappas, step)
    weights = (factors[:, :, None] * records.weights[:, None, :]).reshape(records.u.shape[0], -1)
    return matrices, weights


def _at(matrices: Sampled, weight: Float[Array, " node"]) -> Sampled:
    if weight.shape[0] == 1:
        return jax.tree.map(lambda leaf: leaf[0], matrices)
    return jax.tree.map(lambda leaf: jnp.tensordot(weight, leaf, axes=1), matrices)


def trace(
    setting: Setting,
    records: Records,
    slots: Slots,
    unknowns: Unknowns,
    gain: Float[Array, "node state ny"],
    injection: Injection,
    feedback: Feedback | None = None,
) -> Trace:
    """Run the predictor over the records.

    Each sample is taken in `SUBSTEPS` exponential steps with the effects along the way, a straight
    line over each; the first of them sees the measurement, ŷ = C x + D u with the sensors' effects,
    and corrects x by L (y − ŷ). With a gain of zero it is a simulation.

    Args:
        setting: structure, laws, sample time.
        records: signals, weights, starts.
        slots: which effects.
        unknowns: parameters, amplitudes, shapes, initial states.
        gain: L at the nodes of κ (node, state, ny).
        injection: added signals, usually zero.
        feedback: a controller whose commands take the inputs' place, for a single record.
    """
    laws = [path_of(setting.laws[law]) for law in slots.laws]
    # Without effects one step is exact.
    substeps = SUBSTEPS if slots.laws else 1
    fine = setting.dt / substeps
    matrices, node_weights = node_matrices(setting, slots, unknowns, records, jnp.asarray(fine))
    nu, ny = records.u.shape[1], records.y.shape[1]
    coordinates, directions = slots.force.shape[1], unknowns.amplitude.shape[2]

    def read(M: Sampled, states, u):
        """Coordinates' and outputs' signals for states (fraction, state)."""
        still = jnp.ones((states.shape[0], 1)) * u[None]
        return (
            states @ M.position.T,
            states @ M.velocity.T,
            states @ M.acceleration_state.T + still @ M.acceleration_input.T,
            states @ M.load_state.T + still @ M.load_input.T,
            states @ M.C.T + still @ M.D.T,
        )

    def contributions(M: Sampled, begin, end, memory, u, history, time, since, share):
        """What the effects add on the way (fraction, drive), to outputs (ny,), their memory."""
        shares = jnp.asarray(FRACTIONS)[:, None]
        path = read(M, (1.0 - shares) * begin[None] + shares * end[None], u)
        middle = read(M, 0.5 * (begin + end)[None], u)
        after = jnp.asarray(FRACTIONS) * fine

        def at_slot(slot, signals, times):
            position, velocity, acceleration, load, ideal = signals
            force, still = slots.force[slot], jnp.ones_like(times)
            return Signals(
                position=position @ force,
                velocity=velocity @ force,
                acceleration=acceleration @ force,
                load=load @ force,
                input=still * (slots.input[slot] @ u),
                output=ideal @ slots.output[slot],
                time=times,
                history=still[:, None] * (history @ slots.input[slot])[None],
                sample=setting.dt * still,
                step_start=since * still,
                step=fine * still,
            )

        def one(slot, evaluate, so_far):
            drive, output, next_memory = so_far
            here = at_slot(slot, path, time + after)
            centre = at_slot(slot, middle, time + jnp.full(1, 0.5 * fine))
            values, following = evaluate(
                here,
                jax.tree.map(lambda leaf: leaf[0], centre),
                after,
                unknowns.shape[slot],
                memory[slot],
                jnp.asarray(fine),
            )
            total = share[slot] * (values @ unknowns.amplitude[slot])
            pushed = (slots.force[slot][None, :, None] * total[:, None, :]).reshape(
                total.shape[0], -1
            )
            into = jnp.concatenate([total[:, :1] * slots.input[slot][None], pushed], axis=1)
            return (
                drive + into,
                output + total[0, 0] * slots.output[slot],
                next_memory.at[slot].set(following),
            )

        still = jnp.zeros((FRACTIONS.size, nu + coordinates * directions))
        total = (still, jnp.zeros(ny), memory)
        for slot, evaluate in enumerate(laws):
            total = one(slot, evaluate, total)
        return total

    def turned(ideal):
        """The slope of sensors that fold their output, ±1: it turns the correction round."""
        slope = jnp.ones(ny)
        for slot, law in enumerate(slots.laws):
            if isinstance(setting.laws[law], AbsoluteValueSensor):
                slope = jnp.where((slots.output[slot] > 0.0) & (ideal < 0.0), -1.0, slope)
        return slope

    def command(M: Sampled, x, memory, drive, clock, sees, sample, commanded):
        """Inputs as a controller wants them, which sees the outputs that the last ones leave."""
        assert feedback is not None
        u, history, state = commanded
        free = M.transition @ x + M.drive @ (jnp.concatenate([u, idle[nu:]]) + drive)
        _, sensed, _ = contributions(M, x, free, memory, u, history, *clock)
        read = M.C @ x + M.D @ u + sensed
        following, sent = feedback.controller.step(state, feedback.reference[sample], read)
        fresh = (sent, jnp.concatenate([sent[None], history[:-1]]), following)
        kept = jax.tree.map(lambda new, old: jnp.where(sees, new, old), fresh, commanded)
        return kept[0], kept[1], kept

    def step(carry, fraction):
        x, memory, drive, commanded = carry
        u, slope, y, history, share, time, since, weight, kappa_weight, *marks, added = fraction
        first, which, which_sample, sees, ends = marks
        M = _at(matrices, weight)
        L = jnp.tensordot(kappa_weight, gain, axes=1)
        x = jnp.where(first > 0.0, unknowns.start[which], x)
        memory = jnp.where(first > 0.0, records.memory[which], memory)
        drive = jnp.where(first > 0.0, 0.0, drive)
        if feedback is not None:
            u, history, commanded = command(
                M, x, memory, drive, (time, since, share), sees > 0.0, which_sample, commanded
            )
        given, rise = (jnp.concatenate([part, idle[nu:]]) for part in (u, slope))
        # Laws are read on the way that the model takes by itself, with the last forces.
        free = M.transition @ x + M.drive @ given + M.ramp @ rise
        along, sensed, following = contributions(
            M, x, free + M.drive @ drive, memory, u, history, time, since, share
        )
        level, change = moments(along)
        error = sees * (y - (M.C @ x + M.D @ (u + level[:nu]) + sensed + added.output))
        correction = L @ (turned(M.C @ x + M.D @ u) * error)
        moved = free + M.drive @ level + M.ramp @ change + M.transition @ correction
        # Added at the end, so that a sensitivity sees it as one more force over the sample.
        moved = moved + ends * added.state
        carry = (moved, following, level + change, commanded)
        return carry, (u, error, x, x + correction, moved, level, memory)

    # Every sample is a few fractions, of which the first sees the measurement.
    def spread(array):
        return jnp.repeat(array, substeps, axis=0)

    follow = records.schedules @ slots.schedule.T
    shares = 1.0 + slots.modulated[None] * (follow - 1.0)
    place = jnp.tile(jnp.arange(float(substeps)), records.u.shape[0])
    slope = spread(records.change) / substeps
    fractions = (
        spread(records.u) + place[:, None] * slope,
        slope,
        *map(spread, (records.y, records.history, shares)),
        spread(records.time) + fine * place,
        fine * place,
        *map(spread, (node_weights, records.weights)),
        jnp.where(place == 0.0, spread(records.first), 0.0),
        spread(records.record),
        spread(jnp.arange(records.u.shape[0])),
        jnp.where(place == 0.0, 1.0, 0.0),
        jnp.where(place == substeps - 1.0, 1.0, 0.0),
        jax.tree.map(spread, injection),
    )
    idle = jnp.zeros(nu + coordinates * directions)
    commanded = None
    if feedback is not None:
        commanded = (idle[:nu], jnp.zeros((HISTORY, nu)), feedback.controller.initial())
    start = (unknowns.start[0], jnp.zeros((SLOTS, MEMORY)), idle, commanded)
    _, out = lax.scan(step, start, fractions)
    inputs, error, before, seen, moved, level, memory = out

    def at_samples(array, offset=0):
        return array[offset::substeps]

    return Trace(
        u=at_samples(inputs),
        innovations=at_samples(error),
        before=at_samples(before),
        state=at_samples(seen),
        end=at_samples(moved, substeps - 1),
        forces=jnp.mean(level.reshape(-1, substeps, level.shape[1]), axis=1),
        memory=at_samples(memory),
    )


def nothing_injected(records: Records, states: int) -> Injection:
    """An injection of zeros.

    Args:
        records: whose length it has.
        states: of the model.
    """
    return Injection(jnp.zeros((records.u.shape[0], states)), jnp.zeros_like(records.y))
