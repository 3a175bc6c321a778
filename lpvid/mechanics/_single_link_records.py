"""Experiments of Sun 2000 on the single-link arm: open loop, bounded position, closed loop."""

from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from lpvid.data import IOData
from lpvid.mechanics._sampled_control import (
    BoundedPosition,
    ProportionalDerivative,
    SampledController,
)
from lpvid.mechanics._single_link_arm import SingleLinkFlexibleArm
from lpvid.mechanics._single_link_effects import ArmEffects
from lpvid.mechanics._single_link_simulation import simulate_single_link

Excitation = Literal["square", "periodic random", "varying square", "random"]
Reference = Literal["square", "varying square"]

# 002, section 2.4.1 and table A-3.
_FREQUENCY, _FREQUENCIES = 0.5, (0.6, 3.0)
_PERIOD, _PERIODS = 10.0, (2.5, 5.0)
_PD = (1.0, 2.8)


def open_loop_record(
    arm: SingleLinkFlexibleArm,
    key: PRNGKeyArray,
    *,
    excitation: Excitation = "square",
    amplitude: float = 2.0,
    duration: float = 20.0,
    rate: float = 300.0,
    hold: float = 0.01,
    effects: ArmEffects | None = None,
    substeps: int = 8,
) -> IOData:
    """Open-loop record: a current that changes direction, whatever the arm does.

    - square: constant size, direction alternating at 0.5 Hz;
    - periodic random: the same direction, the size drawn anew every `hold` seconds from
      [0, amplitude];
    - varying square: constant size, direction alternating at frequencies drawn from 0.6 to 3 Hz,
      one for each cycle;
    - random: size and direction drawn anew every `hold` seconds from [−amplitude, amplitude], less
      their mean over each second.

    A square begins in the middle of a pulse and the mean of a random one is taken off: the angle,
    which integrates, would otherwise drift out of the arm's ±80°. The defaults stay inside them
    with and without 0.4 A of friction.

    Args:
        arm: the arm.
        key: random key, for the command and the sensor noise.
        excitation: one of the four.
        amplitude: of the command, V (002: 1 or 2).
        duration: s (002: 10 or 20).
        rate: samples per second (002: 300 or 500).
        hold: how long a random size lasts, s.
        effects: none by default.
        substeps: integrator's steps per sample.

    Returns:
        `IOData`: command in V; hub angle, base and middle strain, tachometer in V.

    Raises:
        ValueError: an unknown excitation, a record of fewer than two samples.

    Warns:
        UserWarning: the hub left its ±80°.

    Source: 002, section 2.4.1.

    Example:
        >>> from lpvid.mechanics import reference_single_link_arm
        >>> arm = reference_single_link_arm()
        >>> open_loop_record(arm, jax.random.key(0), duration=0.1).output_names
        ('hub angle', 'base strain', 'middle strain', 'tachometer')
    """
    samples, hold_samples = _samples(duration, rate), max(round(hold * rate), 1)
    command_key, noise_key = jax.random.split(key)
    build = _of("excitation", excitation, _EXCITATIONS)
    command = amplitude * build(command_key, samples, 1.0 / rate, hold_samples)
    return _record(arm, None, command, rate, effects, noise_key, substeps)


def bounded_position_record(
    arm: SingleLinkFlexibleArm,
    key: PRNGKeyArray,
    *,
    random_size: bool = False,
    amplitude: float = 3.0,
    bound: float = 3.0,
    duration: float = 40.0,
    rate: float = 300.0,
    hold: float = 0.1,
    effects: ArmEffects | None = None,
    substeps: int = 8,
) -> IOData:
    """Bounded-position record: the current reverses where the measured angle passes a bound.

    Args:
        arm: the arm.
        key: random key, for the command's size and the sensor noise.
        random_size: size drawn anew every `hold` seconds from [0, amplitude]; constant otherwise.
        amplitude: of the command, V (002: 1 to 4; 3 V are 1.5 A).
        bound: of the measured hub angle, V (002: 3 V, 35°).
        duration: s (002: 40 at 300 Hz, 24 at 500 Hz).
        rate: samples per second (002: 300 or 500).
        hold: how long a random size lasts, s.
        effects: none by default.
        substeps: integrator's steps per sample.

    Returns:
        `IOData`: command in V as it was sent; hub angle, base and middle strain, tachometer in V.

    Raises:
        ValueError: a record of fewer than two samples.

    Warns:
        UserWarning: the hub left its ±80°.

    Source: 002, section 2.4.2.

    Example:
        >>> from lpvid.mechanics import reference_single_link_arm
        >>> arm = reference_single_link_arm()
        >>> bounded_position_record(arm, jax.random.key(0), duration=0.1).u[0]
        Array([3.], dtype=float64)
    """
    samples, hold_samples = _samples(duration, rate), max(round(hold * rate), 1)
    size_key, noise_key = jax.random.split(key)
    size = jnp.ones(samples)
    if random_size:
        size = _held(size_key, samples, hold_samples, 0.0)
    controller = BoundedPosition(bound)
    return _record(arm, controller, amplitude * size, rate, effects, noise_key, substeps)


def closed_loop_record(
    arm: SingleLinkFlexibleArm,
    key: PRNGKeyArray,
    *,
    reference: Reference = "square",
    amplitude: float = 3.0,
    gains: tuple[float, float] = _PD,
    compensation: float = 0.0,
    keep_compensation: bool = False,
    duration: float = 40.0,
    rate: float = 300.0,
    effects: ArmEffects | None = None,
    substeps: int = 8,
) -> IOData:
    """Closed-loop record under u = kp (R − y1) − kd y4 + c sign(·), R a square of hub angles.

    - square: period 10 s;
    - varying square: periods drawn from 2.5 to 5 s, one for each cycle.

    Args:
        arm: the arm.
        key: random key, for the reference and the sensor noise.
        reference: one of the two.
        amplitude: of the reference, V (002: 2 to 4; 3 V are 35°).
        gains: kp and kd, V/V.
        compensation: c of the Coulomb compensation, V (002: 0.8, worth 0.4 A); none by default.
        keep_compensation: whether the record's input holds the compensation too. 002 subtracts it,
            so that with friction in the arm the record is nearly that of a linear one.
        duration: s (002: 40 or 32).
        rate: samples per second (002: 300).
        effects: none by default.
        substeps: integrator's steps per sample.

    Returns:
        `IOData`: command in V; hub angle, base and middle strain, tachometer in V.

    Raises:
        ValueError: an unknown reference, a record of fewer than two samples.

    Warns:
        UserWarning: the hub left its ±80°.

    Source: 002, section 2.4.3.

    Example:
        >>> from lpvid.mechanics import reference_single_link_arm
        >>> arm = reference_single_link_arm()
        >>> closed_loop_record(arm, jax.random.key(0), duration=0.1).u[0]
        Array([3.], dtype=float64)
    """
    samples = _samples(duration, rate)
    reference_key, noise_key = jax.random.split(key)
    build = _of("reference", reference, _REFERENCES)
    controller = ProportionalDerivative(*gains, compensation=compensation)
    asked = amplitude * build(reference_key, samples, 1.0 / rate)
    data = _record(arm, controller, asked, rate, effects, noise_key, substeps)
    if compensation and not keep_compensation:
        data = data.replace(u=data.u - compensation * jnp.sign(data.u))
    return data


def _record(
    arm: SingleLinkFlexibleArm,
    controller: SampledController | None,
    reference: ArrayLike,
    rate: float,
    effects: ArmEffects | None,
    key: PRNGKeyArray,
    substeps: int,
) -> IOData:
    motion = simulate_single_link(
        arm,
        reference=reference,
        dt=1.0 / rate,
        controller=controller,
        effects=effects,
        key=key,
        substeps=substeps,
    )
    return motion.data(1.0 / rate)


def _cycles(
    key: PRNGKeyArray, samples: int, dt: float, periods: tuple[float, float], first: float
) -> Float[Array, " time"]:
    """±1 with one period drawn for each cycle; `first` is the phase at the start, in cycles."""
    shortest, longest = periods
    # Frequencies, not periods, are drawn evenly.
    count = int(samples * dt / shortest) + 2
    rates = jax.random.uniform(key, (count,), float, 1.0 / longest, 1.0 / shortest)
    ends = jnp.concatenate([jnp.zeros(1), jnp.cumsum(1.0 / rates)])
    phase = jnp.interp(dt * jnp.arange(samples, dtype=float), ends, jnp.arange(count + 1.0)) + first
    # A switching time that is a sample must not be rounded to the sample after it.
    return jnp.where((phase + 1e-9) % 1.0 < 0.5, 1.0, -1.0)


def _held(key: PRNGKeyArray, samples: int, hold: int, lowest: float) -> Float[Array, " time"]:
    levels = jax.random.uniform(key, (-(-samples // hold),), float, lowest, 1.0)
    return jnp.repeat(levels, hold)[:samples]


def _square(key: PRNGKeyArray, samples: int, dt: float, hold: int) -> Float[Array, " time"]:
    del hold
    # A quarter of a cycle in: the speed, and with it the angle, has no mean.
    return _cycles(key, samples, dt, (1.0 / _FREQUENCY, 1.0 / _FREQUENCY), 0.25)


def _periodic_random(
    key: PRNGKeyArray, samples: int, dt: float, hold: int
) -> Float[Array, " time"]:
    size = _held(key, samples, hold, 0.0)
    return size * _square(key, samples, dt, hold)


def _varying_square(key: PRNGKeyArray, samples: int, dt: float, hold: int) -> Float[Array, " time"]:
    del hold
    low, high = _FREQUENCIES
    return _cycles(key, samples, dt, (1.0 / high, 1.0 / low), 0.25)


def _random(key: PRNGKeyArray, samples: int, dt: float, hold: int) -> Float[Array, " time"]:
    # As many levels as last about a second are freed of their mean together.
    block = max(round(1.0 / (hold * dt)), 2)
    levels = jax.random.uniform(key, (-(-samples // (hold * block)), block), float, -1.0, 1.0)
    balanced = levels - jnp.mean(levels, axis=1, keepdims=True)
    return jnp.repeat(balanced.ravel(), hold)[:samples]


_EXCITATIONS: dict[str, Callable[..., Array]] = {
    "square": _square,
    "periodic random": _periodic_random,
    "varying square": _varying_square,
    "random": _random,
}

_REFERENCES: dict[str, Callable[..., Array]] = {
    "square": lambda key, samples, dt: _cycles(key, samples, dt, (_PERIOD, _PERIOD), 0.0),
    "varying square": lambda key, samples, dt: _cycles(key, samples, dt, _PERIODS, 0.0),
}


def _of(name: str, choice: str, table: dict[str, Callable[..., Array]]) -> Callable[..., Array]:
    if choice not in table:
        raise ValueError(f"{name}={choice!r} is unknown: give one of {', '.join(table)}.")
    return table[choice]


def _samples(duration: float, rate: float) -> int:
    if not (duration > 0.0 and rate > 0.0 and round(duration * rate) >= 2):
        raise ValueError(
            f"duration={duration} s at rate={rate} Hz has fewer than two samples: raise them."
        )
    return round(duration * rate)
