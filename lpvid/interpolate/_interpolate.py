"""Local models to one LPV model, and how well its entries fit them."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from lpvid.analysis import parameter_fit
from lpvid.interpolate._coherent import balance_along
from lpvid.interpolate._least_squares import basis_for, solve
from lpvid.interpolate._leave_one_out import leave_one_out, weighting
from lpvid.interpolate._local import Local, frozen, local_parameters, operating_points
from lpvid.models import (
    AbstractDependence,
    LPVStateSpace,
    Polynomial,
    StateSpace,
    convex_hull,
)


def interpolate(
    models: Sequence[Local],
    kappas: ArrayLike | Sequence,
    method: AbstractDependence | None = None,
    *,
    weights: ArrayLike | Sequence | None = None,
    covariances: ArrayLike | Sequence | None = None,
) -> LPVStateSpace:
    """One LPV model through local ones, by least squares on their parameters (equation 35).

    Differentiable in the models' parameters, weights and covariances, under `jit` too (except for
    the choice of an `"auto"` degree).

    Args:
        models: of one structure: results of `restructure` or `refine`, or `StructuredModel`s; or
            `StateSpace`s in coherent bases (see `modal_along` and `align_along`), whose matrices
            are then interpolated entry by entry. Discrete-time models give a discrete-time model.
        kappas: where they were identified, shape (n_points,) or (n_points, n_scheduling).
        method: `Polynomial(degree)`, of degree 2 by default, or `Spline(...)`. The degree `"auto"`
            is the lowest one that predicts left-out points within 2 % of the best.
        weights: one for each point, by which its squared error counts; equal by default.
        covariances: of each point's parameters, as `Refined.covariance`, in the place of weights:
            generalised least squares over all parameters together. A direction without variance (a
            fixed parameter, or what the records do not tell) counts as one of typical variance.

    Returns:
        The LPV model, with the range and the convex hull of `kappas`.

    Raises:
        ValueError: the points do not determine the basis, the models differ in structure, size or
            sample time or hold non-finite parameters, a weight is not positive, or a covariance not
            positive semidefinite.

    Example:
        >>> models = [StateSpace([[-k]], [[1.0]], [[1.0]]) for k in (1.0, 2.0, 3.0)]
        >>> interpolate(models, [1.0, 2.0, 3.0], Polynomial(degree=1)).at(1.5).A.round(6).tolist()
        [[-1.5]]
    """
    method = Polynomial() if method is None else method
    points = operating_points(kappas, len(models))
    structure, parameters = local_parameters(models)
    weighted = weighting(weights, covariances, parameters.shape)
    if isinstance(method, Polynomial) and method.degree == "auto":
        errors = leave_one_out(models, points, weights=weights, covariances=covariances)
        # Exact data leave rounding errors only: no reason for a higher degree.
        enough = 1.02 * min(errors.values()) + 1e-9
        method = Polynomial(min(degree for degree, error in errors.items() if error <= enough))
    basis = basis_for(method, points)
    with jax.ensure_compile_time_eval():
        hull = convex_hull(points)
    return LPVStateSpace(
        structure=structure,
        basis=basis,
        coefficients=solve(basis, points, parameters, weighted),
        kappa_low=jnp.asarray(points.min(axis=0)),
        kappa_high=jnp.asarray(points.max(axis=0)),
        hull=hull,
    )


def interpolate_balanced(
    models: Sequence[StateSpace],
    kappas: ArrayLike | Sequence,
    method: AbstractDependence | None = None,
) -> LPVStateSpace:
    """The naive way: `balance_along` κ, then interpolate entry by entry.

    For comparison with 001 only. Balanced bases of neighbouring models need not be coherent
    (nearly equal Hankel singular values rotate them), so that the result may be far off between
    the points although every local model is exact. See `modal_along` for a way that works.

    Args:
        models: stable, minimal black boxes of one size, in any bases.
        kappas: where they were identified, shape (n_points,) or (n_points, n_scheduling).
        method: as for `interpolate`.

    Raises:
        ValueError: as `interpolate`; also for an unstable model, which has no balanced form.

    Example:
        >>> models = [StateSpace([[-k]], [[1.0]], [[-1.0]]) for k in (1.0, 2.0, 3.0)]
        >>> interpolate_balanced(models, [1.0, 2.0, 3.0]).at(2.0).A.round(6).tolist()
        [[-2.0]]
    """
    return interpolate(balance_along(models), kappas, method)


def interpolation_fit(
    lpv: LPVStateSpace, models: Sequence[Local], kappas: ArrayLike | Sequence
) -> Float[Array, ""]:
    """FIT of the interpolated entries of A and B to the local models' (001, equation 36), percent.

    Args:
        lpv: interpolated model.
        models: the local models that it was made of.
        kappas: where they were identified, shape (n_points,) or (n_points, n_scheduling).

    Raises:
        ValueError: there is not one row of `kappas` for each model.

    Example:
        >>> models = [StateSpace([[-k]], [[1.0]], [[1.0]]) for k in (1.0, 2.0, 3.0)]
        >>> lpv = interpolate(models, [1.0, 2.0, 3.0], Polynomial(degree=1))
        >>> interpolation_fit(lpv, models, [1.0, 2.0, 3.0]).round(6).item()
        100.0
    """
    points = operating_points(kappas, len(models))
    local = jnp.stack([_entries(frozen(model)) for model in models])
    fitted = jax.vmap(lambda point: _entries(lpv.at(point)))(jnp.asarray(points))
    return parameter_fit(local.reshape(-1), fitted.reshape(-1))


def _entries(model: StateSpace) -> Float[Array, " entry"]:
    return jnp.concatenate([model.A.reshape(-1), model.B.reshape(-1)])
