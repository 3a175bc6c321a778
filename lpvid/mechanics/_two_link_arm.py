"""Two-link flexible arm in a horizontal plane (Vizer et al. 2015, section 3).

Coordinates q = [θ1, θ2, v1, v2]: joint angles and one assumed mode a segment. A point at x on
segment k stands in the segment's own frame at (x − ⅔ x³ v_k², x² v_k); the shortening ⅔ x³ v_k² is
the second-order term of the arc length. Segment 1 is turned by θ1, segment 2 starts at its tip and
is turned by θ12 = θ1 + θ2 + 2 ℓ1 v1.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from lpvid._results import Status
from lpvid.mechanics._lagrangian import accelerations, inertia_matrix, integrate, linearise
from lpvid.models import StateSpace

# The squared velocity of a segment's point is a polynomial of degree 6 in x: four Gauss–Legendre
# nodes are exact up to degree 7.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)
_WEIGHTS = _WEIGHTS / 2.0
# Where a segment has mass, as a share of its length: the nodes, and the lumped mass at its tip.
_STATIONS = np.append((_NODES + 1.0) / 2.0, 1.0)


def _floats(values: ArrayLike | Sequence[float]) -> Array:
    return jnp.asarray(values, float)


class ArmMotion(eqx.Module):
    """A simulated motion of the arm, sampled.

    Attributes:
        y: joint velocities of the rigid arm with the same end-effector motion (time, 2), rad/s.
        positions: q = [θ1, θ2, v1, v2] (time, 4), rad and 1/m.
        velocities: q̇ (time, 4).
        status: `nonfinite` where the integrator diverged or the end effector left the reach of the
            rigid arm; raise `substeps` or lower the reference.
    """

    y: Float[Array, "time 2"]
    positions: Float[Array, "time 4"]
    velocities: Float[Array, "time 4"]
    status: Status


class TwoLinkFlexibleArm(eqx.Module):
    """Two flexible segments, two driven joints, local velocity loops, a payload at the tip.

    Attributes:
        link_lengths: ℓ (2,), m.
        linear_densities: ρ (2,), kg/m.
        bending_stiffnesses: EI (2,), N·m².
        hub_inertias: J (2,), kg·m².
        joint_mass: m_j of the second joint, at segment 1's tip, kg.
        payload_mass: m_p at segment 2's tip, kg.
        velocity_gains: Λ = diag(λ1, λ2) of the loops u = Λ(θ̇* − θ̇) (2,), N·m·s/rad.

    All methods compose with jit, vmap and grad, also with respect to the arm itself.

    Raises:
        ValueError: if a length, density, stiffness or hub inertia is not positive or a mass or a
            gain is negative (checked only outside of jit).

    Example:
        >>> reference_two_link_arm().linearised(jnp.pi / 2).nx
        6
    """

    link_lengths: Float[Array, "2"] = eqx.field(converter=_floats)
    linear_densities: Float[Array, "2"] = eqx.field(converter=_floats)
    bending_stiffnesses: Float[Array, "2"] = eqx.field(converter=_floats)
    hub_inertias: Float[Array, "2"] = eqx.field(converter=_floats)
    joint_mass: Float[Array, ""] = eqx.field(converter=_floats)
    payload_mass: Float[Array, ""] = eqx.field(converter=_floats)
    velocity_gains: Float[Array, "2"] = eqx.field(converter=_floats)

    def __check_init__(self):
        may_vanish = ("joint_mass", "payload_mass", "velocity_gains")
        for name, value in vars(self).items():
            expected = () if name in ("joint_mass", "payload_mass") else (2,)
            if value.shape != expected:
                raise ValueError(f"{name} has shape {value.shape}: give shape {expected}.")
            if isinstance(value, Tracer):
                continue
            # NumPy, so that a constant arm can also be built inside of jit.
            numbers = np.asarray(value)
            if not np.all(numbers >= 0.0 if name in may_vanish else numbers > 0.0):
                sign = "non-negative" if name in may_vanish else "positive"
                raise ValueError(f"{name} is {value}: give {sign} numbers in SI units.")

    def kinetic_energy(self, q: Float[Array, "4"], qd: Float[Array, "4"]) -> Float[Array, ""]:
        """Kinetic energy T(q, q̇) in J, the integrals over the segments exact.

        Example:
            >>> reference_two_link_arm().kinetic_energy(jnp.zeros(4), jnp.array([1.0, 0, 0, 0]))
            Array(0.15836..., dtype=float64)
        """
        first, second = self.link_lengths
        # Velocities in each segment's own frame, so that θ1 drops out by construction.
        turn, spin1 = q[1] + 2.0 * first * q[2], qd[0]
        spin2 = spin1 + qd[1] + 2.0 * first * qd[2]
        along1, across1 = _point_velocities(first * _STATIONS, q[2], qd[2], spin1)
        along2, across2 = _point_velocities(second * _STATIONS, q[3], qd[3], spin2)
        cosine, sine = jnp.cos(turn), jnp.sin(turn)
        along2 = along2 + (cosine * along1[-1] + sine * across1[-1])
        across2 = across2 + (cosine * across1[-1] - sine * along1[-1])
        masses = self.linear_densities * self.link_lengths
        masses1 = jnp.append(masses[0] * _WEIGHTS, self.joint_mass)
        masses2 = jnp.append(masses[1] * _WEIGHTS, self.payload_mass)
        return 0.5 * (
            masses1 @ (along1**2 + across1**2)
            + masses2 @ (along2**2 + across2**2)
            + self.hub_inertias[0] * spin1**2
            + self.hub_inertias[1] * spin2**2
        )

    def potential_energy(self, q: Float[Array, "4"]) -> Float[Array, ""]:
        """Bending energy V = Σ 2 EI_k ℓ_k v_k² in J (from ½ ∫ EI (∂²δ/∂x²)² dx, δ = x² v).

        Example:
            >>> reference_two_link_arm().potential_energy(jnp.array([0.0, 1.0, 0.1, 0.0]))
            Array(0.28, dtype=float64)
        """
        return 2.0 * jnp.sum(self.bending_stiffnesses * self.link_lengths * q[2:] ** 2)

    def mass_matrix(self, q: Float[Array, "4"]) -> Float[Array, "4 4"]:
        """Mass matrix M(q), symmetric positive definite, from the kinetic energy.

        Example:
            >>> reference_two_link_arm().mass_matrix(jnp.array([0.0, 1.0, 0.0, 0.0])).shape
            (4, 4)
        """
        return inertia_matrix(_kinetic, q, self)

    def stiffness_matrix(self) -> Float[Array, "4 4"]:
        """Stiffness at rest, ∂²V/∂q² = diag(0, 0, 4 EI1 ℓ1, 4 EI2 ℓ2).

        Example:
            >>> reference_two_link_arm().stiffness_matrix()[2, 2]
            Array(56., dtype=float64)
        """
        return jnp.diag(
            jnp.concatenate([jnp.zeros(2), 4.0 * self.bending_stiffnesses * self.link_lengths])
        )

    def end_effector(self, q: Float[Array, "4"]) -> Float[Array, "2"]:
        """Position z(q) of the payload in the plane, m (equation 28, its v³ corrected to v²).

        Example:
            >>> reference_two_link_arm().end_effector(jnp.zeros(4))
            Array([0.65, 0.  ], dtype=float64)
        """
        theta1, theta2, v1, v2 = q
        first, second = self.link_lengths
        tip1 = _turned(theta1, _point(first, v1))
        return tip1 + _turned(theta1 + theta2 + 2.0 * first * v1, _point(second, v2))

    def rigid_inverse_kinematics(self, z: Float[Array, "2"]) -> Float[Array, "2"]:
        """Joint angles θr of the rigid arm that reaches z, elbow branch 0 < θ2 < π.

        NaN where z is out of reach; the gradient is infinite at the branch's ends.

        Example:
            >>> arm = reference_two_link_arm()
            >>> arm.rigid_inverse_kinematics(arm.end_effector(jnp.array([0.3, 1.2, 0.0, 0.0])))
            Array([0.3, 1.2], dtype=float64)
        """
        first, second = self.link_lengths
        cosine = (z @ z - first**2 - second**2) / (2.0 * first * second)
        # Factored: 1 − cos² alone loses half of the digits near the branch's ends.
        sine = jnp.sqrt((1.0 - cosine) * (1.0 + cosine))
        bearing = jnp.arctan2(z[1], z[0])
        theta1 = bearing - jnp.arctan2(second * sine, first + second * cosine)
        return jnp.stack([theta1, jnp.arctan2(sine, cosine)])

    def joint_velocities(self, q: Float[Array, "4"], qd: Float[Array, "4"]) -> Float[Array, "2"]:
        """Output y = J(θr)⁻¹ ż: joint velocities of the rigid arm with the same tip motion, rad/s.

        Example:
            >>> rates = jnp.array([0.1, 0.2, 0.0, 0.0])
            >>> reference_two_link_arm().joint_velocities(jnp.array([0.0, 1.0, 0.0, 0.0]), rates)
            Array([0.1, 0.2], dtype=float64)
        """
        z, zd = jax.jvp(self.end_effector, (q,), (qd,))
        theta1, theta2 = self.rigid_inverse_kinematics(z)
        first, second = self.link_lengths
        # J⁻¹ in closed form: ż is projected on segment 2 (free of θ̇2) and on z (free of θ̇1).
        along2 = jnp.stack([jnp.cos(theta1 + theta2), jnp.sin(theta1 + theta2)])
        rate1 = (along2 @ zd) / (first * jnp.sin(theta2))
        rate2 = -(z @ zd) / (first * second * jnp.sin(theta2))
        return jnp.stack([rate1, rate2])

    def dynamics(self, state: Float[Array, "8"], reference: Float[Array, "2"]) -> Float[Array, "8"]:
        """State derivative of the arm under its velocity loops, x = [q, q̇], input θ̇*.

        Example:
            >>> reference_two_link_arm().dynamics(jnp.ones(8), jnp.ones(2)).shape
            (8,)
        """
        q, qd = state[:4], state[4:]
        torques = self.velocity_gains * (reference - qd[:2])
        forces = jnp.concatenate([torques, jnp.zeros(2)])
        return jnp.concatenate([qd, accelerations(_kinetic, _potential, q, qd, forces, self)])

    def simulate(
        self,
        *,
        reference: ArrayLike,
        dt: ArrayLike,
        theta2_start: ArrayLike,
        theta1_start: ArrayLike = 0.0,
        substeps: int = 1,
        every: int = 1,
    ) -> ArmMotion:
        """Nonlinear motion from rest under joint velocity references held over each sample.

        Args:
            reference: θ̇* (time, 2), rad/s.
            dt: sample time of the reference, s.
            theta2_start: second joint's angle at the start, in (0, π), rad.
            theta1_start: first joint's angle at the start, rad.
            substeps: Runge–Kutta steps per sample; at dt = 1e-4 s one is enough for the reference
                arm (fastest pole −727/s, at θ2 = π/8).
            every: keep every `every`-th sample.

        Returns:
            `ArmMotion` at samples 0, every, 2·every, …

        Raises:
            ValueError: if `reference` is not (time, 2), `dt` is not positive, `theta2_start` lies
                outside of (0, π) or `every` does not divide the number of samples.

        Example:
            >>> arm = reference_two_link_arm()
            >>> motion = arm.simulate(reference=jnp.ones((20, 2)), dt=1e-4, theta2_start=1.0)
            >>> motion.y.shape
            (20, 2)
        """
        reference, dt = _floats(reference), _floats(dt)
        theta1_start = _floats(theta1_start)
        theta2_start = _angle_inside(theta2_start, "theta2_start")
        if reference.ndim != 2 or reference.shape[1] != 2:
            raise ValueError(f"reference has shape {reference.shape}: give (time, 2).")
        if not isinstance(dt, Tracer) and not np.asarray(dt) > 0.0:
            raise ValueError(f"dt={dt} must be positive: give the sample time in seconds.")
        return _simulate(self, reference, dt, theta1_start, theta2_start, substeps, every)

    def linearised(self, theta2: ArrayLike) -> StateSpace:
        """Local model at rest at θ2, states [v1, v2, θ̇1, θ̇2, v̇1, v̇2] (equations 30–32).

        Exact, by autodiff of the nonlinear arm; the angles are dropped, because at rest nothing
        depends on them. Scheduling variable κ = cos θ2.

        Raises:
            ValueError: if `theta2` is not one angle in (0, π).

        Example:
            >>> reference_two_link_arm().linearised(jnp.pi / 2).poles().real.max()
            Array(-21.55..., dtype=float64)
        """
        return _linearised(self, _angle_inside(theta2, "theta2"))

    def structured_parameters(self, theta2: ArrayLike) -> Float[Array, "16"]:
        """ϑ1…ϑ16 of equation 32 at θ2: A[2:6, 0:4] by columns, from M⁻¹, stiffness and gains.

        Raises:
            ValueError: if `theta2` is not one angle in (0, π).

        Example:
            >>> reference_two_link_arm().structured_parameters(jnp.pi / 2).shape
            (16,)
        """
        return _structured_parameters(self, _angle_inside(theta2, "theta2"))


def reference_two_link_arm() -> TwoLinkFlexibleArm:
    """The reference arm: 0.35 m and 0.30 m segments, 300 g payload, poles at −698/s … −22 ± 31j.

    Example:
        >>> reference_two_link_arm().payload_mass
        Array(0.3, dtype=float64)
    """
    return TwoLinkFlexibleArm(
        link_lengths=(0.35, 0.30),
        linear_densities=(0.6, 0.4),
        bending_stiffnesses=(40.0, 18.0),
        hub_inertias=(0.02, 0.008),
        joint_mass=1.0,
        payload_mass=0.3,
        velocity_gains=(8.0, 3.0),
    )


@eqx.filter_jit
def _simulate(arm, reference, dt, theta1_start, theta2_start, substeps, every):
    start = jnp.concatenate([jnp.stack([theta1_start, theta2_start]), jnp.zeros(6)])
    states = integrate(arm.dynamics, start, reference, dt, substeps=substeps, every=every)
    positions, velocities = states[:, :4], states[:, 4:]
    y = jax.vmap(arm.joint_velocities)(positions, velocities)
    finite = jnp.all(jnp.isfinite(states)) & jnp.all(jnp.isfinite(y))
    status = Status.where(finite, Status.successful, Status.nonfinite)
    return ArmMotion(y, positions, velocities, status)


@eqx.filter_jit
def _linearised(arm, theta2):
    # The angles stay where they are: only the other six states are varied.
    angles = jnp.stack([jnp.zeros(()), theta2])

    def full(state):
        return jnp.concatenate([angles, state])

    return linearise(
        lambda x, u: arm.dynamics(full(x), u)[2:],
        lambda x, u: arm.joint_velocities(full(x)[:4], full(x)[4:]),
        jnp.zeros(6),
        jnp.zeros(2),
    )


@eqx.filter_jit
def _structured_parameters(arm, theta2):
    rest = jnp.concatenate([jnp.stack([jnp.zeros(()), theta2]), jnp.zeros(2)])
    drives = jnp.diag(jnp.concatenate([arm.velocity_gains, jnp.zeros(2)]))
    columns = jnp.concatenate([arm.stiffness_matrix()[:, 2:], drives[:, :2]], axis=1)
    return -jnp.linalg.solve(arm.mass_matrix(rest), columns).T.reshape(16)


def _kinetic(q, qd, arm):
    return arm.kinetic_energy(q, qd)


def _potential(q, arm):
    return arm.potential_energy(q)


def _point(x, deflection):
    return jnp.stack([x - 2.0 / 3.0 * x**3 * deflection**2, x**2 * deflection])


def _point_velocities(x, deflection, rate, spin):
    # Velocity, in the segment's own frame, of the points at x relative to the segment's root.
    along = -4.0 / 3.0 * x**3 * deflection * rate - spin * x**2 * deflection
    across = x**2 * rate + spin * (x - 2.0 / 3.0 * x**3 * deflection**2)
    return along, across


def _turned(angle, point):
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([cosine * point[0] - sine * point[1], sine * point[0] + cosine * point[1]])


def _angle_inside(theta2: ArrayLike, name: str) -> Array:
    theta2 = _floats(theta2)
    if theta2.ndim:
        raise ValueError(f"{name} has shape {theta2.shape}: give one angle, several by jax.vmap.")
    if not isinstance(theta2, Tracer) and not 0.0 < np.asarray(theta2) < np.pi:
        raise ValueError(
            f"{name}={theta2} lies outside of (0, π), where the rigid arm with the same tip is "
            "unique: give an angle in radians inside."
        )
    return theta2
