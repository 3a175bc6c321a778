"""The single-link arm in motion: a sampling computer around a continuous plant with its effects."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from lpvid._results import Status
from lpvid.data import IOData
from lpvid.mechanics._sampled_control import OpenLoop, SampledController
from lpvid.mechanics._single_link_arm import SENSORS, TRAVEL, SingleLinkFlexibleArm
from lpvid.mechanics._single_link_effects import (
    ArmEffects,
    DryFriction,
    InputDelay,
    backlash_dynamics,
)
from lpvid.models import runge_kutta_step


class SingleLinkMotion(eqx.Module):
    """A simulated motion of the single-link arm, sampled.

    Attributes:
        u: command of the computer (time, 1), V.
        y: sensors as the computer reads them (time, 4), V: hub angle, base and middle strain,
            tachometer.
        positions: q = [θ, η] (time, dof), rad and m.
        velocities: q̇ (time, dof).
        tip_deflection: (time,), m.
        largest_angle: of the hub over the record, rad; the arm of 002 has ±80°.
        status: `nonfinite` where the integrator diverged: raise `substeps`.
    """

    u: Float[Array, "time 1"]
    y: Float[Array, "time 4"]
    positions: Float[Array, "time dof"]
    velocities: Float[Array, "time dof"]
    tip_deflection: Float[Array, " time"]
    largest_angle: Float[Array, ""]
    status: Status

    def data(self, dt: float) -> IOData:
        """Command and sensors as a record, named and with units.

        Args:
            dt: sample time of the simulation, s.

        Raises:
            ValueError: the integrator diverged.

        Warns:
            UserWarning: the hub left its ±80°, where the arm of 002 would have hit its stop.
        """
        angle = self.largest_angle
        if not isinstance(angle, Tracer) and self.status == Status.nonfinite:
            raise ValueError(
                "substeps: the integrator diverged, its steps are too long for the fastest mode; "
                "raise substeps, or take fewer modes."
            )
        if not isinstance(angle, Tracer) and float(angle) > TRAVEL:
            warnings.warn(
                f"The hub turned to {np.rad2deg(float(angle)):.0f}°, beyond its travel of ±80°: "
                "lower the amplitude or raise the frequency.",
                stacklevel=3,
            )
        return IOData(
            u=self.u,
            y=self.y,
            dt=dt,
            names={"u": "command", "y": SENSORS},
            units={"u": "V", "y": ("V",) * 4},
        )


def simulate_single_link(
    arm: SingleLinkFlexibleArm,
    *,
    reference: ArrayLike,
    dt: float,
    controller: SampledController | None = None,
    effects: ArmEffects | None = None,
    key: PRNGKeyArray | None = None,
    start_angle: ArrayLike = 0.0,
    substeps: int = 8,
) -> SingleLinkMotion:
    """Motion of the arm from rest under a sampled controller, or under given commands.

    At every sample the sensors are read (offset, drift, noise, quantisation), the controller takes
    its step, and its command is held until the next sample while the plant moves in `substeps`
    Runge–Kutta steps. Delay, current limit and friction act within them.

    Composes with jit, vmap (arms, controllers, effects, references and keys of one structure) and
    grad. The gradient is that of the simulated motion where no switch changes: quantisation has a
    gradient of zero, a bounded position none in its switching times, and dry friction one that
    holds while no step passes between sticking and sliding. Reverse mode keeps one state per
    sample.

    Args:
        arm: the arm.
        reference: (time,) or (time, nr) for the controller; without one the command in V.
        dt: sample time, s (002: 1/300 or 1/500).
        controller: `None` for open loop.
        effects: none by default.
        key: random key of the sensor noise, needed with `effects.noise`.
        start_angle: of the hub, rad.
        substeps: integrator's steps per sample. The default serves three or four modes at 300 Hz;
            more modes and stiffer contacts need more.

    Returns:
        `SingleLinkMotion`: each sample before its command acts.

    Raises:
        ValueError: a reference of another shape, `dt` not positive, `substeps` below one, noise
            without a key, a delay longer than its capacity, backlash and a rotor without inertia.

    Example:
        >>> from lpvid.mechanics import reference_single_link_arm
        >>> push = jnp.ones(30)
        >>> simulate_single_link(reference_single_link_arm(), reference=push, dt=1 / 300).y.shape
        (30, 4)
    """
    reference = jnp.asarray(reference, float)
    reference = reference[:, None] if reference.ndim == 1 else reference
    if reference.ndim != 2 or not reference.shape[0]:
        raise ValueError(f"reference has shape {reference.shape}: give (time,) or (time, nr).")
    if not isinstance(dt, Tracer) and not dt > 0.0:
        raise ValueError(f"dt={dt} must be positive: give the sample time in seconds.")
    if substeps < 1:
        raise ValueError(f"substeps={substeps} must be at least 1.")
    effects = ArmEffects() if effects is None else effects
    if effects.noise is not None and key is None:
        raise ValueError("key: sensor noise needs a random key, jax.random.key(seed).")
    _check_delay(effects.delay, dt)
    if effects.backlash is not None and _is_zero(arm.rotor_inertia):
        raise ValueError(
            "arm: its rotor_inertia is zero, but with backlash the rotor moves on its own; give it "
            "an inertia, or leave the backlash out."
        )
    controller = OpenLoop() if controller is None else controller
    start_angle = jnp.asarray(start_angle, float)
    return _simulate(
        arm, controller, effects, reference, jnp.asarray(dt), start_angle, key, substeps
    )


def _is_zero(value: Array) -> bool:
    return not isinstance(value, Tracer) and bool(np.any(np.asarray(value) == 0.0))


@eqx.filter_jit
def _simulate(arm, controller, effects, reference, dt, start_angle, key, substeps):
    dof = arm.n_modes + 1
    samples = reference.shape[0]
    step = dt / substeps
    start = jnp.zeros(2 * dof).at[0].set(start_angle)
    drive = dof
    dynamics = arm.dynamics
    if effects.backlash is not None:
        start = jnp.concatenate([start, jnp.stack([start_angle, jnp.zeros(())])])
        drive = 2 * dof + 1

        def dynamics(state, current):
            return backlash_dynamics(arm, effects.backlash, state, current)

    disturbance = _sensor_errors(effects, samples, dt, key)
    capacity = 1 if effects.delay is None else effects.delay.capacity

    def sample(carry, now):
        state, memory, history = carry
        asked, error = now
        y = arm.sensors(state[: 2 * dof]) + error
        if effects.quantisation is not None:
            y = effects.quantisation(y)
        memory, command = controller.step(memory, asked, y)
        history = jnp.concatenate([command, history[:-1]])

        def substep(state, number):
            current = arm.current_gain * _delayed(effects.delay, history, number, dt, substeps)
            if effects.current_limit is not None:
                current = jnp.clip(current, -effects.current_limit, effects.current_limit)
            if effects.friction is not None:
                current = current - _friction(
                    effects.friction, dynamics, state, current, drive, step
                )
            return runge_kutta_step(dynamics, state, current, step), None

        following, _ = jax.lax.scan(substep, state, jnp.arange(substeps))
        return (following, memory, history), (state[: 2 * dof], command, y)

    carry = (start, controller.initial(), jnp.zeros(capacity))
    _, (states, u, y) = jax.lax.scan(jax.checkpoint(sample), carry, (reference, disturbance))
    finite = jnp.all(jnp.isfinite(states)) & jnp.all(jnp.isfinite(u))
    return SingleLinkMotion(
        u=u,
        y=y,
        positions=states[:, :dof],
        velocities=states[:, dof:],
        tip_deflection=jax.vmap(arm.tip_deflection)(states),
        largest_angle=jnp.max(jnp.abs(states[:, 0])),
        status=Status.where(finite, Status.successful, Status.nonfinite),
    )


def _friction(
    friction: DryFriction, dynamics, state: Array, current: Array, drive: int, step: Array
) -> Array:
    """Mean friction over a step, in A: against the motion until it stops, then what holds it.

    As if the drive's acceleration were that at the step's start, plus what friction adds.
    """
    slope, gain = jax.jvp(lambda i: dynamics(state, i)[drive], (current,), (jnp.ones(()),))
    speed = state[drive]
    level = friction.level(speed)
    sliding = level * jnp.sign(speed)
    change = step * (slope - gain * sliding)
    stops = speed * (speed + change) < 0.0
    # The share of the step for which it slides; the inner `where` keeps gradients finite.
    share = jnp.where(stops, -speed / jnp.where(stops, change, 1.0), jnp.abs(jnp.sign(speed)))
    held = jnp.clip(slope / gain, -level, level)
    return share * sliding + (1.0 - share) * held


def _delayed(delay: InputDelay | None, history: Array, number: Array, dt: Array, substeps: int):
    """Mean of the delayed command over one substep; `history[k]` is k samples old."""
    if delay is None:
        return history[0]
    # In samples from the present one's start: where the substep begins and ends after the delay.
    begin = number / substeps - delay.seconds / dt
    end = begin + 1.0 / substeps
    # Rounding must not send an exact multiple of the substep to the sample before.
    held = jnp.floor(begin + 1e-9)
    newer = jnp.clip((end - held - 1.0) * substeps, 0.0, 1.0)
    age = -held.astype(int)
    return (1.0 - newer) * history[age] + newer * history[jnp.maximum(age - 1, 0)]


def _sensor_errors(
    effects: ArmEffects, samples: int, dt: Array, key: PRNGKeyArray | None
) -> Float[Array, "time 4"]:
    error = jnp.zeros((samples, 4))
    if effects.sensor_offset is not None:
        error = error + effects.sensor_offset[None]
    if effects.sensor_drift is not None:
        error = error + dt * jnp.arange(samples, dtype=float)[:, None] * effects.sensor_drift[None]
    if effects.noise is not None and key is not None:
        error = error + effects.noise[None] * jax.random.normal(key, (samples, 4), float)
    return error


def _check_delay(delay: InputDelay | None, dt: float) -> None:
    if delay is None or isinstance(delay.seconds, Tracer) or isinstance(dt, Tracer):
        return
    if np.any(np.asarray(delay.seconds) > (delay.capacity - 1) * dt):
        raise ValueError(
            f"delay of {delay.seconds} s is longer than {delay.capacity - 1} samples of {dt} s: "
            "raise its capacity."
        )
