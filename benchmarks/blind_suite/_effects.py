"""Effects of a rough size for a record, from the library and from outside it."""

import dataclasses

import numpy as np

from benchmarks.blind_suite._draft import SAMPLES, Draft
from benchmarks.blind_suite._laws import Effect
from benchmarks.blind_suite._plants import Plant
from benchmarks.blind_suite._simulate import Signals


@dataclasses.dataclass
class Sizes:
    """Sizes without the effect: of the input, outputs, and each coordinate."""

    input_peak: np.ndarray
    output_rms: np.ndarray
    output_peak: np.ndarray
    position_rms: dict[str, float]
    position_peak: dict[str, float]
    velocity_rms: dict[str, float]


def sizes_of(plant: Plant, signals: Signals, row: int) -> Sizes:
    names = list(plant.coordinates)
    u, y = np.abs(signals.u[row]), signals.y[row]
    q, v = signals.position[row], signals.velocity[row]
    return Sizes(
        np.max(u, 0),
        np.sqrt(np.mean(y**2, 0)),
        np.max(np.abs(y), 0),
        dict(zip(names, np.sqrt(np.mean(q**2, 0)), strict=True)),
        dict(zip(names, np.max(np.abs(q), 0), strict=True)),
        dict(zip(names, np.sqrt(np.mean(v**2, 0)), strict=True)),
    )


def choices(plant: Plant, draft: Draft) -> list[str]:
    """Effects of the library that make sense on a plant and can be seen in its record."""
    measured = draft.measured and (draft.moving or not plant.scheduled)
    names = ["coulomb", "asymmetric-viscous", "quadratic-drag", "dahl", "torque-bias"]
    names += ["periodic-disturbance", "saturation", "gain-cubic", "gain-asymmetry", "gain-square"]
    names += ["input-delay", "actuator-lag", "sensor-lag", "cubic-sensor", "missing-mode"]
    # A loop that is closed about a sensor without sign runs away.
    if not draft.closed:
        names += ["absolute-value-sensor"]
    # The library's two-link arm has ports at its joints only.
    if plant.elastic and plant.structure != "two-link-arm":
        names += ["cubic-stiffness", "quadratic-stiffness", "play", "bouc-wen"]
    if plant.structure == "flexible-joint":
        names += ["backlash", "load-dependent", "position-dependent-inertia", "centrifugal"]
    if plant.turning:
        names += ["gravity", "torque-ripple"]
    if plant.level_outputs:
        names += ["sensor-bias", "sensor-drift"]
    if measured and plant.elastic:
        names += ["scheduling"] * 3
    if plant.elastic:
        names += ["parameter-drift"]
    return names


OUTSIDE = (
    "preload",
    "van der Pol damping",
    "parametric stiffness",
    "cross damping",
    "wandering force",
    "gain that heats up",
    "chirp disturbance",
    "one-sided stop",
    "input times position",
    "slew limit",
    "friction by position",
)


def _own(matrix: np.ndarray, direction: tuple[float, ...]) -> float:
    """The matrix's entry of a coordinate; of a pair, the coupling between its two bodies."""
    e = np.array(direction)
    where = np.flatnonzero(e)
    if len(where) == 2:
        return float(-matrix[where[0], where[1]])
    return float(e @ matrix @ e)


def draw_effect(name, plant: Plant, motion, sizes: Sizes, rng: np.random.Generator) -> Effect:
    """An effect of a rough size on a record; calibration sets its strength."""
    sign = rng.choice((-1.0, 1.0))
    channel = int(rng.integers(len(plant.inputs)))
    output = int(rng.integers(len(plant.outputs)))
    sliding = str(rng.choice(plant.sliding))
    elastic = str(rng.choice(plant.elastic)) if plant.elastic else sliding
    turning = str(rng.choice(plant.turning)) if plant.turning else sliding
    torque = float(np.abs(motion.inputs).max() * sizes.input_peak.max())
    at_input = f"input {plant.inputs[channel][0]}"
    peak, speed = sizes.position_peak, sizes.velocity_rms

    def force(coordinate, amplitude, shape=(), **more):
        label = f"force at {coordinate}"
        return Effect(name, "force", coordinate, label, amplitude, shape, **more)

    def entering(amplitude, shape=(), **more):
        return Effect(name, "input", channel, at_input, amplitude, shape, **more)

    def sensed(channel, amplitude, shape=(), **more):
        label = f"output {plant.outputs[channel][0]}"
        return Effect(name, "output", channel, label, amplitude, shape, **more)

    limit = sizes.input_peak[channel]
    match name:
        case "coulomb" | "asymmetric-viscous" | "quadratic-drag":
            power = {"coulomb": 0, "asymmetric-viscous": 1, "quadratic-drag": 2}[name]
            signed = sign if name == "asymmetric-viscous" else 1.0
            return force(sliding, (0.1 * torque * signed / speed[sliding] ** power,))
        case "stribeck":
            return force(sliding, (0.1 * torque,), (rng.uniform(0.1, 0.3) * speed[sliding],))
        case "load-dependent":
            return force(sliding, (0.1,))
        case "dahl":
            length = rng.uniform(0.03, 0.15) * sizes.position_rms[sliding]
            return force(sliding, (0.1 * torque,), (length,))
        case "bouc-wen" | "play":
            slack = (0.1, 0.4) if name == "play" else (0.4, 1.5)
            width = rng.uniform(*slack) * sizes.position_rms[elastic]
            size = 0.1 * _own(motion.stiffness, plant.coordinates[elastic])
            size *= sizes.position_rms[elastic] / (1.0 if name == "bouc-wen" else width)
            more = () if name == "play" else (rng.uniform(0.5, 1.0),)
            return force(elastic, (size,), (width, *more))
        case "cubic-stiffness" | "quadratic-stiffness":
            power = 2 if name == "cubic-stiffness" else 1
            size = _own(motion.stiffness, plant.coordinates[elastic]) / peak[elastic] ** power
            return force(elastic, (0.3 * size * (1.0 if power == 2 else sign),))
        case "backlash":
            stiffness = _own(motion.stiffness, plant.coordinates[elastic])
            gap = 0.1 * sizes.position_rms[elastic]
            return force(elastic, (stiffness,), (gap,), scaled="shape")
        case "gravity":
            angle = 0.0 if rng.random() < 0.5 else rng.uniform(-0.5, 0.5)
            size = 0.2 * torque
            return force(turning, (size * np.cos(angle), size * np.sin(angle)))
        case "torque-ripple":
            number, angle = float(rng.choice((3, 4, 6, 8, 12))), rng.uniform(0, 2 * np.pi)
            if plant.structure == "single-link-arm":
                number *= 4.0
            size = 0.15 * torque
            return force(turning, (size * np.cos(angle), size * np.sin(angle)), (number,))
        case "periodic-disturbance":
            omega, angle = 2 * np.pi * plant.band * rng.uniform(0.05, 0.5), rng.uniform(0, 6.3)
            size = 0.1 * torque
            return force(sliding, (size * np.cos(angle), size * np.sin(angle)), (omega,))
        case "torque-bias":
            return force(sliding, (0.1 * torque * sign,), linear=True)
        case "position-dependent-inertia":
            # An eccentric mass: inertia least where its centre is below.
            angle = rng.uniform(0, 2 * np.pi)
            place = plant.coordinates[turning].index(1.0)
            size = 0.15 * motion.mass[0][place, place]
            return force(turning, (size * np.cos(angle), size * np.sin(angle)))
        case "centrifugal":
            return force(turning, (0.1 * torque * sign / speed[turning] ** 2,))
        case "saturation":
            level = sizes.input_peak[channel] * rng.uniform(0.5, 0.8)
            return entering((1.0,), (level,), scaled="limit")
        case "gain-cubic":
            return entering((0.2 * sign / limit**2,))
        case "gain-asymmetry":
            return entering((0.1 * sign,))
        case "gain-square":
            return entering((0.2 * sign / limit,))
        case "input-delay":
            delay = plant.dt * rng.integers(2, 21) / 8.0
            return entering((1.0,), (delay,), scaled="nothing", linear=True)
        case "actuator-lag":
            tau = plant.dt * rng.uniform(0.5, 3.0)
            return entering((1.0,), (tau,), scaled="nothing", linear=True)
        case "sensor-lag":
            tau = plant.dt * rng.uniform(0.5, 3.0)
            return sensed(output, (1.0,), (tau,), scaled="nothing", linear=True)
        case "missing-mode":
            omega = 2 * np.pi * plant.band * rng.uniform(0.15, 0.5)
            mass = 0.1 * motion.mass[len(motion.mass) // 2]
            size = float(np.array(plant.coordinates[sliding]) @ mass @ plant.coordinates[sliding])
            shape = (omega, rng.uniform(0.01, 0.05))
            label = f"force at {sliding}"
            return Effect(name, "mode", sliding, label, (size,), shape, "amplitude", linear=True)
        case "sensor-bias" | "sensor-drift":
            output = int(rng.choice(plant.level_outputs))
            size = 0.1 * sizes.output_rms[output] * sign
            size /= 1.0 if name == "sensor-bias" else plant.dt * SAMPLES
            return sensed(output, (size,), linear=True)
        case "absolute-value-sensor":
            return sensed(output, (1.0,), scaled="nothing")
        case "cubic-sensor":
            return sensed(output, (0.1 * sign / sizes.output_peak[output] ** 2,))
        case "scheduling" | "parameter-drift":
            kind = str(rng.choice(("damping", "stiffness")))
            where = sliding if kind == "damping" else elastic
            if where == "joint 1":
                # The first gain is no parameter of the library's structure.
                where = "joint 2"
            value = _own(getattr(motion, kind), plant.coordinates[where])
            label = f"{kind} at {where}"
            if plant.structure == "flexible-joint":
                label = f"{where} viscous friction" if kind == "damping" else "stiffness"
                if kind == "damping":
                    value = motion.physical[f"{where} friction"]
            elif plant.structure == "mass-spring-damper":
                place = plant.coordinates[where].index(1.0) + 1
                label = f"{kind}[{place},{place}]"
            elif kind == "damping":
                # The velocity loop's gain, which is the damping too.
                kind, label = "gain", f"velocity gain {where[-1]}"
            else:
                label = f"bending stiffness {where[-1]}"
            verb, over = ("scheduled", "kappa1") if name == "scheduling" else ("drifting", "time")
            shape = (value, plant.dt * SAMPLES)
            full = f"{kind}, {verb}"
            return Effect(
                full, "force", where, f"{label} over {over}", (0.3 * sign,), shape, most=2.0
            )
    return dataclasses.replace(
        outside_effect(name, plant, motion, sizes, rng, force, entering), outside=True
    )


def outside_effect(name, plant, motion, sizes, rng, force, entering) -> Effect:
    """Effects that the library does not have."""
    sliding = str(rng.choice(plant.sliding))
    elastic = str(rng.choice(plant.elastic)) if plant.elastic else sliding
    channel = int(rng.integers(len(plant.inputs)))
    torque = float(np.abs(motion.inputs).max() * sizes.input_peak.max())
    rms, speed = sizes.position_rms, sizes.velocity_rms
    stiffness = torque / rms[elastic]
    match name:
        case "preload":
            return force(elastic, (0.1 * torque,), (0.05 * rms[elastic],))
        case "van der Pol damping" | "cross damping":
            return force(sliding, (0.2 * torque / speed[sliding] / rms[sliding] ** 2,))
        case "parametric stiffness":
            omega = 2 * np.pi * plant.band * rng.uniform(0.02, 0.3)
            return force(elastic, (0.2 * stiffness,), (omega,))
        case "wandering force":
            seed = float(rng.integers(1, 2**40))
            return force(sliding, (0.1 * torque,), (seed, rng.uniform(0.2, 1.0)))
        case "gain that heats up":
            tau = plant.dt * SAMPLES * rng.uniform(0.05, 0.15)
            size = 0.3 * float(np.abs(motion.inputs).max()) / sizes.input_peak[0] ** 2
            driven = list(plant.coordinates)[0]
            return force(driven, (3.0 * size,), (tau,))
        case "chirp disturbance":
            low, high = 2 * np.pi * plant.band * np.array([0.02, rng.uniform(0.2, 0.5)])
            return force(sliding, (0.1 * torque,), (low, (high - low) / (plant.dt * SAMPLES)))
        case "one-sided stop":
            size = _own(motion.stiffness, plant.coordinates[elastic]) or stiffness
            place = rng.uniform(0.8, 1.5) * rms[elastic]
            return force(elastic, (0.5 * size,), (place,))
        case "input times position":
            return force(sliding, (0.3 * torque / sizes.input_peak[0] / rms[sliding],))
        case "slew limit":
            fastest = 4.0 * sizes.input_peak[channel] * plant.band
            return dataclasses.replace(entering((fastest,)), port=channel, scaled="nothing")
        case "friction by position":
            return force(sliding, (0.15 * torque,), (np.pi / max(rms[sliding], 1e-9),))
    raise ValueError(f"name={name!r}: no such effect.")
