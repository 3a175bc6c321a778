"""Frequency-response matching: the least-squares stage that every restructuring starts with."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from lpvid._results import Solution, Status
from lpvid._solve import Bounds, least_squares
from lpvid.analysis import HinfNorm, hinf_norm
from lpvid.models import AbstractStructure, StateSpace


class Target(eqx.Module):
    """What a structure is matched to: the black box's response on a grid of frequencies.

    `black_box` is there (in continuous time) where the match is over all frequencies; without it
    the grid is all that counts.

    Attributes:
        omega: the grid, rad/s.
        response: of the black box, there.
        black_box: the model itself, or None.
        weight: filter of the error (a model with as many inputs and outputs as the black box has
            outputs) where there is a black box.
        weighting: the filter's response on the grid.
    """

    omega: Float[Array, " frequency"]
    response: Complex[Array, "frequency output input"]
    black_box: StateSpace | None
    weight: StateSpace | None = None
    weighting: Complex[Array, "frequency output output"] | None = None

    def on(self, omega: Float[Array, " frequency"]) -> "Target":
        """The same black box on another grid."""
        assert self.black_box is not None
        weighting = None if self.weight is None else self.weight.frequency_response(omega)
        response = self.black_box.frequency_response(omega)
        return Target(omega, response, self.black_box, self.weight, weighting)

    def lines(self, chosen: Int[Array, " line"]) -> "Target":
        """Some lines of the grid."""
        weighting = None if self.weighting is None else self.weighting[chosen]
        return Target(self.omega[chosen], self.response[chosen], None, None, weighting)


@eqx.filter_jit
def make_target(
    black_box: StateSpace, n_frequencies: int, highest: float, weight: StateSpace | None = None
) -> Target:
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
    if weight is not None:
        poles = jnp.concatenate([poles, weight.poles()])
    resonances = jnp.clip(jnp.abs(jnp.imag(poles)), bottom, top)
    omega = jnp.sort(jnp.concatenate([spaced, resonances]))
    placeholder = jnp.zeros((n_frequencies, black_box.ny, black_box.nu), complex)
    return Target(spaced, placeholder, black_box, weight).on(omega)


def error_system(structure: AbstractStructure, parameters: Array, target: Target) -> StateSpace:
    """G(ϑ) − G_i, or its product with the weight, as one model."""
    assert target.black_box is not None
    difference = structure.matrices(parameters) - target.black_box
    return difference if target.weight is None else target.weight @ difference


def error_norm(structure: AbstractStructure, parameters: Array, target: Target) -> HinfNorm:
    """‖Σ(ϑ)‖∞ with its frequency and status; over the grid where that is the target."""
    if target.black_box is not None:
        return hinf_norm(error_system(structure, parameters, target))
    error = response_error(structure, parameters, target)
    gains = jnp.linalg.svd(error, compute_uv=False)[:, 0]
    return HinfNorm(jnp.max(gains), target.omega[jnp.argmax(gains)], Status.successful)


def response_error(
    structure: AbstractStructure, parameters: Array, target: Target
) -> Complex[Array, "frequency output input"]:
    """Σ(jω, ϑ) = G(jω, ϑ) − G_i(jω) on the target's grid (001, equation 8), weighted."""
    model = structure.matrices(parameters)
    error = model.frequency_response(target.omega) - target.response
    return error if target.weighting is None else target.weighting @ error


def is_stable(structure: AbstractStructure, parameters: Array) -> Bool[Array, ""]:
    """Whether G(ϑ) is; its poles have no derivatives where they meet, and none are wanted."""
    return structure.matrices(jax.lax.stop_gradient(parameters)).is_stable()


def largest_gain(error: Array) -> Float[Array, ""]:
    """Largest singular value over all frequencies of the grid."""
    return jnp.max(jnp.linalg.svd(error, compute_uv=False))


def weighted_response(target: Target) -> Complex[Array, "frequency output input"]:
    """The black box's response as the error is weighted."""
    if target.weighting is None:
        return target.response
    return target.weighting @ target.response


def scaling(
    residual: Callable[[Float[Array, " parameter"]], Array], at: Float[Array, " parameter"]
) -> Float[Array, "parameter direction"]:
    """Directions in which a step of one changes a response by as much as the error that is left.

    The inverse square root of the Gauss–Newton matrix: what is small, and what is far, then does
    not depend on the parameters' units, nor on how they act together. Weak directions are held
    back.
    """

    def real(x):
        error = residual(x)
        return jnp.concatenate([jnp.real(error).reshape(-1), jnp.imag(error).reshape(-1)])

    jacobian = jax.jacfwd(real)(at)
    # Diagonal scaling first: the entries' sizes differ by many orders.
    size = jnp.sqrt(jnp.sum(jacobian**2, axis=0))
    size = jnp.maximum(size, 1e-12 * jnp.max(size) + jnp.finfo(float).tiny)
    scaled = jacobian / size[None]
    values, vectors = jnp.linalg.eigh(scaled.T @ scaled)
    floor = 1e-8 * jnp.max(values)
    inverse = vectors / jnp.sqrt(jnp.maximum(values, floor))[None]
    # Steps of about the size of the error that is left.
    left = jnp.linalg.norm(real(at))
    return (inverse / size[:, None]) * jnp.maximum(left, 1e-300)


def channel_weights(target: Target) -> Float[Array, "output input"]:
    """Reciprocal RMS of each channel, so that small channels count as much as large ones."""
    size = jnp.sqrt(jnp.mean(jnp.abs(weighted_response(target)) ** 2, axis=0))
    floor = 1e-3 * jnp.max(size) + jnp.finfo(float).tiny
    return 1.0 / jnp.maximum(size, floor)


def match_responses(
    structure: AbstractStructure, start: Array, target: Target, max_steps: int, stable: bool
) -> Solution:
    """Levenberg–Marquardt on the weighted response error from one start, within the bounds.

    Steps to unstable models are refused where `stable` says so.

    The cost is half the mean squared relative error over frequencies and channels, so that the
    costs of different plants compare.
    """
    bounds = Bounds(*structure.bounds())
    weights = channel_weights(target)
    scale = weights[None] / np.sqrt(target.response.size)

    def residual(free):
        error = response_error(structure, bounds.bounded(free), target)
        if stable:
            allowed = is_stable(structure, bounds.bounded(free))
            error = jnp.where(allowed, error, jnp.inf)
        return jnp.stack([jnp.real(error) * scale, jnp.imag(error) * scale])

    found = least_squares(residual, bounds.free(start), max_steps=max_steps)
    return eqx.tree_at(lambda s: s.value, found, bounds.bounded(found.value))


def match_from_starts(
    structure: AbstractStructure, starts: Array, target: Target, max_steps: int, stable: bool
) -> Solution:
    """`match_responses` from every start, as one batch."""
    return jax.vmap(lambda x: match_responses(structure, x, target, max_steps, stable))(starts)
