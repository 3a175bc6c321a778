"""The predictor's gain: a steady Kalman filter whose diffusion enters at the model's ports."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lpvid._linalg import discrete_riccati
from lpvid.loop._discretise import Sampled, sampled_at
from lpvid.loop._program import Records, Setting

_RESPONSE = 256
"""Samples of the impulse responses that put the ports' diffusions on one scale."""


def _intensities(matrices: Sampled, noise: Float[Array, " ny"]) -> Float[Array, " drive"]:
    """Diffusion of each port that alone moves the outputs by as much as their noise."""

    def step(state, _):
        return matrices.transition @ state, jnp.sum((matrices.C @ state / noise[:, None]) ** 2, 0)

    _, energy = jax.lax.scan(step, matrices.drive, length=_RESPONSE)
    total = jnp.sum(energy, axis=0)
    return jnp.where(total > 0.0, 1.0 / jnp.where(total > 0.0, total, 1.0), 0.0)


def _gain(matrices: Sampled, noise: Float[Array, " ny"], ratio: Float[Array, ""]) -> Array:
    intensity = ratio * _intensities(matrices, noise)
    Q = matrices.drive @ (intensity[:, None] * matrices.drive.T)
    # The least diffusion in all states keeps the Riccati equation solvable at an integrator.
    Q = Q + 1e-12 * jnp.trace(Q) * jnp.eye(Q.shape[0])
    R = jnp.diag(noise**2)
    P = discrete_riccati(matrices.transition, matrices.C, Q, R, jnp.zeros((Q.shape[0], R.shape[0])))
    innovation = matrices.C @ P @ matrices.C.T + R
    gain = jnp.linalg.solve(innovation, matrices.C @ P).T
    return jnp.where(jnp.all(jnp.isfinite(gain)), gain, jnp.zeros_like(gain))


def gains(
    setting: Setting,
    records: Records,
    theta: Float[Array, " parameter"],
    noise: Float[Array, " ny"],
    ratio: Float[Array, ""],
) -> Float[Array, "node state ny"]:
    """L at every node of κ, for a measurement update before each step.

    At a ratio of 1 the diffusion of each port moves the outputs as much as their noise does; at 0
    there is no gain and the predictor is a simulation. A node without a stabilising solution gets
    no gain.

    Args:
        setting: structure, laws, sample time.
        records: the nodes of κ.
        theta: parameters of the model.
        noise: standard deviation of the outputs' noise (ny,).
        ratio: diffusion.
    """
    nodes = records.kappa_nodes
    thetas = jnp.broadcast_to(theta, (nodes.shape[0], theta.shape[0]))
    matrices = sampled_at(setting.structure, thetas, nodes, jnp.asarray(setting.dt))
    return jax.vmap(lambda m: _gain(m, noise, ratio))(matrices)
