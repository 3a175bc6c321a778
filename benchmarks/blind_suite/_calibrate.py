"""Effects made as strong as wanted: 3 to 30 times the noise, or 2 to 20 % of the response."""

import dataclasses

import numpy as np

from benchmarks.blind_suite._draft import SAMPLES, Draft
from benchmarks.blind_suite._effects import OUTSIDE, choices, draw_effect, sizes_of
from benchmarks.blind_suite._laws import Effect
from benchmarks.blind_suite._plants import Plant
from benchmarks.blind_suite._simulate import Runs, Signals, simulate

ROUNDS, REPLACEMENTS = 4, 2
LEAST_REACH = 0.01
LEAST_OVER_NOISE = 2.5

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


def runs_of(plant, drafts, motions, effects, samples, noise=None) -> Runs:
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


def wanted_effects(plant: Plant, draft: Draft, order: int, rng) -> list[str]:
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


def _replacement(name: str, mine: list[str], draft: Draft, plant: Plant, rng) -> str:
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


def in_words_of_library(effect: Effect, kappa: np.ndarray) -> tuple[float, ...]:
    """Amplitudes as the library counts them: a schedule is scaled to ±1 over the record."""
    if not effect.name.endswith("scheduled"):
        return effect.amplitude
    middle, half = 0.5 * (kappa.max() + kappa.min()), 0.5 * (kappa.max() - kappa.min())
    return (effect.amplitude[0] * half / (1.0 + effect.amplitude[0] * middle),)


def calibrated(plant, drafts, motions, names, clean: Signals, noise_std):
    """Row, effect and realised strength of every single effect, drawn again where it is too weak.

    An amplitude stays within its reach of the physically sized first draw.
    """
    samples = clean.u.shape[1]
    jobs = [(r, name) for r, wanted in enumerate(names) for name in wanted]
    rng = [np.random.default_rng([drafts[r].seed, j]) for j, (r, _) in enumerate(jobs)]
    sizes = [sizes_of(plant, clean, r) for r in range(len(drafts))]
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
            trial = runs_of(
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
