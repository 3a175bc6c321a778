"""Interpolation of local models to one global LPV model (001, section 3.3.2)."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from lpvid.analysis import parameter_fit
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

Points = Float[np.ndarray, "point scheduling"]


def interpolate(
    models: Sequence[Restructured] | Sequence[StateSpace],
    kappas: ArrayLike | Sequence,
    method: Polynomial | None = None,
    *,
    weights: ArrayLike | Sequence | None = None,
) -> LPVStateSpace:
    """One LPV model through local ones, by least squares on their parameters (equation 35).

    Differentiable in the models' parameters and the weights, under `jit` too (except for the
    choice of an `"auto"` degree).

    Args:
        models: results of `restructure` with one structure, or continuous-time `StateSpace`s in
            coherent bases (whose matrices are then interpolated entry by entry).
        kappas: where they were identified, shape (n_points,) or (n_points, n_scheduling).
        method: `Polynomial(degree)`, degree 2 by default. The degree `"auto"` is the lowest one
            that predicts left-out points within 2 % of the best.
        weights: one for each point, by which its squared error counts; equal by default.

    Returns:
        The LPV model, with the range of `kappas`.

    Raises:
        ValueError: the points do not determine a polynomial of this degree, the models differ in
            structure or size, are in discrete time or hold non-finite parameters, or a weight is
            not positive.

    Example:
        >>> models = [StateSpace([[-k]], [[1.0]], [[1.0]]) for k in (1.0, 2.0, 3.0)]
        >>> interpolate(models, [1.0, 2.0, 3.0], Polynomial(degree=1)).at(1.5).A.round(6).tolist()
        [[-1.5]]
    """
    method = Polynomial() if method is None else method
    points = _points(kappas, len(models))
    structure, parameters = _local_parameters(models)
    if method.degree == "auto":
        errors = leave_one_out(models, points, weights=weights)
        # Exact data leave rounding errors only: no reason for a higher degree.
        enough = 1.02 * min(errors.values()) + 1e-9
        degree = min(degree for degree, error in errors.items() if error <= enough)
    else:
        degree = int(method.degree)
    basis = _basis(points, degree)
    coefficients = _fit(basis, points, parameters, _weights(weights, len(models)))
    return LPVStateSpace(
        structure=structure,
        basis=basis,
        coefficients=coefficients,
        kappa_low=jnp.asarray(points.min(axis=0)),
        kappa_high=jnp.asarray(points.max(axis=0)),
    )


def leave_one_out(
    models: Sequence[Restructured] | Sequence[StateSpace],
    kappas: ArrayLike | Sequence,
    *,
    highest: int = 5,
    weights: ArrayLike | Sequence | None = None,
) -> dict[int, float]:
    """Error of predicting each point from the others, for each polynomial degree.

    The error is that of the predicted model's frequency response, relative to the local model's
    (Frobenius norm over frequencies and channels), root mean square over the points left out:
    parameters that hardly show in the response hardly count. Points at the ends of the range
    are not left out, as they could only be extrapolated to (with fewer than two others, all
    are). Degrees that the remaining points cannot determine are not tried.

    Args:
        models: as for `interpolate`.
        kappas: as for `interpolate`.
        highest: highest degree to try.
        weights: as for `interpolate`.

    Returns:
        The relative error by degree; 0.05 means that the response is 5 % off.

    Raises:
        ValueError: if there are fewer than two models.

    Example:
        >>> leave_one_out(local, kappas)  # doctest: +SKIP
        {0: 0.98, 1: 0.21, 2: 0.05, 3: 0.07}
    """
    points = _points(kappas, len(models))
    structure, parameters = _local_parameters(models)
    weight = _weights(weights, len(models))
    omega, responses = _responses(structure, parameters)
    size = jnp.sum(jnp.abs(responses) ** 2, axis=(1, 2, 3))
    tried = _interior(points)
    errors: dict[int, float] = {}
    for degree in range(highest + 1):
        basis = polynomial_basis(points, degree)
        if not all(_determines(basis, np.delete(points, out, axis=0)) for out in tried):
            break
        predicted = []
        for out in tried:
            kept = np.arange(len(models)) != out
            coefficients = _fit(basis, points[kept], parameters[kept], weight[kept])
            predicted.append(basis(points[out]) @ coefficients)
        error = _response_at(structure, jnp.stack(predicted), omega[tried]) - responses[tried]
        shares = jnp.sum(jnp.abs(error) ** 2, axis=(1, 2, 3)) / size[tried]
        errors[degree] = float(jnp.sqrt(jnp.mean(shares)))
    if not errors:
        raise ValueError("kappas: at least two points are needed to leave one out.")
    return errors


def _interior(points: Points) -> np.ndarray:
    """Points whose absence leaves the range of every scheduling variable as it is."""
    values = np.asarray(points)
    inside = np.all((values > values.min(axis=0)) & (values < values.max(axis=0)), axis=1)
    return np.flatnonzero(inside) if inside.sum() >= 2 else np.arange(len(values))


@eqx.filter_jit
def _responses(structure: AbstractStructure, parameters: Array):
    """Each local model's response on its own grid: log-spaced over its poles, poles included."""

    def one(values):
        model = structure.matrices(values)
        size = jnp.sort(jnp.abs(model.poles()))
        slow = jnp.maximum(size[0], 1e-3 * size[-1])
        spaced = jnp.exp(jnp.linspace(jnp.log(slow / 10.0), jnp.log(3.0 * size[-1]), 60))
        omega = jnp.concatenate([spaced, size])
        return omega, model.frequency_response(omega)

    return jax.vmap(one)(parameters)


@eqx.filter_jit
def _response_at(structure: AbstractStructure, parameters: Array, omega: Array):
    return jax.vmap(lambda p, w: structure.matrices(p).frequency_response(w))(parameters, omega)


def interpolate_balanced(
    models: Sequence[StateSpace], kappas: ArrayLike | Sequence, method: Polynomial | None = None
) -> LPVStateSpace:
    """The naive way: `balance_along` κ, then interpolate entry by entry.

    For comparison with 001 only. Balanced bases of neighbouring models need not be coherent
    (nearly equal Hankel singular values rotate them), so that the result may be far off between
    the points although every local model is exact.

    Args:
        models: stable, minimal continuous-time black boxes of one size, in any bases.
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


def balance_along(models: Sequence[StateSpace]) -> list[StateSpace]:
    """Balanced realisations of models ordered along κ, each state signed as its neighbour's.

    Args:
        models: stable, minimal continuous-time models of one size, in any bases.

    Raises:
        ValueError: for an unstable model, which has no balanced form.

    Example:
        >>> models = [StateSpace([[-k]], [[k]], [[-1.0]]) for k in (1.0, 2.0)]
        >>> [model.A.round(6).item() for model in balance_along(models)]
        [-1.0, -2.0]
    """
    balanced = [balance(model)[0] for model in models]
    for index in range(1, len(balanced)):
        balanced[index] = _same_signs(balanced[index], balanced[index - 1])
    return balanced


def interpolation_fit(
    lpv: LPVStateSpace,
    models: Sequence[Restructured] | Sequence[StateSpace],
    kappas: ArrayLike | Sequence,
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
    points = _points(kappas, len(models))
    systems = [m.model if isinstance(m, Restructured) else m for m in models]
    local = jnp.stack([jnp.concatenate([m.A.reshape(-1), m.B.reshape(-1)]) for m in systems])
    frozen = jax.vmap(lambda k: lpv.structure.matrices(lpv.parameters(k)))(points)
    count = points.shape[0]
    fitted = jnp.concatenate([frozen.A.reshape(count, -1), frozen.B.reshape(count, -1)], axis=1)
    return parameter_fit(local.reshape(-1), fitted.reshape(-1))


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


def _points(kappas: ArrayLike | Sequence, count: int) -> Points:
    # NumPy: which polynomials the points determine must be known, inside of jit too.
    points = np.asarray(kappas, float)
    points = points[:, None] if points.ndim == 1 else points
    if points.ndim != 2 or points.shape[0] != count:
        raise ValueError(
            f"kappas: one row for each of the {count} models is needed, got shape {points.shape}."
        )
    return points


def _weights(weights: ArrayLike | Sequence | None, count: int) -> Float[Array, " point"]:
    values = jnp.ones(count) if weights is None else jnp.asarray(weights, float)
    known = not isinstance(values, Tracer)
    if values.shape != (count,) or (known and not bool(jnp.all(values > 0))):
        raise ValueError(f"weights: {count} positive numbers are needed, one for each model.")
    return values


def _basis(points: Points, degree: int) -> PolynomialBasis:
    with jax.ensure_compile_time_eval():
        basis = polynomial_basis(points, degree)
        determined = _determines(basis, points)
    if not determined:
        distinct = np.unique(points, axis=0).shape[0]
        raise ValueError(
            f"degree: {degree} needs {basis.size} distinct points, not all on a curve of this "
            f"degree, in {points.shape[1]} scheduling variable(s), {distinct} given; lower it or "
            "add operating points."
        )
    return basis


def _determines(basis: PolynomialBasis, points: Points) -> bool:
    """Whether the points leave no combination of the basis functions open."""
    return int(np.linalg.matrix_rank(np.asarray(basis(points)))) == basis.size


def _fit(basis, points, parameters, weights) -> Float[Array, "basis parameter"]:
    root = jnp.sqrt(weights)[:, None]
    return jnp.linalg.lstsq(basis(points) * root, parameters * root)[0]


def _differ(first: AbstractStructure, second: AbstractStructure) -> bool:
    same = eqx.tree_equal(first, second)
    return not (isinstance(same, Tracer) or bool(same))


def _local_parameters(models) -> tuple[AbstractStructure, Float[Array, "point parameter"]]:
    if not models:
        raise ValueError("models: none given.")
    first = models[0]
    if len({isinstance(m, Restructured) for m in models}) > 1:
        raise ValueError("models: results of restructure and state-space models do not mix.")
    if isinstance(first, Restructured):
        structure = first.structure
        if any(_differ(m.structure, structure) for m in models):
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
