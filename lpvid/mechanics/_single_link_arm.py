"""Single-link flexible arm: hub, beam and payload, its drive and its four sensors."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from lpvid.mechanics._beam_modes import beam_tables, curvatures
from lpvid.mechanics._lagrangian import accelerations, inertia_matrix, linearise
from lpvid.models import StateSpace

SENSORS = ("hub angle", "base strain", "middle strain", "tachometer")
"""The arm's outputs, in this order, all in V."""

TRAVEL = float(np.deg2rad(80.0))
"""The hub's travel to either side, rad."""

_MAY_VANISH = ("payload_mass", "rotor_inertia", "viscous_friction", "damping_ratios")


def _floats(value: ArrayLike) -> Array:
    return jnp.asarray(value, float)


class SingleLinkFlexibleArm(eqx.Module):
    """A uniform beam clamped on a hub that a DC motor turns through a gear; horizontal plane.

    Coordinates q = [θ, η1 … ηn]: hub angle in rad and amplitudes in m of the clamped–free modes,
    deflection w(x) = Σ φ_i(x/ℓ) η_i with ∫φ_i² = 1. A point at x stands, in the hub's frame, at
    (x − ½∫₀ˣ w′², w): the shortening is the second-order term of the arc length. Input: the
    command in V, proportional to the motor's current. Outputs: hub angle, base and middle strain
    gauges, tachometer, all in V.

    The gear is rigid here and nothing is nonlinear but the geometry; `ArmEffects` adds friction,
    backlash and the rest in `simulate_single_link`. All methods compose with jit, vmap and grad,
    also with respect to the arm itself.

    Attributes:
        length: ℓ of the beam, m.
        linear_density: ρ, kg/m.
        bending_stiffness: EI, N·m².
        thickness: in the direction of bending, m (for the strain at the surface).
        damping_ratios: of the clamped–free modes (mode,); their number is the number of modes.
        payload_mass: point mass at the tip, kg.
        hub_inertia: hub and gear's output side, kg·m².
        rotor_inertia: motor and gear's input side, at the motor, kg·m².
        gear_ratio: motor turns per hub turn.
        torque_constant: of the motor, N·m/A.
        viscous_friction: of motor and gear, at the hub, N·m·s/rad.
        current_gain: motor current per command, A/V.
        angle_gain: V/rad.
        gauge_positions: of base and middle gauge (2,), m from the hub.
        gauge_gains: V per unit of surface strain (2,).
        tachometer_gain: V·s/rad at the hub.

    Raises:
        ValueError: a wrong shape, a number that is not positive (payload, rotor inertia, friction
            and damping may be zero), a gauge off the beam (values are checked only outside of jit).

    Source: 002, section 2.3.

    Example:
        >>> reference_single_link_arm().linearised().nx
        8
    """

    length: Float[Array, ""] = eqx.field(converter=_floats)
    linear_density: Float[Array, ""] = eqx.field(converter=_floats)
    bending_stiffness: Float[Array, ""] = eqx.field(converter=_floats)
    thickness: Float[Array, ""] = eqx.field(converter=_floats)
    damping_ratios: Float[Array, " mode"] = eqx.field(converter=_floats)
    payload_mass: Float[Array, ""] = eqx.field(converter=_floats)
    hub_inertia: Float[Array, ""] = eqx.field(converter=_floats)
    rotor_inertia: Float[Array, ""] = eqx.field(converter=_floats)
    gear_ratio: Float[Array, ""] = eqx.field(converter=_floats)
    torque_constant: Float[Array, ""] = eqx.field(converter=_floats)
    viscous_friction: Float[Array, ""] = eqx.field(converter=_floats)
    current_gain: Float[Array, ""] = eqx.field(converter=_floats)
    angle_gain: Float[Array, ""] = eqx.field(converter=_floats)
    gauge_positions: Float[Array, "2"] = eqx.field(converter=_floats)
    gauge_gains: Float[Array, "2"] = eqx.field(converter=_floats)
    tachometer_gain: Float[Array, ""] = eqx.field(converter=_floats)

    def __check_init__(self):
        shapes = {"gauge_positions": (2,), "gauge_gains": (2,)}
        if self.damping_ratios.ndim != 1 or self.damping_ratios.size < 1:
            raise ValueError(
                f"damping_ratios has shape {self.damping_ratios.shape}: give (mode,), one for each "
                "mode of the beam."
            )
        for name, value in vars(self).items():
            expected = value.shape if name == "damping_ratios" else shapes.get(name, ())
            if value.shape != expected:
                raise ValueError(f"{name} has shape {value.shape}: give shape {expected}.")
            if isinstance(value, Tracer):
                continue
            # NumPy, so that a constant arm can also be built inside of jit.
            numbers = np.asarray(value)
            if not np.all(numbers >= 0.0 if name in _MAY_VANISH else numbers > 0.0):
                sign = "non-negative" if name in _MAY_VANISH else "positive"
                raise ValueError(f"{name} is {value}: give {sign} numbers in SI units.")
        known = not any(isinstance(v, Tracer) for v in (self.gauge_positions, self.length))
        if known and np.any(np.asarray(self.gauge_positions) > np.asarray(self.length)):
            raise ValueError(
                f"gauge_positions={self.gauge_positions} lie off the beam of {self.length} m: "
                "give distances from the hub in m."
            )

    @property
    def n_modes(self) -> int:
        """Number of flexible modes."""
        return self.damping_ratios.shape[0]

    @property
    def drive_inertia(self) -> Float[Array, ""]:
        """Motor's inertia as the hub sees it, gear_ratio² · rotor_inertia, kg·m²."""
        return self.gear_ratio**2 * self.rotor_inertia

    @property
    def torque_per_ampere(self) -> Float[Array, ""]:
        """Hub torque of one ampere of motor current, N·m/A."""
        return self.gear_ratio * self.torque_constant

    def kinetic_energy(self, q: Float[Array, " dof"], qd: Float[Array, " dof"]) -> Float[Array, ""]:
        """Kinetic energy T(q, q̇) in J, its integral over the beam exact to rounding.

        Example:
            >>> arm = reference_single_link_arm()
            >>> rest = jnp.zeros(4)
            >>> arm.kinetic_energy(rest, rest.at[0].set(1.0))
            Array(0.07..., dtype=float64)
        """
        tables = beam_tables(self.n_modes)
        spin, deflection, rate = qd[0], q[1:], qd[1:]
        sideways = tables.shapes @ deflection
        bent = tables.shortening @ deflection / self.length
        place = self.length * tables.stations - 0.5 * bent @ deflection
        along = -(bent @ rate) - spin * sideways
        across = tables.shapes @ rate + spin * place
        beam_mass = self.linear_density * self.length * tables.weights
        mass = beam_mass.at[-1].set(self.payload_mass)
        inertia = self.hub_inertia + self.drive_inertia
        return 0.5 * (mass @ (along**2 + across**2) + inertia * spin**2)

    def potential_energy(self, q: Float[Array, " dof"]) -> Float[Array, ""]:
        """Bending energy ½ EI ∫ w″² dx = ½ Σ EI β_i⁴/ℓ³ η_i², in J.

        Example:
            >>> reference_single_link_arm().potential_energy(jnp.array([0.3, 0.1, 0.0, 0.0]))
            Array(0.488..., dtype=float64)
        """
        return 0.5 * self.modal_stiffnesses() @ q[1:] ** 2

    def modal_stiffnesses(self) -> Float[Array, " mode"]:
        """EI β_i⁴ / ℓ³ of the clamped–free modes, N/m; their mass is ρ ℓ each.

        Example:
            >>> reference_single_link_arm().modal_stiffnesses().shape
            (3,)
        """
        wave_numbers = jnp.asarray(beam_tables(self.n_modes).wave_numbers)
        return self.bending_stiffness / self.length**3 * wave_numbers**4

    def mass_matrix(self, q: Float[Array, " dof"]) -> Float[Array, "dof dof"]:
        """Mass matrix M(q), symmetric positive definite, from the kinetic energy.

        Example:
            >>> reference_single_link_arm().mass_matrix(jnp.zeros(4)).shape
            (4, 4)
        """
        return inertia_matrix(_kinetic, q, self)

    def natural_frequencies(self) -> Float[Array, " mode"]:
        """Undamped flexible modes of hub, beam and payload at rest, ascending, rad/s.

        Example:
            >>> reference_single_link_arm().natural_frequencies() / (2 * jnp.pi)
            Array([ 9.4..., 22.9..., 46.0...], dtype=float64)
        """
        factor = jnp.linalg.cholesky(self.mass_matrix(jnp.zeros(self.n_modes + 1)))
        stiffness = jnp.diag(jnp.append(jnp.zeros(1), self.modal_stiffnesses()))
        half = jax.scipy.linalg.solve_triangular(factor, stiffness, lower=True)
        whitened = jax.scipy.linalg.solve_triangular(factor, half.T, lower=True)
        return jnp.sqrt(jnp.linalg.eigvalsh(whitened)[1:])

    def dynamics(
        self, state: Float[Array, " state"], current: Float[Array, ""]
    ) -> Float[Array, " state"]:
        """State derivative, x = [q, q̇], input the motor current in A.

        Example:
            >>> reference_single_link_arm().dynamics(jnp.zeros(8), jnp.ones(())).shape
            (8,)
        """
        torque = self.torque_per_ampere * current
        return self.driven(state, torque - self.viscous_friction * state[self.n_modes + 1])

    def driven(
        self, state: Float[Array, " state"], torque: Float[Array, ""]
    ) -> Float[Array, " state"]:
        """State derivative under a torque at the hub in N·m, without the drive's friction.

        Example:
            >>> reference_single_link_arm().driven(jnp.zeros(8), jnp.ones(())).shape
            (8,)
        """
        dof = self.n_modes + 1
        q, qd = state[:dof], state[dof:]
        # Modal damping 2 ζ_i ω_i times the modal mass ρ ℓ.
        mass = self.linear_density * self.length
        damping = 2.0 * self.damping_ratios * jnp.sqrt(self.modal_stiffnesses() * mass)
        forces = jnp.concatenate([torque[None], -damping * qd[1:]])
        return jnp.concatenate([qd, accelerations(_kinetic, _potential, q, qd, forces, self)])

    def sensors(self, state: Float[Array, " state"]) -> Float[Array, "4"]:
        """Ideal sensor signals in V: hub angle, base strain, middle strain, tachometer.

        Example:
            >>> reference_single_link_arm().sensors(jnp.zeros(8).at[0].set(0.611))
            Array([3.0..., 0.        , 0.        , 0.        ], dtype=float64)
        """
        dof = self.n_modes + 1
        shapes = curvatures(self.n_modes, self.gauge_positions / self.length)
        strain = 0.5 * self.thickness / self.length**2 * (shapes @ state[1:dof])
        angle, speed = self.angle_gain * state[0], self.tachometer_gain * state[dof]
        return jnp.concatenate([angle[None], self.gauge_gains * strain, speed[None]])

    def tip_deflection(self, state: Float[Array, " state"]) -> Float[Array, ""]:
        """Deflection w(ℓ) of the tip from the hub's direction, m.

        Example:
            >>> reference_single_link_arm().tip_deflection(jnp.zeros(8).at[1].set(0.01))
            Array(0.02, dtype=float64)
        """
        return beam_tables(self.n_modes).shapes[-1] @ state[1 : self.n_modes + 1]

    def linearised(self, *, tip: bool = False) -> StateSpace:
        """Model of small motions at rest, states [θ, η, θ̇, η̇], exact by autodiff.

        One input, the command in V; outputs the four sensors in V and, with `tip`, the tip's
        deflection in m. Its pole at zero is the hub's angle. The same at every angle.

        Args:
            tip: whether the tip's deflection is a fifth output.

        Example:
            >>> reference_single_link_arm().linearised().poles().real.max() < 1e-9
            Array(True, dtype=bool)
        """
        return _linearised(self, tip)


def reference_single_link_arm(
    *, payload_mass: ArrayLike = 0.0, modes: int = 3
) -> SingleLinkFlexibleArm:
    """The arm of 002: aluminium 6061-T6, 1 m × 51 mm × 3 mm; modes near 9.5, 22.9 and 46.1 Hz.

    The scan gives the beam, 0.5 A/V and 3 V at 35°; the rest is chosen: hub and motor for modes
    near 9, 25 and 48 Hz, motor and friction such that the experiments of 002 stay inside ±80°.

    Args:
        payload_mass: at the tip, kg (002: 0, 0.2, 0.3, 0.4).
        modes: number of flexible modes.

    Returns:
        The `SingleLinkFlexibleArm`.

    Raises:
        ValueError: `modes` is below one or the payload is negative.

    Example:
        >>> reference_single_link_arm(payload_mass=0.2, modes=4).n_modes
        4
    """
    if modes < 1:
        raise ValueError(f"modes={modes} must be at least 1: three are visible in the records.")
    width, thickness = 0.051, 0.003
    return SingleLinkFlexibleArm(
        length=1.0,
        linear_density=2700.0 * width * thickness,
        bending_stiffness=68.9e9 * width * thickness**3 / 12.0,
        thickness=thickness,
        damping_ratios=jnp.full(modes, 0.005),
        payload_mass=payload_mass,
        hub_inertia=0.0015,
        rotor_inertia=2e-5,
        gear_ratio=10.0,
        torque_constant=0.03,
        viscous_friction=0.12,
        current_gain=0.5,
        angle_gain=3.0 / np.deg2rad(35.0),
        gauge_positions=jnp.array([0.02, 0.5]),
        gauge_gains=jnp.array([2e4, 2e4]),
        tachometer_gain=1.0,
    )


@eqx.filter_jit
def _linearised(arm: SingleLinkFlexibleArm, tip: bool) -> StateSpace:
    def output(state, command):
        del command
        signals = arm.sensors(state)
        return jnp.append(signals, arm.tip_deflection(state)) if tip else signals

    return linearise(
        lambda state, command: arm.dynamics(state, arm.current_gain * command[0]),
        output,
        jnp.zeros(2 * (arm.n_modes + 1)),
        jnp.zeros(1),
    )


def _kinetic(q, qd, arm):
    return arm.kinetic_energy(q, qd)


def _potential(q, arm):
    return arm.potential_energy(q)
