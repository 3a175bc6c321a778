"""Smooth surrogate of the H∞ norm, minimised by L-BFGS with a growing exponent."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lpvid._solve import Bounds, minimise
from lpvid.models import AbstractStructure
from lpvid.restructure._matching import Target, largest_gain, response_error, scaling

Peaks = Float[Array, " peak"]


class SmoothDescent(eqx.Module):
    """Result of the surrogate stage.

    Attributes:
        value: the best point seen.
        history: largest gain of the difference on the grid at the start and after each round.
    """

    value: Float[Array, " parameter"]
    history: Float[Array, " round"]


def power_norm(error: Array, log2_power: Array, most: int) -> Float[Array, ""]:
    """(Σ_ω tr (ΣᴴΣ)^p)^{1/p} with p = 2^log2_power: tends to ‖Σ‖∞² from above as p grows.

    The power is taken by repeated squaring of the small Gram matrices, which is smooth also
    where singular values cross, and needs no decomposition.
    """
    if error.shape[-1] > error.shape[-2]:
        error = jnp.swapaxes(error, -1, -2)
    # The norm is homogeneous: dividing by a constant first keeps the powers within range.
    square = jnp.real(error) ** 2 + jnp.imag(error) ** 2
    scale = jax.lax.stop_gradient(jnp.max(jnp.sum(square, axis=(-2, -1)))) + jnp.finfo(float).tiny
    error = error / jnp.sqrt(scale).astype(error.dtype)
    power = jnp.conj(jnp.swapaxes(error, -1, -2)) @ error
    for step in range(most):
        power = jnp.where(step < log2_power, power @ power, power)
    total = jnp.sum(jnp.real(jnp.trace(power, axis1=-2, axis2=-1)))
    # The floor only matters for a perfect match, where all is zero.
    return scale * jnp.exp(jnp.log(jnp.maximum(total, 1e-300)) / 2.0**log2_power)


def refine_smooth(
    structure: AbstractStructure,
    start: Array,
    target: Target,
    peaks: Peaks,
    *,
    log2_powers: tuple[int, ...],
    steps: int,
) -> SmoothDescent:
    """Minimise ‖Σ(ϑ)‖∞ from `start`: L-BFGS on `power_norm`, round after round.

    Every round raises the exponent and refreshes the grid, which holds the target's
    frequencies, the current model's poles and `peaks` (with near neighbours of both). The
    parameters are scaled by the inverse square root of the Gauss–Newton matrix at the start, so
    that a step of one changes the response equally in all directions.
    """
    bounds = Bounds(*structure.bounds())
    free = bounds.free(start)
    shape = scaling(lambda x: response_error(structure, bounds.bounded(x), target), free)

    def one_round(state, log2_power):
        best, best_norm = state
        fine = _refined(structure, bounds.bounded(best), target, peaks)
        before = response_error(structure, bounds.bounded(best), fine)
        current = power_norm(before, log2_power, max(log2_powers)) + jnp.finfo(float).tiny

        def loss(step):
            error = response_error(structure, bounds.bounded(best + shape @ step), fine)
            return power_norm(error, log2_power, max(log2_powers)) / current

        found = minimise(loss, jnp.zeros_like(best), max_steps=steps)
        moved = best + shape @ found.value
        after = _refined(structure, bounds.bounded(moved), target, peaks)
        norm = largest_gain(response_error(structure, bounds.bounded(moved), after))
        ahead = jnp.isfinite(norm) & (norm < best_norm)
        return (jnp.where(ahead, moved, best), jnp.where(ahead, norm, best_norm)), norm

    fine = _refined(structure, start, target, peaks)
    first = largest_gain(response_error(structure, start, fine))
    rounds = jnp.asarray(log2_powers, float)
    (best, _), history = jax.lax.scan(one_round, (free, first), rounds)
    return SmoothDescent(bounds.bounded(best), jnp.concatenate([first[None], history]))


def _refined(structure, parameters, target: Target, peaks: Peaks) -> Target:
    """The target on a grid with the peaks and the structured model's own resonances."""
    if target.black_box is None:
        return target
    # Its poles move the grid, not the loss: no derivative is wanted (or exists at double poles).
    poles = jax.lax.stop_gradient(structure.matrices(parameters)).poles()
    extra = jnp.concatenate([jnp.abs(jnp.imag(poles)), peaks])
    extra = jnp.where(jnp.isfinite(extra), extra, 0.0)
    grid = jnp.concatenate(
        [target.omega, 0.9 * extra, 0.97 * extra, extra, 1.03 * extra, 1.1 * extra]
    )
    return target.on(grid)
