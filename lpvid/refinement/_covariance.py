"""Covariance of an estimate, for white noise and for noise of any colour."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from lpvid.refinement._criterion import Problem
from lpvid.refinement._levenberg_marquardt import Unknowns
from lpvid.refinement._losses import covariance

# Eigenvalues of the correlation matrix below this share of the largest are rounding.
_RANK = 1e-12
# A value takes part in a direction that cannot be told if this share of it is that direction.
_PART = 1e-2


class Uncertainty(eqx.Module):
    """Covariances of the values.

    Attributes:
        covariance: for white noise.
        robust_covariance: for noise of any colour (independent of the input).
        unidentified: values that take part in a direction that leaves the output as it is.
    """

    covariance: Float[Array, "value value"]
    robust_covariance: Float[Array, "value value"]
    unidentified: Bool[Array, " value"]


def uncertainty(
    problem: Problem,
    projected: Callable[[Unknowns, Array, Array], tuple[Array, Array]],
    at: Unknowns,
    residual: Float[Array, "record time ny"],
    held: Bool[Array, " coordinate"],
    degrees: int,
) -> Uncertainty:
    r"""Covariances at a solution.

    H⁻¹ S H⁻¹ with H = Σ Jᵀ Q J, the initial states eliminated, Q the loss's curvature, and for
    white noise S = Σ Jᵀ Q Γ(0) Q J, Γ the covariance of the loss's influence (Huber 1967). Where
    Q = Γ(0)⁻¹, as for the Gaussian likelihood, that is H⁻¹, the Cramér–Rao bound. For noise of any
    colour S = Σ_τ k(τ) Σ_t J_tᵀ Q Γ(τ) Q J_{t−τ} under a Bartlett window k of 2 √N lags (Newey and
    West 1987, the sensitivities taken as known). What the fit took out of the residual's spectrum
    is put back, so that both agree in expectation for white noise.
    Directions whose information is rounding are left out. Holds all records' sensitivities.

    Args:
        problem: in coordinates about the solution.
        projected: whitened sensitivities by the coordinates, the states eliminated, and orthonormal
            ones by the first states, from a point, a whitening factor and what is not held.
        at: the solution.
        residual: there.
        held: coordinates at a bound: taken as known.
        degrees: unknowns estimated.
    """
    mask = problem.mask
    samples, (longest, ny) = jnp.sum(mask, dtype=float), residual.shape[1:]
    moved = problem.loss.influence(residual, mask, problem.scale)
    share = samples / jnp.maximum(samples - degrees / ny, 1.0)
    noise = share * covariance(moved, mask) + jnp.diag(problem.floor)
    factor = problem.loss.curvature(residual, mask, problem.scale, noise)
    # Covariance of the influence under the loss's own weights: the identity where they are best.
    spread = factor @ noise @ factor.T
    lags = min(int(2.0 * longest**0.5) + 1, longest - 1)
    length = 1 << (longest + lags - 1).bit_length()
    shared, own = projected(at, factor, jnp.where(held, 0.0, 1.0))
    information = jnp.einsum("rpta,rqta->pq", shared, shared)
    inverse, silent = _inverse(information, held)
    waves = jnp.fft.rfft(shared, length, axis=2)
    parts = [jnp.fft.rfft((moved @ factor.T)[:, None], length, axis=2)]
    if own.shape[1]:
        parts.append(jnp.fft.rfft(own, length, axis=2))
    raw, *taken = [jnp.einsum("rpfa,rpfb->fab", part, jnp.conj(part)) for part in parts]
    through = jnp.einsum("pq,rqfa->rpfa", inverse.astype(complex), waves)
    taken.append(jnp.einsum("rpfa,rpfb->fab", through, jnp.conj(waves)))
    root = _symmetric_root(spread).astype(complex)[None]
    raw = raw + root @ sum(taken) @ root
    spectrum = _smoothed(raw, lags, length, samples)
    twice = np.full(length // 2 + 1, 2.0 / length)
    twice[[0, -1]] = 1.0 / length
    shaped = jnp.einsum("f,fab,rqfb->rqfa", twice.astype(complex), spectrum, waves)
    meat = jnp.real(jnp.einsum("rpfa,rqfa->pq", jnp.conj(waves), shaped))
    robust = inverse @ meat @ inverse
    white = inverse @ jnp.einsum("rpta,ab,rqtb->pq", shared, spread, shared) @ inverse
    basis = problem.basis
    return Uncertainty(
        covariance=basis @ (0.5 * (white + white.T)) @ basis.T,
        robust_covariance=basis @ (0.5 * (robust + robust.T)) @ basis.T,
        unidentified=silent(basis) > _PART,
    )


def _symmetric_root(matrix: Float[Array, "ny ny"]) -> Float[Array, "ny ny"]:
    """The positive semidefinite square root."""
    values, vectors = jnp.linalg.eigh(matrix)
    return (vectors * jnp.sqrt(jnp.maximum(values, 0.0))[None]) @ vectors.T


def _smoothed(raw: Array, lags: int, length: int, samples: Array) -> Array:
    """A spectrum summed over all records, under the window and a sample, (frequency, ny, ny)."""
    lag = np.arange(length)
    window = np.maximum(1.0 - np.minimum(lag, length - lag) / (lags + 1.0), 0.0)
    correlation = jnp.fft.irfft(raw, length, axis=0) * (window[:, None, None] / samples)
    return jnp.fft.rfft(correlation, axis=0)


def _inverse(information: Array, held: Array) -> tuple[Array, Callable[[Array], Array]]:
    """Inverse on what can be told; and each value's share in the directions that cannot be."""
    diagonal = jnp.diagonal(information)
    known = (diagonal > 0.0) & ~held
    root = jnp.where(known, jnp.sqrt(jnp.where(known, diagonal, 1.0)), 1.0)
    scale = jnp.where(known, 1.0 / root, 0.0)
    correlation = information * scale[:, None] * scale[None, :]
    finite = jnp.all(jnp.isfinite(correlation))
    # Coordinates that are held (or move nothing) stay out of the way with a one on the diagonal.
    rest = jnp.diag(jnp.where(known, 0.0, 1.0))
    correlation = jnp.where(finite, correlation + rest, jnp.eye(scale.shape[0]))
    values, vectors = jnp.linalg.eigh(correlation)
    told = values > _RANK * jnp.max(values)
    weights = jnp.where(told, 1.0 / jnp.where(told, values, 1.0), 0.0)
    inverse = (vectors * weights[None, :]) @ vectors.T * scale[:, None] * scale[None, :]

    def silent(basis: Array) -> Array:
        moved = jnp.where(told, 0.0, 1.0)
        together = jnp.sum(((basis * scale[None, :]) @ vectors) ** 2 * moved[None, :], axis=1)
        size = jnp.sum((basis * scale[None, :]) ** 2, axis=1)
        alone = jnp.where((diagonal > 0.0) | held, 0.0, 1.0)
        by_itself = (basis**2 @ alone) / jnp.maximum(jnp.sum(basis**2, axis=1), 1e-300)
        return jnp.maximum(together / jnp.where(size > 0.0, size, 1.0), by_itself)

    return jnp.where(finite, inverse, 0.0), silent
