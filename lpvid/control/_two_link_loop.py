"""The two-link arm, nonlinear, under a sampled controller of its end effector's joint angles."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from lpvid._results import Status
from lpvid.control._closed_loop import ClosedLoopMotion
from lpvid.control._scheduled import ScheduledController
from lpvid.mechanics import SampledController, TwoLinkFlexibleArm
from lpvid.models import StateSpace, runge_kutta_step


def two_link_positions(velocities: StateSpace) -> StateSpace:
    """A model of the arm's joint velocities with the angles in front: outputs [θr, y].

    θr are the joint angles of the rigid arm with the same end effector, the integrals of y; as last
    states they follow the model's own, so that frozen models keep one basis over κ.

    Args:
        velocities: continuous-time model from θ̇* to y without feedthrough, such as
            `TwoLinkFlexibleArm.linearised`; any batch axes.

    Returns:
        Continuous-time `StateSpace` with two states more, from θ̇* to [θr, y] (4,).

    Raises:
        ValueError: a model in discrete time, of other sizes or with a feedthrough (values outside
            `jit` only).

    Example:
        >>> from lpvid.mechanics import reference_two_link_arm
        >>> two_link_positions(reference_two_link_arm().linearised(1.0)).nx
        8
    """
    D = velocities.D
    direct = not isinstance(D, Tracer) and bool(np.any(np.abs(np.asarray(D)) > 1e-12))
    if velocities.is_discrete or (velocities.nu, velocities.ny) != (2, 2) or direct:
        raise ValueError(
            f"velocities is {velocities!r}: a continuous-time model from two velocity references "
            "to two velocities without feedthrough is needed."
        )
    batch, nx = velocities.batch_shape, velocities.nx
    C = velocities.C
    A = jnp.concatenate([velocities.A, C], axis=-2)
    A = jnp.concatenate([A, jnp.zeros((*batch, nx + 2, 2))], axis=-1)
    B = jnp.concatenate([velocities.B, jnp.zeros((*batch, 2, 2))], axis=-2)
    angles = jnp.broadcast_to(jnp.eye(2, nx + 2, nx), (*batch, 2, nx + 2))
    rates = jnp.concatenate([C, jnp.zeros((*batch, 2, 2))], axis=-1)
    return StateSpace(A, B, jnp.concatenate([angles, rates], axis=-2))


def simulate_two_link_loop(
    arm: TwoLinkFlexibleArm,
    controller: SampledController,
    *,
    reference: ArrayLike,
    dt: float,
    theta2_start: ArrayLike,
    theta1_start: ArrayLike = 0.0,
    saturation: ArrayLike | None = None,
    substeps: int = 5,
) -> ClosedLoopMotion:
    """Nonlinear motion of the two-link arm from rest under a sampled controller.

    At every sample the controller reads [θr, y], the joint angles of the rigid arm with the same
    end effector and their rates, and a `ScheduledController` κ = cos θ2 of the second joint's own
    angle too. Its command is the reference θ̇* of the joints' velocity loops until the next sample.
    Composes with jit, vmap (over references and starts) and grad.

    Args:
        arm: the arm.
        controller: of four outputs, such as `OutputFeedback`, or one that is scheduled by κ.
        reference: what the controller follows (time, nr), [θr, θ̇r] for an `OutputFeedback`.
        dt: sample time, s.
        theta2_start: second joint's angle at the start, in (0, π), rad.
        theta1_start: first joint's angle at the start, rad.
        saturation: commands act up to ± this, rad/s; none by default.
        substeps: Runge–Kutta steps per sample; dt / substeps below 3 ms is stable for the reference
            arm, 1 ms accurate.

    Returns:
        `ClosedLoopMotion` with u (time, 2), y (time, 5), κ last, and states [θ, v, θ̇, v̇] (time, 8);
        status `nonfinite` where the integrator diverged or the end effector left the rigid arm's
        reach.

    Raises:
        ValueError: a reference that is not (time, nr), a sample time or number of substeps that is
            not positive, or an angle outside of (0, π).

    Example:
        >>> from lpvid.control import OutputFeedback, simulate_two_link_loop
        >>> from lpvid.mechanics import reference_two_link_arm
        >>> control = OutputFeedback(10.0 * jnp.eye(2, 4), jnp.eye(2, 4, 2))
        >>> options = {"reference": jnp.zeros((9, 4)), "dt": 5e-3}
        >>> simulate_two_link_loop(reference_two_link_arm(), control, theta2_start=4.0, **options)
        Traceback (most recent call last):
        ValueError: theta2_start=4.0: give an angle in radians in (0, π).
    """
    reference = jnp.asarray(reference, float)
    if reference.ndim != 2 or not reference.shape[0]:
        raise ValueError(f"reference has shape {reference.shape}: give (time, nr).")
    if not dt > 0.0 or substeps < 1:
        raise ValueError(f"dt={dt} and substeps={substeps}: give positive numbers.")
    start1, start2 = jnp.asarray(theta1_start, float), jnp.asarray(theta2_start, float)
    if not isinstance(start2, Tracer) and not 0.0 < float(start2) < np.pi:
        raise ValueError(f"theta2_start={theta2_start}: give an angle in radians in (0, π).")
    limit = None if saturation is None else jnp.asarray(saturation, float)
    return _simulate(arm, controller, reference, float(dt), start1, start2, limit, substeps)


@eqx.filter_jit
def _simulate(
    arm: TwoLinkFlexibleArm,
    controller: SampledController,
    reference: Float[Array, "time nr"],
    dt: float,
    theta1_start: Array,
    theta2_start: Array,
    limit: Array | None,
    substeps: int,
) -> ClosedLoopMotion:
    step = jnp.asarray(dt / substeps)
    start = jnp.concatenate([jnp.stack([theta1_start, theta2_start]), jnp.zeros(6)])

    def read(state):
        q, qd = state[:4], state[4:]
        angles = arm.rigid_inverse_kinematics(arm.end_effector(q))
        # The elbow's branch fixes θ2; θ1 goes on beyond a whole turn with the joint.
        first = q[0] + jnp.mod(angles[0] - q[0] + jnp.pi, 2.0 * jnp.pi) - jnp.pi
        rates = arm.joint_velocities(q, qd)
        return jnp.concatenate([first[None], angles[1:], rates, jnp.cos(q[1:2])])

    def sample(carry, asked):
        state, memory = carry
        y = read(state)
        seen = y if isinstance(controller, ScheduledController) else y[:4]
        memory, command = controller.step(memory, asked, seen)
        acting = command if limit is None else jnp.clip(command, -limit, limit)

        def substep(state, _):
            return runge_kutta_step(arm.dynamics, state, acting, step), None

        following, _ = jax.lax.scan(substep, state, length=substeps)
        return (following, memory), (state, command, y)

    _, (states, u, y) = jax.lax.scan(sample, (start, controller.initial()), reference)
    finite = jnp.all(jnp.isfinite(states)) & jnp.all(jnp.isfinite(y))
    status = Status.where(finite, Status.successful, Status.nonfinite)
    return ClosedLoopMotion(reference, u, y, states, status, dt)
