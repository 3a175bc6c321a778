"""Frequency-response matching: the least-squares stage that every restructuring starts with."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from lpvid._results import Solution, Status
from lpvid._solve import Bounds, least_squares
from lpvid.analysis import HinfNorm, hinf_norm
from lpvid.models import AbstractStructure, StateSpace


class Target(eqx.Module):
    """What a structure is matched to: the black box's response on a grid of frequencies.

    `black_box` is there (in continuous time) where the match is over all frequencies; without it
    the grid is all that counts.
    """

    omega: Float[Array, " frequency"]
    response: Complex[Array, "frequency output input"]
    black_box: StateSpace | None


@eqx.filter_jit
def make_target(black_box: StateSpace, n_frequencies: int, highest: float) -> Target:
    """Grid of log-spaced frequencies over the poles' range, with the poles' own frequencies.

    A grid without the poles' frequencies would miss lightly damped peaks; `highest` (rad/s)
    cuts it where the data had nothing to say, at the Nyquist frequency.
    """
    poles = black_box.poles()
    size = jnp.abs(poles)
    # An integrator's pole has no size to scale by.
    slow = jnp.maximum(jnp.min(size), 1e-4 * jnp.max(size))
    top = jnp.minimum(3.0 * jnp.max(size), highest)
    bottom = jnp.minimum(slow / 10.0, top / 100.0)
    spaced = jnp.exp(jnp.linspace(jnp.log(bottom), jnp.log(top), n_frequencies))
    resonances = jnp.clip(jnp.abs(jnp.imag(poles)), bottom, top)
    omega = jnp.sort(jnp.concatenate([spaced, resonances]))
    return Target(omega, black_box.frequency_response(omega), black_box)


def error_norm(structure: AbstractStructure, parameters: Array, target: Target) -> HinfNorm:
    """‖Σ(ϑ)‖∞ with its frequency and status; over the grid where that is the target."""
    if target.black_box is not None:
        return hinf_norm(structure.matrices(parameters) - target.black_box)
    error = response_error(structure, parameters, target)
    gains = jnp.linalg.svd(error, compute_uv=False)[:, 0]
    return HinfNorm(jnp.max(gains), target.omega[jnp.argmax(gains)], Status.successful)


def response_error(
    structure: AbstractStructure, parameters: Array, target: Target
) -> Complex[Array, "frequency output input"]:
    """Σ(jω, ϑ) = G(jω, ϑ) − G_i(jω) on the target's grid (001, equation 8)."""
    model = structure.matrices(parameters)
    return model.frequency_response(target.omega) - target.response


def channel_weights(target: Target) -> Float[Array, "output input"]:
    """Reciprocal RMS of each channel, so that small channels count as much as large ones."""
    size = jnp.sqrt(jnp.mean(jnp.abs(target.response) ** 2, axis=0))
    floor = 1e-3 * jnp.max(size) + jnp.finfo(float).tiny
    return 1.0 / jnp.maximum(size, floor)


def match_responses(
    structure: AbstractStructure, start: Array, target: Target, max_steps: int
) -> Solution:
    """Levenberg–Marquardt on the weighted response error from one start, within the bounds.

    The cost is half the mean squared relative error over frequencies and channels, so that the
    costs of different plants compare.
    """
    bounds = Bounds(*structure.bounds())
    weights = channel_weights(target)
    scale = weights[None] / np.sqrt(target.response.size)

    def residual(free):
        error = response_error(structure, bounds.bounded(free), target)
        return jnp.stack([jnp.real(error) * scale, jnp.imag(error) * scale])

    found = least_squares(residual, bounds.free(start), max_steps=max_steps)
    return eqx.tree_at(lambda s: s.value, found, bounds.bounded(found.value))


def match_from_starts(
    structure: AbstractStructure, starts: Array, target: Target, max_steps: int
) -> Solution:
    """`match_responses` from every start, as one batch."""
    return jax.vmap(lambda start: match_responses(structure, start, target, max_steps))(starts)
