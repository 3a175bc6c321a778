"""Sampled matrices of a ported model: exact for the linear part, second order in the effects."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lpvid._linalg import expm
from lpvid.loop._ported import AbstractPortedStructure, Ports


class Sampled(eqx.Module):
    """One sample's matrices, at one κ or, with a leading axis, at several nodes.

    With w = [u, f] everything that drives the model, held or a ramp over the sample,
    x⁺ = Φ x + Γ w + Γ̇ (w_end − w_start): the exponential integrator ETD2 (S. Cox, P. Matthews,
    J. Comput. Phys. 176 (2002) 430–455), exact in the linear part however stiff it is.

    Attributes:
        transition: Φ (state, state).
        drive: Γ (state, drive), inputs first, then each coordinate's directions.
        ramp: Γ̇ (state, drive).
        C: (output, state).
        D: (output, input).
        position: (coordinate, state).
        velocity: (coordinate, state).
        acceleration_state: (coordinate, state).
        acceleration_input: (coordinate, input).
        load_state: (coordinate, state).
        load_input: (coordinate, input).
    """

    transition: Float[Array, "*node state state"]
    drive: Float[Array, "*node state drive"]
    ramp: Float[Array, "*node state drive"]
    C: Float[Array, "*node ny state"]
    D: Float[Array, "*node ny nu"]
    position: Float[Array, "*node coordinate state"]
    velocity: Float[Array, "*node coordinate state"]
    acceleration_state: Float[Array, "*node coordinate state"]
    acceleration_input: Float[Array, "*node coordinate nu"]
    load_state: Float[Array, "*node coordinate state"]
    load_input: Float[Array, "*node coordinate nu"]


def sampled(ports: Ports, dt: Float[Array, ""]) -> Sampled:
    """The matrices of one sample of `dt` seconds.

    Args:
        ports: continuous-time matrices at one κ.
        dt: sample time in s.
    """
    n = ports.A.shape[0]
    forces = jnp.moveaxis(ports.force, 1, 0).reshape(n, -1)
    columns = jnp.concatenate([ports.B, forces], axis=1)
    zero, one = jnp.zeros((n, n)), jnp.eye(n)
    # The blocks of this exponential are Φ, h φ1(A h) and h φ2(A h).
    augmented = jnp.block([[ports.A * dt, one, zero], [zero, zero, one], [zero, zero, zero]])
    power = expm(augmented)
    return Sampled(
        transition=power[:n, :n],
        drive=dt * power[:n, n : 2 * n] @ columns,
        ramp=dt * power[:n, 2 * n :] @ columns,
        C=ports.C,
        D=ports.D,
        position=ports.position,
        velocity=ports.velocity,
        acceleration_state=ports.velocity @ ports.A,
        acceleration_input=ports.velocity @ ports.B,
        load_state=ports.load_state,
        load_input=ports.load_input,
    )


def sampled_at(
    structure: AbstractPortedStructure,
    theta: Float[Array, "node parameter"],
    kappa: Float[Array, "node nk"],
    dt: Float[Array, ""],
) -> Sampled:
    """Sampled matrices at several nodes of parameters and scheduling.

    Args:
        structure: the model's structure.
        theta: θ at each node (node, parameter).
        kappa: κ at each node (node, nk).
        dt: sample time in s.
    """
    return jax.vmap(lambda t, k: sampled(structure.ports(t, k), dt))(theta, kappa)
