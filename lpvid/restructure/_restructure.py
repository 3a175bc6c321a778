"""Restructuring: from a black box to a structured model by the H∞ norm (001, section 2)."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from lpvid.models import AbstractStructure, StateSpace, d2c
from lpvid.refinement import Ties
from lpvid.restructure._constrained import constrain
from lpvid.restructure._matching import Target, make_target
from lpvid.restructure._method import HinfMatching
from lpvid.restructure._restructured import Restructured
from lpvid.restructure._stages import run_stages
from lpvid.restructure._starts import (
    AbstractStarts,
    StartProblem,
    collect_starts,
    start_rules,
)
from lpvid.restructure._weight import Weight, filter_model, filter_response


def restructure(
    black_box: StateSpace,
    structure: AbstractStructure,
    *,
    starts: int | AbstractStarts | Sequence[AbstractStarts] = 24,
    key: PRNGKeyArray | None = None,
    initial: ArrayLike | Sequence | Restructured | None = None,
    omega: ArrayLike | Sequence | None = None,
    weight: Weight | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    fixed: Mapping[str, float] | None = None,
    tied: Ties = (),
    stable: bool = False,
    method: HinfMatching | None = None,
) -> Restructured:
    """Find ϑ that minimises F(ϑ) = ‖G(s, ϑ) − G_i(s)‖∞² (001, equation 6).

    The basis of the black box drops out. Levenberg–Marquardt on the frequency response runs
    from every start in one batch; L-BFGS on a smooth surrogate with growing exponent follows
    from the best, and a bundle method on the norm itself, which ends where zero is a subgradient
    and says so in `certificate`. The result is a local minimum of a non-convex function: `hits`
    and `margin` tell how the starts agreed.

    Works under `jax.jit` and `jax.vmap` in `black_box` where the structure's start rule does
    (`ModalStructure`'s does not: it sorts poles eagerly); give `starts=0` and `initial` otherwise.
    A batch costs least through `jax.lax.map`: under `jax.vmap` all members run as long as the
    slowest. Not meant to be differentiated: use the implicit function theorem on the result.

    Args:
        black_box: continuous-time model; a discrete one is converted by `d2c` (zero-order hold).
        structure: what to look for.
        starts: how many starts the structure's start rule gives; 0 to use `initial` alone. Or what
            to start from: `ScatteredStarts`, `SimilarityStarts`, `ClosedFormStart`,
            `LinearConditionsStart`, one of them or several together.
        key: random key of the start rule (needed where it is asked).
        initial: further starting vectors, shape (n_parameters,) or (count, n_parameters); or
            earlier results of the same structure, one or a list: a neighbour's, or the first runs
            of a Monte Carlo study.
        omega: match at these frequencies only (rad/s), to the black box's own response there, a
            discrete one's at e^{jωT}: the right target for band-limited (multisine) records, whose
            models say nothing about other frequencies. The norm is then the largest singular value
            on this grid.
        weight: ‖W (G(ϑ) − G_i)‖∞ instead: W a continuous-time model with one input and output, or
            with as many of both as there are outputs; or, together with `omega`, a function of ω
            with values (frequency,) or (frequency, output, output).
        bounds: lower and upper bound by parameter name (* and ? are wildcards), in place of the
            structure's own.
        fixed: value by parameter name, for those that are known.
        tied: names of parameters that share one value: a pattern, or several patterns, a group.
        stable: keep G(ϑ) stable. Steps that leave the region are refused, so at least one start
            has to lie in it; the norm of a stable black box's error has its wall there.
        method: options of the stages.

    Returns:
        The best model found, with what the starts say about it.

    Raises:
        ValueError: sizes do not fit, the black box or a start is not finite, the key is missing,
            there is no start at all, `omega` exceeds the Nyquist frequency, or the weight or a
            constraint makes no sense.

    Example:
        >>> black_box = StateSpace([[-2.0]], [[4.0]], [[0.5]])
        >>> lag = FunctionStructure(lambda p: (-p[:1, None], p[:1, None], jnp.eye(1)), nominal=1.0)
        >>> best = restructure(black_box, lag, starts=2, key=jax.random.key(0))
        >>> best.parameters.round(3).tolist()
        [2.0]
    """
    method = HinfMatching() if method is None else method
    _check_black_box(black_box, structure)
    continuous = black_box
    rules = start_rules(starts)
    if black_box.is_discrete and (rules or omega is None):
        continuous = d2c(black_box)
    highest = np.pi / black_box.dt if black_box.dt > 0 else np.inf
    search = structure.search_structure() or structure
    given = _initial(initial, structure)
    scattered, given = collect_starts(
        rules, StartProblem(structure, search, continuous, given), key
    )
    if omega is None:
        filtered = filter_model(weight, black_box.ny)
        target = make_target(continuous, method.frequencies, highest, filtered)
    else:
        grid = _grid(omega, highest)
        weighting = filter_response(weight, grid, black_box.ny)
        target = Target(grid, black_box.frequency_response(grid), None, None, weighting)
    constrained = constrain(structure, bounds, fixed, tied)
    lines = None if omega is None else target.omega
    if constrained is None:
        found = run_stages(target, structure, search, scattered, given, method, stable)
        return replace(found, omega=lines)
    given = None if given is None else jax.vmap(constrained.reduced)(given)
    if scattered is not None and search is structure:
        search, scattered = constrained, jax.vmap(constrained.reduced)(scattered)
    found = run_stages(target, constrained, search, scattered, given, method, stable)
    return replace(constrained.restored(found), omega=lines)


def restructure_along(
    black_boxes: Sequence[StateSpace],
    structure: AbstractStructure,
    *,
    starts: int | AbstractStarts | Sequence[AbstractStarts] = 24,
    key: PRNGKeyArray,
    omega: ArrayLike | Sequence | None = None,
    weight: Weight | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    fixed: Mapping[str, float] | None = None,
    tied: Ties = (),
    stable: bool = False,
    method: HinfMatching | None = None,
) -> list[Restructured]:
    """Restructure the local models along κ: each one alone, then again from its neighbours.

    A neighbour's solution replaces a point's own where it leads to a lower H∞ error, which mends
    points whose starts all missed the global minimum. Parameters that a structure may list in any
    order (modes) follow their neighbour's. Not for `jit`: it decides point by point.

    Args:
        black_boxes: models ordered along κ.
        structure: what to look for.
        starts: how many starts of the structure's start rule, at each point; see `restructure`.
        key: random key of the start rule.
        omega: see `restructure`; one grid for all points.
        weight: see `restructure`, and the next four too; the same for all points.
        bounds: bounds by parameter name.
        fixed: values by parameter name.
        tied: names of parameters that share one value.
        stable: keep the models stable.
        method: options of the stages.

    Returns:
        One result for each model. Where a neighbour's solution won, `match_costs` and `hits` are
        those of the two neighbours.

    Raises:
        ValueError: as `restructure`.

    Example:
        >>> black_boxes = [StateSpace([[-p]], [[p]], [[1.0]]) for p in (2.0, 3.0)]
        >>> lag = FunctionStructure(lambda p: (-p[:1, None], p[:1, None], jnp.eye(1)), nominal=1.0)
        >>> local = restructure_along(black_boxes, lag, starts=2, key=jax.random.key(0))
        >>> [round(best.parameters.item(), 3) for best in local]
        [2.0, 3.0]
    """
    options: dict[str, Any] = {
        "omega": omega,
        "weight": weight,
        "bounds": bounds,
        "fixed": fixed,
        "tied": tied,
        "stable": stable,
        "method": method,
    }
    keys = jax.random.split(key, len(black_boxes))
    found = []
    for index, (model, point_key) in enumerate(zip(black_boxes, keys, strict=True)):
        try:
            found.append(restructure(model, structure, starts=starts, key=point_key, **options))
        except ValueError as error:
            raise ValueError(f"black_boxes[{index}]: {error}") from error
    if len(found) < 2:
        return found
    improved = []
    for index, (model, own) in enumerate(zip(black_boxes, found, strict=True)):
        left, right = found[max(index - 1, 0)], found[min(index + 1, len(found) - 1)]
        neighbours = [r for r in (left, right) if bool(jnp.all(jnp.isfinite(r.parameters)))]
        if not neighbours:
            improved.append(own)
            continue
        # Always two: one compilation serves all points.
        initial = jnp.stack([neighbours[0].parameters, neighbours[-1].parameters])
        again = restructure(model, structure, starts=0, initial=initial, **options)
        worse = bool(again.error_norm >= (1.0 - 1e-3) * own.error_norm)
        if stable:
            worse |= bool(own.model.is_stable()) and not bool(again.model.is_stable())
        improved.append(own if worse else again)
    if bounds or fixed or tied:
        # Their names hold at every point: parameters keep their places.
        return improved
    for index in range(1, len(improved)):
        aligned = structure.align(improved[index].parameters, improved[index - 1].parameters)
        improved[index] = _in_order(improved[index], aligned)
    return improved


def _in_order(found: Restructured, aligned: Array) -> Restructured:
    """A result with its parameters in another order, the certificate's with them."""
    given = np.asarray(found.parameters)
    order = np.array([int(np.argmin(np.abs(given - value))) for value in np.asarray(aligned)])
    certificate = found.certificate
    moved = eqx.tree_at(lambda r: r.parameters, found, aligned)
    if certificate is None or np.array_equal(order, np.arange(order.size)):
        return moved
    if sorted(order) != list(range(order.size)):
        # More than an order has changed (signs, say): the certificate is not of these numbers.
        return eqx.tree_at(lambda r: r.certificate, moved, None)
    reordered = eqx.tree_at(
        lambda c: (c.at_bound, c.scaling),
        certificate,
        (certificate.at_bound[order], certificate.scaling[order]),
    )
    return eqx.tree_at(lambda r: r.certificate, moved, reordered)


def _check_black_box(black_box: StateSpace, structure: AbstractStructure) -> None:
    if black_box.batch_shape:
        raise ValueError(
            f"black_box: one model is needed, got a batch of shape {black_box.batch_shape}; use "
            "jax.vmap or restructure_along."
        )
    _check_finite("black_box", black_box, "look for a failed identification")
    sample = jax.eval_shape(
        structure.matrices, jax.ShapeDtypeStruct((structure.n_parameters,), jnp.float64)
    )
    wanted = (sample.C.shape[0], sample.B.shape[1])
    given = (black_box.ny, black_box.nu)
    if wanted != given:
        raise ValueError(
            f"structure: it has {wanted[0]} outputs and {wanted[1]} inputs, the black box "
            f"{given[0]} and {given[1]}; take the structure of the same plant."
        )


def _grid(omega: ArrayLike | Sequence, highest: float) -> Float[Array, " frequency"]:
    grid = np.atleast_1d(np.asarray(omega, float))
    if (
        grid.ndim != 1
        or grid.size == 0
        or not np.all(np.isfinite(grid) & (grid >= 0) & (grid <= highest * (1 + 1e-9)))
    ):
        raise ValueError(
            f"omega: frequencies from 0 to the Nyquist frequency ({highest:.4g} rad/s) are needed "
            "in a one-dimensional array."
        )
    return jnp.asarray(grid)


def _initial(initial, structure: AbstractStructure) -> Array | None:
    if initial is None:
        return None
    if isinstance(initial, Restructured):
        initial = [initial]
    if not isinstance(initial, np.ndarray | jax.Array) and any(
        isinstance(result, Restructured) for result in initial
    ):
        # Batches of results (under vmap) are lists of starts, too.
        initial = jnp.concatenate(
            [jnp.atleast_2d(r.parameters).reshape(-1, r.parameters.shape[-1]) for r in initial]
        )
    vectors = jnp.asarray(initial, float)
    vectors = vectors[None] if vectors.ndim == 1 else vectors
    if vectors.ndim != 2 or vectors.shape[1] != structure.n_parameters:
        raise ValueError(
            f"initial: vectors of {structure.n_parameters} parameters are needed, got shape "
            f"{vectors.shape}; see structure.parameter_names."
        )
    _check_finite("initial", vectors, "leave out failed neighbours")
    return vectors


def _check_finite(name: str, numbers: StateSpace | Array, advice: str) -> None:
    for leaf in jax.tree.leaves(numbers):
        # NumPy, so that constants can also be checked inside of jit.
        if not isinstance(leaf, Tracer) and not np.all(np.isfinite(leaf)):
            raise ValueError(f"{name}: it holds NaN or infinity; {advice}.")
