"""How well local models are predicted from the others."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from lpvid.interpolate._least_squares import (
    Covariances,
    Weights,
    point_covariances,
    point_weights,
    rank_of,
    solve,
)
from lpvid.interpolate._local import (
    Local,
    Points,
    local_parameters,
    operating_points,
    response_variances,
    responses,
    responses_at,
)
from lpvid.models import AbstractDependence, Polynomial, convex_hull

# Scatter of a response, relative, below which a point is no better known than another.
_LEAST_SCATTER = 1e-6


class _Task:
    """What the errors of all methods have in common."""

    def __init__(self, models, kappas, weights, covariances):
        self.points = operating_points(kappas, len(models))
        self.structure, self.parameters = local_parameters(models)
        self.weights = weighting(weights, covariances, self.parameters.shape)
        self.omega, self.responses = responses(self.structure, self.parameters)
        self.size = jnp.sum(jnp.abs(self.responses) ** 2, axis=(1, 2, 3))
        self.tried = left_out(self.points)

    def error(self, method: AbstractDependence) -> float | None:
        """The error, None where the points kept do not determine the method's basis."""
        predicted = []
        for out in self.tried:
            kept = np.arange(len(self.points)) != out
            try:
                basis = method.basis(self.points[kept])
            except ValueError:
                return None
            if rank_of(basis, self.points[kept]) < basis.size:
                return None
            coefficients = solve(
                basis, self.points[kept], self.parameters[kept], self.weights[kept]
            )
            predicted.append(basis(self.points[out]) @ coefficients)
        if not predicted:
            return None
        tried = self.tried
        found = responses_at(self.structure, jnp.stack(predicted), self.omega[tried])
        shares = jnp.sum(jnp.abs(found - self.responses[tried]) ** 2, axis=(1, 2, 3))
        trust = self._trust()[tried]
        return float(jnp.sqrt(jnp.sum(trust * shares / self.size[tried]) / jnp.sum(trust)))

    def _trust(self):
        """How much each point's error counts: what it is itself wrong by says nothing."""
        if self.weights.ndim == 1:
            return self.weights
        scatter = response_variances(self.structure, self.parameters, self.weights, self.omega)
        return 1.0 / (scatter / self.size + _LEAST_SCATTER**2)


def leave_one_out(
    models: Sequence[Local],
    kappas: ArrayLike | Sequence,
    *,
    highest: int = 5,
    weights: ArrayLike | Sequence | None = None,
    covariances: ArrayLike | Sequence | None = None,
) -> dict[int, float]:
    """Error of predicting each point from the others, for each polynomial degree.

    See `left_out_error`. Degrees that the remaining points cannot determine are not tried.

    Args:
        models: as for `interpolate`.
        kappas: as for `interpolate`.
        highest: highest degree to try.
        weights: as for `interpolate`.
        covariances: as for `interpolate`.

    Returns:
        The relative error by degree; 0.05 means that the response is 5 % off.

    Raises:
        ValueError: if there are fewer than two models, or as for `interpolate`.

    Example:
        >>> leave_one_out(local, kappas)  # doctest: +SKIP
        {0: 0.98, 1: 0.21, 2: 0.05, 3: 0.07}
    """
    task = _Task(models, kappas, weights, covariances)
    errors: dict[int, float] = {}
    for degree in range(highest + 1):
        error = task.error(Polynomial(degree))
        if error is None:
            break
        errors[degree] = error
    if not errors:
        raise ValueError("kappas: at least two points are needed to leave one out.")
    return errors


def left_out_error(
    models: Sequence[Local],
    kappas: ArrayLike | Sequence,
    method: AbstractDependence,
    *,
    weights: ArrayLike | Sequence | None = None,
    covariances: ArrayLike | Sequence | None = None,
) -> float:
    """Error of predicting each point from the others by one method.

    The error is that of the predicted model's frequency response, relative to the local model's
    (Frobenius norm over frequencies and channels), root mean square over the points left out:
    parameters that hardly show in the response hardly count. In the mean each point counts by its
    weight, or by the reciprocal of the response's variance that follows from its covariance. Points
    without which the others' hull is smaller are not left out, as they could only be extrapolated
    to (with fewer than two others, all are). `Spline()` without knots has them at the points kept.

    Args:
        models: as for `interpolate`.
        kappas: as for `interpolate`.
        method: `Polynomial(degree)` or `Spline(...)`.
        weights: as for `interpolate`.
        covariances: as for `interpolate`.

    Returns:
        The relative error; 0.05 means that the response is 5 % off.

    Raises:
        ValueError: the points that remain do not determine the basis, or as for `interpolate`.

    Example:
        >>> from lpvid.models import Polynomial, StateSpace
        >>> models = [StateSpace([[-k]], [[1.0]], [[1.0]]) for k in (1.0, 2.0, 3.0, 4.0)]
        >>> left_out_error(models, [1.0, 2.0, 3.0, 4.0], Polynomial(1)) < 1e-12
        True
    """
    error = _Task(models, kappas, weights, covariances).error(method)
    if error is None:
        raise ValueError(
            f"method: with one of the {len(models)} points left out the others do not determine "
            f"{method}; take a lower degree or fewer knots."
        )
    return error


def weighting(
    weights: ArrayLike | Sequence | None,
    covariances: ArrayLike | Sequence | None,
    shape: tuple[int, ...],
) -> Weights | Covariances:
    """Weights or covariances, whichever is given; equal weights by default.

    Raises:
        ValueError: both are given, or they do not fit.
    """
    if covariances is None:
        return point_weights(weights, shape[0])
    if weights is not None:
        raise ValueError("weights: give weights or covariances, not both.")
    return point_covariances(covariances, *shape)


def left_out(points: Points) -> np.ndarray:
    """Points whose absence leaves the hull of the points as it is; all, if fewer than two do."""
    inside = []
    for index, point in enumerate(points if len(points) > 2 else []):
        others = convex_hull(np.delete(points, index, axis=0))
        inside += [index] * bool(others.distance(point) <= 1e-9)
    return np.array(inside) if len(inside) >= 2 else np.arange(len(points))
