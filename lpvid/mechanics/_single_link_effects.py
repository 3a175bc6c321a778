"""What the single-link arm has beside its linear model: each effect an object, none on by default.

The laws are sharp ones, for truth to identify; fitting uses smooth ones elsewhere.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from lpvid.mechanics._single_link_arm import SingleLinkFlexibleArm


def _floats(value: ArrayLike) -> Array:
    return jnp.asarray(value, float)


def _optional(value: ArrayLike | None) -> Array | None:
    return None if value is None else _floats(value)


def _channels(value: ArrayLike | None) -> Array | None:
    # One number for all sensors, or one for each.
    return None if value is None else jnp.broadcast_to(_floats(value), (4,))


class DryFriction(eqx.Module):
    """Coulomb friction with the Stribeck effect, in amperes of motor current.

    Level F(v) = coulomb + (breakaway − coulomb) exp(−(v/stribeck_speed)²) against the drive's
    motion; at rest whatever holds the drive, up to the breakaway level. It really sticks: within
    every integrator's step the drive slides until it would stop, and from there on it is held if
    the level suffices. A held drive does not creep; its speed is zero to second order in the step.

    Attributes:
        coulomb: at speed, A (002: about 0.4).
        breakaway: at rest, A; `coulomb` by default.
        stribeck_speed: of the drive, at the hub, rad/s.

    Example:
        >>> DryFriction(0.4, breakaway=0.5).level(jnp.array([0.0, 1.0]))
        Array([0.5, 0.4], dtype=float64)
    """

    coulomb: Float[Array, ""]
    breakaway: Float[Array, ""]
    stribeck_speed: Float[Array, ""]

    def __init__(
        self,
        coulomb: ArrayLike = 0.4,
        *,
        breakaway: ArrayLike | None = None,
        stribeck_speed: ArrayLike = 0.05,
    ):
        self.coulomb = _floats(coulomb)
        self.breakaway = self.coulomb if breakaway is None else _floats(breakaway)
        self.stribeck_speed = _floats(stribeck_speed)
        _check(self, may_vanish=("coulomb", "breakaway"))

    def level(self, speed: Float[Array, "..."]) -> Float[Array, "..."]:
        """Largest friction at a speed in rad/s, A."""
        share = jnp.exp(-((speed / self.stribeck_speed) ** 2))
        return self.coulomb + (self.breakaway - self.coulomb) * share


class Backlash(eqx.Module):
    """Play between motor and hub: free inside the gap, a stiff and damped contact at its ends.

    The motor becomes a coordinate of its own, with its inertia and all of the drive's friction; the
    contact only pushes. At the default contact the mesh rings at about 100 Hz.

    Attributes:
        gap: whole play at the hub, rad.
        stiffness: of the contact, at the hub, N·m/rad.
        damping: of the contact, at the hub, N·m·s/rad.

    Example:
        >>> Backlash(0.01).torque(jnp.array([0.004, 0.006]), jnp.zeros(2))
        Array([0. , 0.5], dtype=float64)
    """

    gap: Float[Array, ""]
    stiffness: Float[Array, ""]
    damping: Float[Array, ""]

    def __init__(
        self, gap: ArrayLike = 0.01, *, stiffness: ArrayLike = 500.0, damping: ArrayLike = 0.3
    ):
        self.gap, self.stiffness, self.damping = _floats(gap), _floats(stiffness), _floats(damping)
        _check(self, may_vanish=("gap", "damping"))

    def torque(self, twist: Float[Array, "..."], rate: Float[Array, "..."]) -> Float[Array, "..."]:
        """Torque on the hub for motor ahead of hub by `twist` rad at `rate` rad/s, N·m."""
        side = jnp.sign(twist)
        depth = jnp.abs(twist) - 0.5 * self.gap
        push = jnp.maximum(self.stiffness * depth + self.damping * side * rate, 0.0)
        return jnp.where(depth > 0.0, side * push, 0.0)


class InputDelay(eqx.Module):
    """Delay between command and current, of any fraction of a sample.

    Attributes:
        seconds: the delay.
        capacity: longest delay that is stored, in samples, plus one; static.

    Example:
        >>> InputDelay(0.005).capacity
        16
    """

    seconds: Float[Array, ""]
    capacity: int = eqx.field(static=True)

    def __init__(self, seconds: ArrayLike, *, capacity: int = 16):
        self.seconds, self.capacity = _floats(seconds), capacity
        _check(self, may_vanish=("seconds",))


class Quantisation(eqx.Module):
    """Analogue-to-digital conversion: rounded to steps and cut to a symmetric range.

    Its gradient is zero.

    Attributes:
        bits: of the converter; static.
        full_scale: the range is ±full_scale, V; static.

    Example:
        >>> Quantisation().step
        0.0048828125
    """

    bits: int = eqx.field(static=True, default=12)
    full_scale: float = eqx.field(static=True, default=10.0)

    def __check_init__(self):
        if self.bits < 1 or not self.full_scale > 0.0:
            raise ValueError(
                f"bits={self.bits} and full_scale={self.full_scale} must be positive: 12 bits over "
                "±10 V in 002."
            )

    @property
    def step(self) -> float:
        """Width of one step, V."""
        return 2.0 * self.full_scale / 2**self.bits

    def __call__(self, y: Float[Array, "..."]) -> Float[Array, "..."]:
        """The numbers that the computer reads."""
        rounded = self.step * jnp.round(y / self.step)
        return jnp.clip(rounded, -self.full_scale, self.full_scale - self.step)


class ArmEffects(eqx.Module):
    """Which effects a simulation has; all are off by default.

    Attributes:
        friction: of the drive.
        backlash: of the gear.
        current_limit: the current is cut to ±this, A (002: 5).
        delay: of the input.
        sensor_offset: added to the sensors, V: one number or (4,).
        sensor_drift: added to the sensors, V/s: one number or (4,).
        noise: standard deviation of white sensor noise, V: one number or (4,); needs a key.
        quantisation: of the sensors, last of all.

    Raises:
        ValueError: a negative level (checked only outside of jit).

    Source: 002, sections 2.3 and 2.4.

    Example:
        >>> ArmEffects(friction=DryFriction(0.4), quantisation=Quantisation()).backlash is None
        True
    """

    friction: DryFriction | None = None
    backlash: Backlash | None = None
    current_limit: Float[Array, ""] | None = eqx.field(default=None, converter=_optional)
    delay: InputDelay | None = None
    sensor_offset: Float[Array, "4"] | None = eqx.field(default=None, converter=_channels)
    sensor_drift: Float[Array, "4"] | None = eqx.field(default=None, converter=_channels)
    noise: Float[Array, "4"] | None = eqx.field(default=None, converter=_channels)
    quantisation: Quantisation | None = None

    def __check_init__(self):
        for name in ("current_limit", "noise"):
            value = getattr(self, name)
            if value is None or isinstance(value, Tracer):
                continue
            if not np.all(np.asarray(value) >= 0.0):
                raise ValueError(f"{name} is {value}: give numbers of at least zero.")


def backlash_dynamics(
    arm: SingleLinkFlexibleArm,
    backlash: Backlash,
    state: Float[Array, " state"],
    current: Float[Array, ""],
) -> Float[Array, " state"]:
    """State derivative with the motor loose, x = [q, q̇, ψ, ψ̇], ψ the motor's angle at the hub."""
    free = eqx.tree_at(lambda a: a.rotor_inertia, arm, jnp.zeros(()))
    hub, (angle, speed) = state[:-2], state[-2:]
    contact = backlash.torque(angle - hub[0], speed - hub[arm.n_modes + 1])
    driving = arm.torque_per_ampere * current - arm.viscous_friction * speed - contact
    motor = jnp.stack([speed, driving / arm.drive_inertia])
    return jnp.concatenate([free.driven(hub, contact), motor])


def _check(effect: eqx.Module, *, may_vanish: tuple[str, ...]) -> None:
    kind = type(effect).__name__
    for name, value in vars(effect).items():
        if not isinstance(value, Array) or isinstance(value, Tracer):
            continue
        if value.ndim:
            raise ValueError(f"{kind}: {name} has shape {value.shape}: give one number.")
        if not (value >= 0.0 if name in may_vanish else value > 0.0):
            sign = "at least zero" if name in may_vanish else "positive"
            raise ValueError(f"{kind}: {name} is {value}; it must be {sign}.")
