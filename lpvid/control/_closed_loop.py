"""Closed loops in motion: a linear model or the single-link arm under a sampled controller."""

import math
from collections.abc import Sequence
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from lpvid._linalg import expm
from lpvid._results import Status
from lpvid.data import IOData
from lpvid.mechanics import (
    ArmEffects,
    InputDelay,
    Quantisation,
    SampledController,
    SingleLinkFlexibleArm,
    simulate_single_link,
)
from lpvid.models import StateSpace

# Plain lists of numbers are welcome where arrays are.
Numbers: TypeAlias = ArrayLike | Sequence

# A linear loop that has grown this far is held there: its cost and gradient stay finite.
_LARGEST = 1e9


class ClosedLoopMotion(eqx.Module):
    """A simulated closed loop, sampled.

    Attributes:
        reference: set-points (time, nr).
        u: command as the controller sent it, before saturation and delay (time, nu).
        y: outputs as the controller read them (time, ny).
        states: of the plant, at the samples (time, nx).
        status: `overflow` where an unstable linear loop grew beyond 1e9 and was held there,
            `nonfinite` where the arm's integrator diverged.
        dt: sample time, s; static.
    """

    reference: Float[Array, "*batch time nr"]
    u: Float[Array, "*batch time nu"]
    y: Float[Array, "*batch time ny"]
    states: Float[Array, "*batch time nx"]
    status: Status
    dt: float = eqx.field(static=True)

    @property
    def time(self) -> Float[Array, " time"]:
        """Times of the samples from the first one on, s."""
        return self.dt * jnp.arange(self.y.shape[-2], dtype=float)

    def data(self) -> IOData:
        """Commands and outputs as a record."""
        return IOData(u=self.u, y=self.y, dt=self.dt)


def simulate_closed_loop(
    plant: StateSpace | SingleLinkFlexibleArm,
    controller: SampledController,
    *,
    reference: Numbers,
    dt: float | None = None,
    x0: Numbers | None = None,
    saturation: ArrayLike | None = None,
    quantisation: Quantisation | None = None,
    delay: InputDelay | None = None,
    noise: Numbers | None = None,
    key: PRNGKeyArray | None = None,
    effects: ArmEffects | None = None,
    substeps: int = 8,
) -> ClosedLoopMotion:
    """Motion of a plant under a sampled controller.

    At every sample the outputs are read (noise, then quantisation), the controller takes its step,
    and its command (saturated, delayed) acts until the next sample. A continuous-time model moves
    exactly under the held command, at a delay of any fraction of a sample; a discrete-time one
    mixes the two commands of a broken sample in proportion. The arm is the nonlinear one of
    `lpvid.mechanics.simulate_single_link`, with its friction, backlash and the rest.

    A model with leading batch axes gives a motion with them. Payloads, set-points, gains and noise
    are batched by `jax.vmap` over arms, references, controllers and keys. Composes with jit and
    grad; quantisation has a gradient of zero, switches have none in their times.

    Args:
        plant: `StateSpace` without feedthrough, or `SingleLinkFlexibleArm`.
        controller: any `SampledController`.
        reference: set-points (time,) or (time, nr).
        dt: sample time, s; that of a discrete-time model when left out.
        x0: first state of a linear model (nx,); the arm starts from rest.
        saturation: commands act up to ± this; none by default.
        quantisation: of the outputs; none by default.
        delay: between command and plant; none by default.
        noise: standard deviation of white output noise, one number or (ny,); needs a key.
        key: random key of the noise.
        effects: of the arm; they may hold quantisation, delay and noise instead.
        substeps: of the arm's integrator, per sample.

    Returns:
        `ClosedLoopMotion`.

    Raises:
        ValueError: a reference or `x0` of another shape; no sample time; a model with feedthrough,
            whose output would depend on the command computed from it (not checked under `jit`,
            where the feedthrough is left out); noise without a key; a delay beyond its capacity;
            effects with a linear model, or an effect given twice.

    Source: 002, sections 4.1 to 4.4.

    Example:
        >>> from lpvid.mechanics import OpenLoop
        >>> lag = StateSpace([[0.5]], [[1.0]], [[1.0]], dt=0.1)
        >>> simulate_closed_loop(lag, OpenLoop(), reference=jnp.ones(3)).y[:, 0].tolist()
        [0.0, 1.0, 1.5]
    """
    reference = jnp.asarray(reference, float)
    reference = reference[:, None] if reference.ndim == 1 else reference
    if reference.ndim != 2 or not reference.shape[0]:
        raise ValueError(
            f"reference has shape {reference.shape}: give (time,) or (time, nr), and batches by "
            "jax.vmap."
        )
    if noise is not None and key is None:
        raise ValueError("key: output noise needs a random key, jax.random.key(seed).")
    if isinstance(plant, SingleLinkFlexibleArm):
        if dt is None:
            raise ValueError("dt: the arm moves in continuous time; give the sample time, s.")
        if x0 is not None:
            raise ValueError("x0: the arm starts from rest; leave it out.")
        given = {"quantisation": quantisation, "delay": delay, "noise": noise}
        effects = _arm_effects(plant, effects, saturation, given)
        motion = simulate_single_link(
            plant,
            reference=reference,
            dt=dt,
            controller=controller,
            effects=effects,
            key=key,
            substeps=substeps,
        )
        states = jnp.concatenate([motion.positions, motion.velocities], axis=-1)
        return ClosedLoopMotion(reference, motion.u, motion.y, states, motion.status, float(dt))
    if effects is not None:
        raise ValueError(
            "effects belong to the arm: give saturation, quantisation, delay or noise with a "
            "linear model."
        )
    return _linear_loop(
        plant, controller, reference, dt, x0, saturation, quantisation, delay, noise, key
    )


def sample_time(plant: StateSpace, dt: float | None) -> float:
    """The loop's sample time: that of a discrete-time model, or the one given.

    Raises:
        ValueError: none is known, or two that differ.
    """
    if plant.is_discrete:
        if dt is not None and not math.isclose(dt, plant.dt, rel_tol=1e-9):
            raise ValueError(
                f"dt is {dt} s, the model's sample time {plant.dt} s; leave dt out, or resample "
                "the model."
            )
        return plant.dt
    if dt is None or not dt > 0.0:
        raise ValueError(
            f"dt={dt}: the model is in continuous time; give the controller's sample time, s."
        )
    return float(dt)


def check_no_feedthrough(plant: StateSpace) -> None:
    """Refuse a model whose output depends on the command computed from it.

    Raises:
        ValueError: the model has a feedthrough (not checked under `jit`).
    """
    if not isinstance(plant.D, Tracer) and np.any(np.asarray(plant.D)):
        raise ValueError(
            "plant: the model has a feedthrough D, so its output would depend on the command that "
            "is computed from it; fit it with feedthrough=False."
        )


def _arm_effects(
    arm: SingleLinkFlexibleArm,
    effects: ArmEffects | None,
    saturation: ArrayLike | None,
    given: dict,
) -> ArmEffects:
    effects = ArmEffects() if effects is None else effects
    if saturation is not None:
        # The arm's limit is one of its current.
        given = given | {"current_limit": arm.current_gain * jnp.asarray(saturation, float)}
    given = {name: value for name, value in given.items() if value is not None}
    twice = [name for name in given if getattr(effects, name) is not None]
    if twice:
        raise ValueError(f"{twice[0]} is given twice, in effects too: leave one of them out.")
    return ArmEffects(**(vars(effects) | given))


def _linear_loop(
    plant, controller, reference, dt, x0, saturation, quantisation, delay, noise, key
) -> ClosedLoopMotion:
    dt = sample_time(plant, dt)
    check_no_feedthrough(plant)
    x0 = jnp.zeros(plant.nx) if x0 is None else jnp.asarray(x0, float)
    if x0.shape != (plant.nx,):
        raise ValueError(f"x0 has shape {x0.shape}; the model has {plant.nx} states.")
    if delay is not None and not isinstance(delay.seconds, Tracer):
        if float(delay.seconds) > (delay.capacity - 1) * dt:
            raise ValueError(
                f"delay of {delay.seconds} s is longer than {delay.capacity - 1} samples of "
                f"{dt} s: raise its capacity."
            )
    limit = None if saturation is None else jnp.asarray(saturation, float)
    errors = None
    if noise is not None:
        drawn = jax.random.normal(key, (reference.shape[0], plant.ny), float)
        errors = jnp.broadcast_to(jnp.asarray(noise, float), (plant.ny,))[None] * drawn

    def move(one: StateSpace) -> ClosedLoopMotion:
        return _simulate(one, controller, reference, x0, limit, quantisation, delay, errors, dt)

    for _ in plant.batch_shape:
        move = eqx.filter_vmap(move)
    return move(plant)


@eqx.filter_jit
def _simulate(
    plant: StateSpace,
    controller: SampledController,
    reference: Float[Array, "time nr"],
    x0: Float[Array, " nx"],
    limit: Array | None,
    quantisation: Quantisation | None,
    delay: InputDelay | None,
    errors: Float[Array, "time ny"] | None,
    dt: float,
) -> ClosedLoopMotion:
    late = jnp.zeros(()) if delay is None else delay.seconds / dt
    # Rounding must not send a delay of whole samples to the sample before.
    whole = jnp.floor(late + 1e-9)
    broken = jnp.maximum(late - whole, 0.0)
    A, older, newer = _inputs(plant, broken, dt)
    age = whole.astype(int)
    capacity = 1 if delay is None else delay.capacity + 1

    def sample(carry, now):
        x, memory, history = carry
        asked, error = now
        y = plant.C @ x
        y = y if error is None else y + error
        y = y if quantisation is None else quantisation(y)
        memory, command = controller.step(memory, asked, y)
        acting = command if limit is None else jnp.clip(command, -limit, limit)
        if delay is None:
            following = A @ x + newer @ acting
        else:
            history = jnp.concatenate([acting[None], history[:-1]])
            following = A @ x + newer @ history[age] + older @ history[age + 1]
        return (jnp.clip(following, -_LARGEST, _LARGEST), memory, history), (x, command, y)

    carry = (x0, controller.initial(), jnp.zeros((capacity, plant.nu)))
    _, (states, u, y) = jax.lax.scan(sample, carry, (reference, errors), unroll=4)
    size = jnp.max(jnp.abs(states))
    status = Status.where(size < _LARGEST, Status.successful, Status.overflow)
    status = Status.where(jnp.isfinite(size) & jnp.all(jnp.isfinite(u)), status, Status.nonfinite)
    return ClosedLoopMotion(reference, u, y, states, status, dt)


def _inputs(plant: StateSpace, broken: Array, dt: float) -> tuple[Array, Array, Array]:
    """Transition, and the inputs of a sample whose first share `broken` has the older command."""
    if plant.is_discrete:
        return plant.A, broken * plant.B, (1.0 - broken) * plant.B

    def held(duration):
        upper = jnp.concatenate([plant.A, plant.B], axis=1) * duration
        whole = expm(jnp.concatenate([upper, jnp.zeros((plant.nu, plant.nx + plant.nu))]))
        return whole[: plant.nx, : plant.nx], whole[: plant.nx, plant.nx :]

    _, first = held(broken * dt)
    rest, newer = held((1.0 - broken) * dt)
    return held(jnp.asarray(dt))[0], rest @ first, newer
