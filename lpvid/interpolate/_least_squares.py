"""Least squares on local parameters, weighted by a number or by covariances."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from lpvid.interpolate._local import Points
from lpvid.models import AbstractBasis, AbstractDependence

# Eigenvalues of a correlation matrix below this share of the largest are rounding.
_RANK = 1e-10

Weights = Float[Array, " point"]
Covariances = Float[Array, "point parameter parameter"]


def point_weights(weights: ArrayLike | Sequence | None, count: int) -> Weights:
    """One positive weight for each point; ones by default.

    Raises:
        ValueError: they are not positive, or not one for each point.
    """
    values = jnp.ones(count) if weights is None else jnp.asarray(weights, float)
    known = not isinstance(values, Tracer)
    if values.shape != (count,) or (
        known and not bool(jnp.all((values > 0) & jnp.isfinite(values)))
    ):
        raise ValueError(f"weights: {count} positive numbers are needed, one for each model.")
    return values


def point_covariances(covariances: ArrayLike | Sequence, count: int, width: int) -> Covariances:
    """One covariance for each point, checked where it is known.

    Raises:
        ValueError: shapes differ, or one is not finite, symmetric and positive semidefinite.
    """
    if isinstance(covariances, list | tuple):
        covariances = jnp.stack([jnp.asarray(each, float) for each in covariances])
    values = jnp.asarray(covariances, float)
    if values.shape != (count, width, width):
        raise ValueError(
            f"covariances: one of shape ({width}, {width}) for each of {count} models is needed, "
            f"got shape {values.shape}."
        )
    if not isinstance(values, Tracer):
        for index, each in enumerate(np.asarray(values)):
            size = np.sqrt(np.maximum(np.diagonal(each), 0.0))
            size = np.where(size > 0, size, 1.0)
            scaled = each / np.outer(size, size)
            if (
                not np.all(np.isfinite(scaled))
                or np.abs(scaled - scaled.T).max() > 1e-6
                or np.linalg.eigvalsh(scaled)[0] < -1e-6
            ):
                raise ValueError(
                    f"covariances: that of point {index} is not finite, symmetric and positive "
                    "semidefinite."
                )
    return values


def basis_for(method: AbstractDependence, points: Points) -> AbstractBasis:
    """The method's basis, if the points determine its coefficients.

    Raises:
        ValueError: they do not.
    """
    with jax.ensure_compile_time_eval():
        basis = method.basis(points)
        rank = rank_of(basis, points)
    if rank < basis.size:
        distinct = np.unique(points, axis=0).shape[0]
        raise ValueError(
            f"method: {method} has {basis.size} functions of {points.shape[1]} scheduling "
            f"variable(s), but the {distinct} distinct points given determine {rank} of them only "
            "(too few, or all on one curve); take a lower degree or fewer knots, or add operating "
            "points."
        )
    return basis


def rank_of(basis: AbstractBasis, points: Points) -> int:
    """How many combinations of the basis functions the points determine."""
    return int(np.linalg.matrix_rank(np.asarray(basis(points))))


def solve(
    basis: AbstractBasis,
    points: Points,
    parameters: Float[Array, "point parameter"],
    weights: Weights | Covariances,
) -> Float[Array, "basis parameter"]:
    """Coefficients that minimise the weighted squared errors at the points.

    Args:
        basis: functions of κ.
        points: where the parameters belong.
        parameters: of the local models.
        weights: numbers by which squared errors count, or covariances P of the parameters; the sum
            of (ϑ − ϑ̂)ᵀ P⁻¹ (ϑ − ϑ̂) is then minimised over all parameters at once.
    """
    functions = jnp.asarray(basis(points))
    if weights.ndim == 1:
        root = jnp.sqrt(weights)[:, None]
        return _by_reflections(functions * root, parameters * root)
    count, width = parameters.shape
    # Typical sizes, for columns that compare.
    variance = jnp.mean(jnp.diagonal(weights, axis1=1, axis2=2), axis=0)
    unit = jnp.sqrt(jnp.where(variance > 0.0, variance, 1.0))
    whiten = jax.vmap(_whitening)(weights / (unit[:, None] * unit[None])[None])
    left = jnp.einsum("kpq,kb->kpbq", whiten, functions)
    right = jnp.einsum("kpq,kq->kp", whiten, parameters / unit[None])
    found = _by_reflections(
        left.reshape(count * width, basis.size * width), right.reshape(count * width, 1)
    )
    return found.reshape(basis.size, width) * unit[None]


def _by_reflections(left: Array, right: Array) -> Array:
    """Least squares of full column rank; unlike by an SVD, repeated singular values do no harm."""
    orthonormal, triangle = jnp.linalg.qr(left)
    return jax.scipy.linalg.solve_triangular(triangle, orthonormal.T @ right)


def _whitening(
    covariance: Float[Array, "parameter parameter"],
) -> Float[Array, "parameter parameter"]:
    """W with Wᵀ W = P⁻¹; a direction without variance counts as one of typical variance."""
    variance = jnp.diagonal(covariance)
    known = variance > 0.0
    size = jnp.where(known, jnp.sqrt(jnp.where(known, variance, 1.0)), 1.0)
    correlation = covariance / (size[:, None] * size[None])
    # Through which directions lack, no derivative passes: eigenvectors have none where eigenvalues
    # repeat, as of independent parameters.
    values, vectors = jnp.linalg.eigh(jax.lax.stop_gradient(correlation))
    lacking = jnp.where(values > _RANK * jnp.maximum(values[-1], 1.0), 0.0, 1.0)
    filled = correlation + jax.lax.stop_gradient((vectors * lacking[None]) @ vectors.T)
    factor = jnp.linalg.cholesky(filled)
    return jax.scipy.linalg.solve_triangular(factor, jnp.diag(1.0 / size), lower=True)
