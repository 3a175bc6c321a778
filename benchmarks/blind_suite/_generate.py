"""Seed → sealed records: plants, excitation, effects of a calibrated strength, noise."""

import dataclasses
import json
import multiprocessing
import zlib
from pathlib import Path

import numpy as np

from benchmarks.blind_suite._laws import FAMILIES, REPORTED, Effect
from benchmarks.blind_suite._plants import PLANTS, Plant
from benchmarks.blind_suite._simulate import Runs, Signals, simulate

SAMPLES = 4500
CALIBRATION = 1500
SNR = (40.0, 60.0, 80.0)
BLOCK = 750
# Substeps of the records themselves; dry friction's reversals are what needs them.
FINE = 24
ROUNDS, REPLACEMENTS = 4, 2
LEAST_REACH = 0.01
LEAST_OVER_NOISE = 2.5

# Shares of the cases; each plant's records are dealt in this order.
CASES = {"one": 0.34, "two": 0.10, "none": 0.22, "decoy": 0.12, "outside": 0.22}
PAIRS = (
    ("coulomb", "stribeck"),
    ("coulomb", "asymmetric-viscous"),
    ("coulomb", "backlash"),
    ("coulomb", "gravity"),
    ("coulomb", "cubic-stiffness"),
    ("coulomb", "saturation"),
    ("coulomb", "input-delay"),
    ("coulomb", "torque-ripple"),
    ("quadratic-drag", "cubic-stiffness"),
    ("quadratic-drag", "gain-cubic"),
    ("cubic-stiffness", "quadratic-stiffness"),
    ("cubic-stiffness", "periodic-disturbance"),
    ("gravity", "torque-ripple"),
)
# What may take the place of one of a pair.
SIMPLE = (
    "coulomb",
    "asymmetric-viscous",
    "quadratic-drag",
    "gain-cubic",
    "gain-square",
    "saturation",
    "periodic-disturbance",
)


@dataclasses.dataclass
class Record:
    """One record as the solver sees it."""

    key: str
    structure: str
    dt: float
    u: np.ndarray
    y: np.ndarray
    kappa: np.ndarray | None
    input_names: list[str]
    input_units: list[str]
    output_names: list[str]
    output_units: list[str]


@dataclasses.dataclass
class _Draft:
    """A record before it is simulated."""

    key: str
    case: str
    closed: bool
    moving: bool
    snr: float
    measured: bool
    angle: float
    excitation: np.ndarray
    reference: np.ndarray
    kappa: np.ndarray
    seed: int


# ---------------------------------------------------------------- excitation
def _levels(rng, samples):
    """Two amplitudes that alternate by blocks, a ramp of a few samples between them."""
    blocks = -(-samples // BLOCK)
    low = rng.uniform(0.25, 0.45)
    size = np.repeat(np.where(np.arange(blocks) % 2 == 0, 1.0, low), BLOCK)[:samples]
    return np.convolve(np.pad(size, (10, 10), mode="edge"), np.ones(21) / 21, "valid")


def _multisine(rng, samples, dt, band):
    """Random phases; amplitudes fall as 1/f above a corner, so that low frequencies move far."""
    lines = np.arange(1, int(band * samples * dt))
    lines = lines[rng.random(len(lines)) < min(1.0, 150 / len(lines))]
    frequency = lines / (samples * dt)
    size = 1.0 / np.sqrt(1.0 + (frequency / (0.15 * band)) ** 2)
    phase = rng.uniform(0.0, 2 * np.pi, len(lines))
    t = np.arange(samples) * dt
    wave = np.sum(size[:, None] * np.sin(2 * np.pi * frequency[:, None] * t + phase[:, None]), 0)
    return wave / np.max(np.abs(wave))


def _prbs(rng, samples, dt, band):
    """Telegraph of random holding times."""
    shortest = max(1, round(0.3 / (band * dt)))
    holds = rng.integers(shortest, 12 * shortest, samples)
    edges = np.cumsum(holds)
    sign = 1.0 if rng.random() < 0.5 else -1.0
    return sign * (-1.0) ** np.searchsorted(edges, np.arange(samples), side="right")


def _steps(rng, samples, dt, band):
    """Random levels for random times."""
    shortest = max(2, round(0.6 / (band * dt)))
    edges = np.cumsum(rng.integers(shortest, 15 * shortest, samples))
    values = rng.uniform(-1.0, 1.0, samples)
    return values[np.searchsorted(edges, np.arange(samples), side="right")]


def _without_drift(wave, dt, corner):
    """High-pass of first order, so that a free angle does not wander far; peak 1."""
    share, mean, out = 1.0 - np.exp(-2 * np.pi * corner * dt), 0.0, np.empty_like(wave)
    for k, value in enumerate(wave):
        mean += share * (value - mean)
        out[k] = value - mean
    return out / np.max(np.abs(out))


EXCITATIONS = {"multisine": _multisine, "prbs": _prbs, "steps": _steps}


def _draft(plant: Plant, key: str, case: str, seed: int, order: int, samples: int) -> _Draft:
    rng = np.random.default_rng(seed)
    closed = bool(order % 2)
    snr = SNR[(order // 2) % 3]
    moving = plant.scheduled and rng.random() < 0.6
    excitation = np.zeros((samples, len(plant.inputs)))
    reference = np.zeros((samples, len(plant.outputs)))
    for channel, level in enumerate(plant.level):
        kind = rng.choice(list(EXCITATIONS))
        wave = EXCITATIONS[kind](rng, samples, plant.dt, plant.band)
        if plant.corner:
            wave = _without_drift(wave, plant.dt, plant.corner)
        excitation[:, channel] = level * wave * _levels(rng, samples)
    excitation *= rng.uniform(0.8, 1.2)
    t = np.arange(samples) * plant.dt
    if closed:
        # The dither stays, at half its size: a loop that only follows is poorly excited.
        excitation *= 0.5
        for channel, size in enumerate(plant.reference):
            wave = _steps(rng, samples, plant.dt, 0.12 * plant.band)
            reference[:, channel] = size * wave * _levels(rng, samples)
    if moving:
        # Joint 2 sweeps about the square posture.
        omega, sweep = 2 * np.pi / rng.uniform(4.0, 7.0), rng.uniform(0.5, 0.9)
        excitation[:, 1] += sweep * omega * np.cos(omega * t + rng.uniform(0, 2 * np.pi))
    measured = plant.scheduled or rng.random() < 0.25
    kappa = np.zeros(samples)
    if measured and not plant.scheduled:
        # A slow measured quantity, such as a temperature or a load, between −1 and 1.
        duration = samples * plant.dt
        kappa = np.sin(2 * np.pi * rng.uniform(1.2, 2.5) * t / duration + rng.uniform(0, 2 * np.pi))
    angle = np.pi / 2 + (0.0 if moving else rng.uniform(-1.0, 1.0))
    child = int(rng.integers(2**62))
    return _Draft(
        key, case, closed, moving, snr, measured, angle, excitation, reference, kappa, child
    )


# ---------------------------------------------------------------- effects
@dataclasses.dataclass
class _Scales:
    """Sizes without the effect: of the input, outputs, and each coordinate."""

    input_peak: np.ndarray
    output_rms: np.ndarray
    output_peak: np.ndarray
    position_rms: dict[str, float]
    position_peak: dict[str, float]
    velocity_rms: dict[str, float]


def _sizes(plant: Plant, signals: Signals, row: int) -> _Scales:
    names = list(plant.coordinates)
    u, y = np.abs(signals.u[row]), signals.y[row]
    q, v = signals.position[row], signals.velocity[row]
    return _Scales(
        np.max(u, 0),
        np.sqrt(np.mean(y**2, 0)),
        np.max(np.abs(y), 0),
        dict(zip(names, np.sqrt(np.mean(q**2, 0)), strict=True)),
        dict(zip(names, np.max(np.abs(q), 0), strict=True)),
        dict(zip(names, np.sqrt(np.mean(v**2, 0)), strict=True)),
    )


def choices(plant: Plant, draft: _Draft) -> list[str]:
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


def draw_effect(name, plant: Plant, motion, sizes: _Scales, rng: np.random.Generator) -> Effect:
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
        _outside(name, plant, motion, sizes, rng, force, entering), outside=True
    )


def _outside(name, plant, motion, sizes, rng, force, entering) -> Effect:
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


# ---------------------------------------------------------------- strength
def strength(without, changed, noise, linear: bool) -> tuple[float, float]:
    """(over the noise, over the response): what the effect changes in the outputs.

    For nonlinear effects only the part that no linear filter of outputs and input explains, as a
    refitted linear model takes the rest.
    """
    u, y = without
    difference = changed - y
    difference -= 0.0 if linear else difference.mean(0)
    if not linear:
        lags = (0, 1, 2, 4, 7, 11, 16)
        signals = np.concatenate([y, u], axis=1)
        columns = [np.roll(signals, lag, axis=0)[20:] for lag in lags]
        columns.append(np.ones((len(y) - 20, 1)))
        basis = np.concatenate(columns, axis=1)
        basis = basis / (np.sqrt(np.mean(basis**2, 0)) + 1e-300)
        difference = difference[20:]
        difference = difference - basis @ np.linalg.lstsq(basis, difference, rcond=1e-9)[0]
    size = np.sqrt(np.mean(difference**2, 0))
    response = np.std(y, axis=0)
    return float(np.max(size / noise)), float(np.max(size / response))


def _runs(plant, drafts, motions, effects, samples, noise=None) -> Runs:
    shape = (len(drafts), samples, len(plant.outputs))
    return Runs(
        motions=list(motions),
        effects=list(effects),
        excitation=np.stack([d.excitation[:samples] for d in drafts]),
        reference=np.stack([d.reference[:samples] for d in drafts]),
        closed=np.array([float(d.closed) for d in drafts]),
        noise=np.zeros(shape) if noise is None else noise,
        angle=np.array([d.angle for d in drafts]),
        moving=np.array([float(d.moving) for d in drafts]),
        kappa=np.stack([d.kappa[:samples] for d in drafts]),
    )


def _names(plant: Plant, draft: _Draft, order: int, rng) -> list[str]:
    if draft.case == "one":
        # Every effect in turn, so that even small suites hold many.
        available = choices(plant, draft)
        return [available[(7 * order + int(rng.integers(2))) % len(available)]]
    if draft.case == "two":
        available = set(choices(plant, draft)) | {"stribeck"}
        pairs = [pair for pair in PAIRS if set(pair) <= available]
        return list(pairs[order % len(pairs)])
    if draft.case == "outside":
        return [OUTSIDE[order % len(OUTSIDE)]]
    return []


def _target(rng, snr: float) -> float:
    """Wanted strength in units of the noise: 3 to 30 of them, or 2 to 20 % of the response."""
    ratio = 10 ** (-snr / 20)
    over_noise = np.exp(rng.uniform(np.log(3.0), np.log(30.0)))
    share = np.exp(rng.uniform(np.log(0.02), np.log(0.2)))
    wanted = over_noise if rng.random() < 0.5 else share / ratio
    return float(np.clip(wanted, 3.0, 0.2 / ratio))


def _replacement(name: str, mine: list[str], draft: _Draft, plant: Plant, rng) -> str:
    """Another effect of the same case, for one that cannot be made strong enough."""
    pool = {
        "outside": list(OUTSIDE),
        "one": choices(plant, draft),
        "two": [n for n in SIMPLE if n in choices(plant, draft)],
    }[draft.case]
    return str(rng.choice([n for n in pool if n != name and n not in mine]))


def _hurried(effect: Effect, samples: int) -> Effect:
    """What creeps over a record, seen over the few samples of a calibration."""
    share = samples / SAMPLES
    if effect.name.endswith("drifting"):
        return dataclasses.replace(effect, shape=(effect.shape[0], effect.shape[1] * share))
    if effect.name == "sensor-drift":
        return dataclasses.replace(effect, amplitude=(effect.amplitude[0] / share,))
    return effect


def _in_words_of_library(effect: Effect, kappa: np.ndarray) -> tuple[float, ...]:
    """Amplitudes as the library counts them: a schedule is scaled to ±1 over the record."""
    if not effect.name.endswith("scheduled"):
        return effect.amplitude
    middle, half = 0.5 * (kappa.max() + kappa.min()), 0.5 * (kappa.max() - kappa.min())
    return (effect.amplitude[0] * half / (1.0 + effect.amplitude[0] * middle),)


def _calibrated(plant, drafts, motions, names, clean: Signals, noise_std):
    """Row, effect and realised strength of every single effect, drawn again where it is too weak.

    An amplitude stays within its reach of the physically sized first draw.
    """
    samples = clean.u.shape[1]
    jobs = [(r, name) for r, wanted in enumerate(names) for name in wanted]
    rng = [np.random.default_rng([drafts[r].seed, j]) for j, (r, _) in enumerate(jobs)]
    sizes = [_sizes(plant, clean, r) for r in range(len(drafts))]
    effects: list[Effect] = []

    def drawn(j: int) -> Effect:
        r, name = jobs[j]
        effect = draw_effect(name, plant, motions[r], sizes[r], rng[j])
        if name == "stribeck":
            # Its partner is the record's dry friction, listed just before it.
            where = effects[j - 1].port
            effect = dataclasses.replace(effect, port=where, label=f"force at {where}")
        return effect

    for j in range(len(jobs)):
        effects.append(drawn(j))
    targets = [_target(rng[j], drafts[r].snr) for j, (r, _) in enumerate(jobs)]
    factors = [1.0] * len(jobs)
    realised = [(np.nan, np.nan)] * len(jobs)
    todo = list(range(len(jobs)))
    for attempt in range(1 + REPLACEMENTS):
        for turn in range(ROUNDS):
            if not todo:
                break
            here = [jobs[j][0] for j in todo]
            trial = _runs(
                plant,
                [drafts[r] for r in here],
                [motions[r] for r in here],
                [[_hurried(effects[j].times(factors[j]), samples)] for j in todo],
                samples,
            )
            with np.errstate(all="ignore"):
                moved = simulate(plant, trial)
            for place, (j, r) in enumerate(zip(todo, here, strict=True)):
                y = moved.y[place]
                if not np.all(np.isfinite(y)) or np.any(np.abs(y) > 10 * sizes[r].output_peak):
                    factors[j] *= 0.2
                    realised[j] = (np.nan, np.nan)
                    continue
                realised[j] = strength((clean.u[r], clean.y[r]), y, noise_std[r], effects[j].linear)
                ratio = targets[j] / max(realised[j][0], 1e-9)
                if abs(np.log(ratio)) > 0.2 and turn < ROUNDS - 1:
                    factors[j] = float(
                        np.clip(factors[j] * ratio**0.9, LEAST_REACH, effects[j].most)
                    )
        # NaN counts as too weak, so that whatever diverged is drawn again.
        todo = [j for j in todo if not realised[j][0] >= LEAST_OVER_NOISE]
        if attempt < REPLACEMENTS:
            for j in todo:
                r, name = jobs[j]
                mine = [other for row, other in jobs if row == r]
                jobs[j] = (r, _replacement(name, mine, drafts[r], plant, rng[j]))
                effects[j], factors[j] = drawn(j), 1.0
    strong = [effect.times(factor) for effect, factor in zip(effects, factors, strict=True)]
    return [r for r, _ in jobs], strong, realised


def _plant_records(name: str, cases: list[str], seed: int, samples: int):
    """All records of one plant, and their labels."""
    plant = PLANTS[name]
    code = zlib.crc32(plant.name.encode())
    seeds = np.random.SeedSequence([seed, code]).generate_state(len(cases), np.uint64)
    shift = int(np.random.default_rng([seed, code]).integers(1000))
    drafts, motions, names, counters = [], [], [], {}
    for i, case in enumerate(cases):
        count = counters[case] = counters.get(case, shift) + 1
        draft = _draft(plant, f"{plant.name}-{i:04d}", case, int(seeds[i]), count, samples)
        rng = np.random.default_rng(draft.seed)
        drafts.append(draft)
        motions.append(plant.draw(rng, case == "decoy"))
        # Nothing in loop or noise may go with the effect: another counter, another stride.
        names.append(_names(plant, draft, count // 2 + 5 * shift, rng))

    short = min(CALIBRATION, samples)
    clean = simulate(plant, _runs(plant, drafts, motions, [[]] * len(drafts), short))
    noise_std = [
        np.std(clean.y[r], axis=0) * 10 ** (-drafts[r].snr / 20) for r in range(len(drafts))
    ]
    rows, effects, realised = _calibrated(plant, drafts, motions, names, clean, noise_std)
    final = [[effects[j] for j, row in enumerate(rows) if row == r] for r in range(len(drafts))]
    noise = np.stack(
        [
            np.random.default_rng(d.seed + 2).standard_normal((samples, len(plant.outputs)))
            * noise_std[r]
            for r, d in enumerate(drafts)
        ]
    )
    with np.errstate(all="ignore"):
        runs = _runs(plant, drafts, motions, final, samples, noise)
        signals = simulate(plant, runs, FINE)
    records, labels = [], {}
    for r, draft in enumerate(drafts):
        kappa = signals.kappa[r][:, None] if draft.measured else None
        records.append(
            Record(
                draft.key,
                plant.structure,
                plant.dt,
                signals.u[r],
                signals.y[r],
                kappa,
                [name for name, _ in plant.inputs],
                [unit for _, unit in plant.inputs],
                [name for name, _ in plant.outputs],
                [unit for _, unit in plant.outputs],
            )
        )
        mine = [j for j, row in enumerate(rows) if row == r]
        labels[draft.key] = {
            "plant": plant.name,
            "case": draft.case,
            "loop": "closed" if draft.closed else "open",
            "snr": draft.snr,
            "moving": draft.moving,
            "noise_std": noise_std[r].tolist(),
            "physical": motions[r].physical,
            "finite": bool(np.max(np.abs(signals.y[r])) < 1e3 * np.max(np.abs(clean.y[r]))),
            "effects": [
                {
                    "name": REPORTED.get(effects[j].name, effects[j].name),
                    "detail": effects[j].name,
                    "family": FAMILIES.get(
                        REPORTED.get(effects[j].name, effects[j].name), "outside"
                    ),
                    "port": effects[j].label,
                    "amplitude": list(_in_words_of_library(effects[j], signals.kappa[r])),
                    "shape": list(effects[j].shape),
                    "over_noise": realised[j][0],
                    "over_response": realised[j][1],
                }
                for j in mine
            ],
        }
    return records, labels


def deal(count: int) -> list[str]:
    """`count` cases in their shares, well mixed so that any first few are a fair sample."""
    dealt: list[str] = []
    owed = dict.fromkeys(CASES, 0.0)
    for _ in range(count):
        owed = {case: value + CASES[case] for case, value in owed.items()}
        richest = max(owed, key=lambda case: owed[case])
        owed[richest] -= 1.0
        dealt.append(richest)
    return dealt


def generate(
    seed: int,
    count: int,
    *,
    plants: tuple[str, ...] = tuple(PLANTS),
    samples: int = SAMPLES,
    processes: int = 1,
) -> tuple[list[Record], dict[str, dict]]:
    """`count` records in all, plants in turn, and their labels by key.

    Args:
        seed: 1 for development; 2 gives the figures that are reported.
        count: records in all; the first few of a larger suite are not those of a smaller one.
        plants: names of `PLANTS`.
        samples: of each record.
        processes: that simulate at the same time, a plant each.
    """
    shares = [count // len(plants) + (i < count % len(plants)) for i in range(len(plants))]
    jobs = [(name, deal(share), seed, samples) for name, share in zip(plants, shares, strict=True)]
    jobs = [job for job in jobs if job[1]]
    if processes > 1 and len(jobs) > 1:
        with multiprocessing.get_context("spawn").Pool(processes) as pool:
            made = pool.starmap(_plant_records, jobs, chunksize=1)
    else:
        made = [_plant_records(*job) for job in jobs]
    records = [some for some, _ in made]
    labels = {key: label for _, theirs in made for key, label in theirs.items()}
    mixed = [group[i] for i in range(max(map(len, records))) for group in records if i < len(group)]
    return [record for record in mixed if labels[record.key]["finite"]], labels


def save(folder: Path, records: list[Record], labels: dict[str, dict]) -> None:
    """Records in `records.npz`, the truth apart in `labels.json`."""
    folder.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, np.ndarray] = {}
    about = {}
    for record in records:
        arrays[f"{record.key}/u"], arrays[f"{record.key}/y"] = record.u, record.y
        if record.kappa is not None:
            arrays[f"{record.key}/kappa"] = record.kappa
        fields = ("structure", "dt", "input_names", "input_units", "output_names", "output_units")
        about[record.key] = {field: getattr(record, field) for field in fields}
    np.savez_compressed(folder / "records.npz", about=np.array(json.dumps(about)), **arrays)  # pyright: ignore[reportArgumentType]
    (folder / "labels.json").write_text(json.dumps(labels, indent=1))


def load(folder: Path) -> list[Record]:
    """The records of a folder, without their labels."""
    with np.load(folder / "records.npz") as archive:
        about = json.loads(str(archive["about"]))
        return [
            Record(
                key=key,
                u=archive[f"{key}/u"],
                y=archive[f"{key}/y"],
                kappa=archive[f"{key}/kappa"] if f"{key}/kappa" in archive else None,
                **fields,
            )
            for key, fields in about.items()
        ]
