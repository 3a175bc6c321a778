"""What a record of the suite is before it is simulated: excitation, loop, noise level."""

import dataclasses

import numpy as np

from benchmarks.blind_suite._plants import Plant

SAMPLES = 4500
SNR = (40.0, 60.0, 80.0)
BLOCK = 750


@dataclasses.dataclass
class Draft:
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


def draft_record(plant: Plant, key: str, case: str, seed: int, order: int, samples: int) -> Draft:
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
    return Draft(
        key, case, closed, moving, snr, measured, angle, excitation, reference, kappa, child
    )
