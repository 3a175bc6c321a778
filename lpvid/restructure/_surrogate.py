"""Smooth surrogate of the H∞ norm, minimised by L-BFGS with a growing exponent."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lpvid._solve import Bounds, minimise
from lpvid.analysis import peak_frequencies
from lpvid.models import AbstractStructure
from lpvid.restructure._matching import Target, error_norm, response_error


class SmoothDescent(eqx.Module):
    """Result of the surrogate stage: the best parameters by the exact norm."""

    value: Float[Array, " parameter"]
    error_norm: Float[Array, ""]
    peak: Float[Array, ""]
    history: Float[Array, " round"]


def power_norm(error: Array, log2_power: Array, most: int) -> Float[Array, ""]:
    """(Σ_ω tr (ΣᴴΣ)^p)^{1/p} with p = 2^log2_power: tends to ‖Σ‖∞² from above as p grows.

    The power is taken by repeated squaring of the small Gram matrices, which is smooth also
    where singular values cross, and needs no decomposition.
    """
    if error.shape[-1] > error.shape[-2]:
        error = jnp.swapaxes(error, -1, -2)
    gram = jnp.conj(jnp.swapaxes(error, -1, -2)) @ error
    trace = jnp.real(jnp.trace(gram, axis1=-2, axis2=-1))
    # The norm is homogeneous: dividing by a constant first keeps the powers within range.
    scale = jax.lax.stop_gradient(jnp.max(trace)) + jnp.finfo(float).tiny
    power = gram / scale
    for step in range(most):
        power = jnp.where(step < log2_power, power @ power, power)
    total = jnp.sum(jnp.real(jnp.trace(power, axis1=-2, axis2=-1)))
    # total is in [1/m, m·n]; the floor only matters for a perfect match, where all is zero.
    return scale * jnp.exp(jnp.log(jnp.maximum(total, 1e-300)) / 2.0**log2_power)


def refine_smooth(
    structure: AbstractStructure,
    start: Array,
    target: Target,
    *,
    log2_powers: tuple[int, ...],
    steps: int,
    n_peaks: int,
) -> SmoothDescent:
    """Minimise ‖Σ(ϑ)‖∞ from `start`: L-BFGS on `power_norm`, round after round.

    Every round refreshes the grid with the exact peaks of the current difference and raises the
    exponent. The parameters are scaled by the inverse square root of the Gauss–Newton matrix
    at the start, so that a step of one changes the response equally in all directions.
    """
    bounds = Bounds(*structure.bounds())

    free = bounds.free(start)
    shape = _scaling(structure, bounds, free, target)
    first_norm, first_peak = error_norm(structure, start, target)

    def one_round(best_state, log2_power):
        point, best_norm, _ = best_state
        fine = _with_peaks(structure, bounds.bounded(point), target, n_peaks)
        reference = power_norm(
            response_error(structure, bounds.bounded(point), fine), log2_power, max(log2_powers)
        )

        def loss(step):
            error = response_error(structure, bounds.bounded(point + shape @ step), fine)
            norm = power_norm(error, log2_power, max(log2_powers))
            return norm / (reference + jnp.finfo(float).tiny)

        found = minimise(loss, jnp.zeros_like(point), max_steps=steps)
        moved = point + shape @ found.value
        norm, peak = error_norm(structure, bounds.bounded(moved), target)
        ahead = jnp.isfinite(norm) & (norm < best_norm)
        state = (moved, norm, peak)
        return jax.tree.map(lambda new, old: jnp.where(ahead, new, old), state, best_state), norm

    rounds = jnp.asarray(log2_powers, float)
    (best, best_norm, peak), history = jax.lax.scan(
        one_round, (free, first_norm, first_peak), rounds
    )
    return SmoothDescent(
        value=bounds.bounded(best),
        error_norm=best_norm,
        peak=peak,
        history=jnp.concatenate([first_norm[None], history]),
    )


def _with_peaks(structure, parameters, target: Target, n_peaks: int) -> Target:
    """The target on a grid with the current difference's peaks and their near neighbours."""
    if target.black_box is None:
        return target
    omega, _ = peak_frequencies(structure.matrices(parameters) - target.black_box, n_peaks)
    extra = jnp.concatenate([omega, 0.9 * omega, 1.1 * omega])
    grid = jnp.concatenate([target.omega, jnp.where(jnp.isfinite(extra), extra, 0.0)])
    return Target(grid, target.black_box.frequency_response(grid), target.black_box)


def _scaling(structure, bounds, free, target) -> Float[Array, "parameter parameter"]:
    def residual(x):
        error = response_error(structure, bounds.bounded(x), target)
        return jnp.concatenate([jnp.real(error).reshape(-1), jnp.imag(error).reshape(-1)])

    jacobian = jax.jacfwd(residual)(free)
    # Diagonal scaling first: the entries' sizes differ by many orders.
    size = jnp.sqrt(jnp.sum(jacobian**2, axis=0))
    size = jnp.maximum(size, 1e-12 * jnp.max(size) + jnp.finfo(float).tiny)
    scaled = jacobian / size[None]
    values, vectors = jnp.linalg.eigh(scaled.T @ scaled)
    floor = 1e-8 * jnp.max(values)
    inverse = vectors / jnp.sqrt(jnp.maximum(values, floor))[None]
    # Steps of about the size of the error that is left.
    left = jnp.sqrt(jnp.mean(residual(free) ** 2) * residual(free).size)
    return (inverse / size[:, None]) * jnp.maximum(left, 1e-300)
