"""Interpolation of local models to one global LPV model (001, section 3.3.2)."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from lpvid.models import (
    AbstractStructure,
    FreeStructure,
    LPVStateSpace,
    Polynomial,
    PolynomialBasis,
    StateSpace,
    balance,
    polynomial_basis,
)
from lpvid.restructure import Restructured

Points = Float[Array, "point scheduling"]


def interpolate(
    models: Sequence[Restructured] | Sequence[StateSpace],
    kappas: ArrayLike,
    method: Polynomial | None = None,
    *,
    weights: ArrayLike | None = None,
) -> LPVStateSpace:
    """One LPV model through local ones, by least squares on their parameters (equation 35).

    **Arguments**

    - `models`: results of `restructure` with one structure, or continuous-time `StateSpace`s
      in coherent bases (whose matrices are then interpolated entry by entry).
    - `kappas`: where they were identified, shape (n_points,) or (n_points, n_scheduling).
    - `method`: `Polynomial(degree)`; the degree `"auto"` leaves one point out in turn.
    - `weights`: one for each point, larger for more trusted ones; equal by default.

    Raises `ValueError` for too few points for the degree (with the number needed), models of
    different structure or order, non-finite parameters, or discrete-time models.

    Differentiable in the models' parameters (except for the choice of an `"auto"` degree).

    **Example**

        lpv = interpolate(local, kappas, Polynomial(degree=2))
        lpv.at(0.4)
    """
    method = Polynomial() if method is None else method
    points = _points(kappas, len(models))
    structure, parameters = _local_parameters(models)
    if method.degree == "auto":
        errors = leave_one_out(models, points, weights=weights)
        degree = min(errors, key=lambda candidate: errors[candidate])
    else:
        degree = int(method.degree)
    basis = _basis(points, degree)
    coefficients = _fit(basis, points, parameters, _weights(weights, len(models)))
    return LPVStateSpace(
        structure=structure,
        basis=basis,
        coefficients=coefficients,
        kappa_low=jnp.min(points, axis=0),
        kappa_high=jnp.max(points, axis=0),
    )


def leave_one_out(
    models: Sequence[Restructured] | Sequence[StateSpace],
    kappas: ArrayLike,
    *,
    highest: int = 5,
    weights: ArrayLike | None = None,
) -> dict[int, float]:
    """Error of predicting each point from the others, for each polynomial degree.

    The error is the root mean square over points and parameters, each parameter relative to
    its own spread over κ; degrees that the remaining points cannot determine are left out.

    **Example**

        leave_one_out(local, kappas)   # {0: 0.98, 1: 0.21, 2: 0.05, 3: 0.07}
    """
    points = _points(kappas, len(models))
    _, parameters = _local_parameters(models)
    weight = _weights(weights, len(models))
    values = parameters
    spread = jnp.std(values, axis=0)
    # Entries that do not vary (structural ones, or a known C) have nothing to predict.
    varying = spread > 1e-9 * (jnp.max(jnp.abs(values), axis=0) + 1e-300)
    scale = jnp.where(varying, spread, 1.0)
    errors: dict[int, float] = {}
    for degree in range(highest + 1):
        if polynomial_basis(points, degree).size > len(models) - 1:
            break
        basis = polynomial_basis(points, degree)
        left = []
        for out in range(len(models)):
            kept = np.arange(len(models)) != out
            coefficients = _fit(basis, points[kept], values[kept], weight[kept])
            left.append((basis(points[out]) @ coefficients - values[out]) / scale)
        shares = jnp.where(varying[None], jnp.stack(left), 0.0)
        count = max(int(jnp.sum(varying)), 1) * len(models)
        errors[degree] = float(jnp.sqrt(jnp.sum(shares**2) / count))
    if not errors:
        raise ValueError("kappas: at least two points are needed to leave one out.")
    return errors


def interpolate_balanced(
    models: Sequence[StateSpace], kappas: ArrayLike, method: Polynomial | None = None
) -> LPVStateSpace:
    """The naive way: balance each black box, match signs along κ, interpolate entry by entry.

    For comparison with 001 only. Balanced bases of neighbouring models need not be coherent
    (nearly equal Hankel singular values rotate them), so that the result may be far off between
    the points although every local model is exact.

    **Example**

        naive = interpolate_balanced(black_boxes, kappas, Polynomial(degree=2))
    """
    balanced = [balance(model)[0] for model in models]
    for index in range(1, len(balanced)):
        balanced[index] = _same_signs(balanced[index], balanced[index - 1])
    return interpolate(balanced, kappas, method)


def _same_signs(model: StateSpace, neighbour: StateSpace) -> StateSpace:
    """Flip the states of a balanced model whose input and output rows point the other way."""
    agreement = jnp.sum(model.B * neighbour.B, axis=1) + jnp.sum(model.C * neighbour.C, axis=0)
    signs = jnp.where(agreement < 0, -1.0, 1.0)
    return StateSpace(
        signs[:, None] * model.A * signs[None],
        signs[:, None] * model.B,
        model.C * signs[None],
        model.D,
        model.dt,
    )


def _points(kappas: ArrayLike, count: int) -> Points:
    points = jnp.asarray(kappas, float)
    points = points[:, None] if points.ndim == 1 else points
    if points.ndim != 2 or points.shape[0] != count:
        raise ValueError(
            f"kappas: one row for each of the {count} models is needed, got shape {points.shape}."
        )
    return points


def _weights(weights: ArrayLike | None, count: int) -> Float[Array, " point"]:
    values = jnp.ones(count) if weights is None else jnp.asarray(weights, float)
    if values.shape != (count,) or not bool(jnp.all(values > 0)):
        raise ValueError(f"weights: {count} positive numbers are needed, one for each model.")
    return values


def _basis(points: Points, degree: int) -> PolynomialBasis:
    basis = polynomial_basis(points, degree)
    distinct = np.unique(np.asarray(points), axis=0).shape[0]
    if basis.size > distinct:
        raise ValueError(
            f"degree: {degree} needs {basis.size} distinct points in {points.shape[1]} "
            f"scheduling variables, {distinct} given; lower it or add operating points."
        )
    return basis


def _fit(basis, points, parameters, weights) -> Float[Array, "basis parameter"]:
    root = jnp.sqrt(weights)[:, None]
    return jnp.linalg.lstsq(basis(points) * root, parameters * root)[0]


def _local_parameters(models) -> tuple[AbstractStructure, Float[Array, "point parameter"]]:
    if not models:
        raise ValueError("models: none given.")
    first = models[0]
    if isinstance(first, Restructured):
        structure = first.structure
        if any(jax.tree.structure(m.structure) != jax.tree.structure(structure) for m in models):
            raise ValueError("models: all must have been restructured to the same structure.")
        parameters = jnp.stack([m.parameters for m in models])
    else:
        sizes = {(m.nx, m.nu, m.ny, m.dt) for m in models}
        if len(sizes) != 1 or first.dt != 0:
            raise ValueError(
                "models: continuous-time models of one size are needed (convert with d2c); "
                f"got (order, inputs, outputs, dt) {sorted(sizes)}."
            )
        structure = FreeStructure(first.nx, first.nu, first.ny)
        parameters = jnp.stack([structure.parameters_of(m) for m in models])
    if not isinstance(parameters, Tracer) and not bool(jnp.all(jnp.isfinite(parameters))):
        bad = [i for i in range(len(models)) if not bool(jnp.all(jnp.isfinite(parameters[i])))]
        raise ValueError(f"models: non-finite parameters at point(s) {bad}; leave them out.")
    return structure, parameters


def interpolation_fit(lpv: LPVStateSpace, models, kappas: ArrayLike) -> Float[Array, ""]:
    """FIT of the interpolated entries of A and B to the local models' (001, equation 36), percent.

    **Example**

        interpolation_fit(lpv, local, kappas)
    """
    points = _points(kappas, len(models))
    systems = [m.model if isinstance(m, Restructured) else m for m in models]
    local = jnp.stack([jnp.concatenate([m.A.reshape(-1), m.B.reshape(-1)]) for m in systems])
    frozen = jax.vmap(lambda k: lpv.structure.matrices(lpv.parameters(k)))(points)
    count = points.shape[0]
    fitted = jnp.concatenate([frozen.A.reshape(count, -1), frozen.B.reshape(count, -1)], axis=1)
    error = jnp.linalg.norm(local - fitted)
    return 100.0 * (1.0 - error / jnp.linalg.norm(local - jnp.mean(local)))
