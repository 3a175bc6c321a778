"""Restructuring: from a black box to a structured model by the H∞ norm (001, section 2)."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float, Int, PRNGKeyArray

from lpvid._results import Solution, Status
from lpvid.analysis import HinfNorm
from lpvid.models import AbstractStructure, StateSpace, d2c
from lpvid.restructure._matching import Target, error_norm, make_target, match_from_starts
from lpvid.restructure._surrogate import largest_gain, refine_smooth

# Two searches ended in the same minimum if their costs differ by less than this factor.
_SAME_MINIMUM = 1.02


class HinfMatching(eqx.Module):
    """How to restructure: least squares on the response, then L-BFGS on smooth surrogates.

    Attributes:
        frequencies: size of the logarithmic grid (the poles' frequencies are added to it).
        match_steps: Levenberg–Marquardt steps from each start.
        log2_powers: exponents of the surrogate, round after round, as powers of two.
        descent_steps: L-BFGS steps of each round.
        passes: how often the rounds are gone through, each time with the exact peak added; 0 stops
            at the least-squares match.

    Raises:
        ValueError: a count is too small, or there is no exponent.

    Example:
        >>> HinfMatching(passes=0).match_steps
        80
    """

    frequencies: int = eqx.field(static=True, default=60)
    match_steps: int = eqx.field(static=True, default=80)
    log2_powers: tuple[int, ...] = eqx.field(static=True, default=(1, 3, 5, 7))
    descent_steps: int = eqx.field(static=True, default=60)
    passes: int = eqx.field(static=True, default=2)

    def __check_init__(self):
        for name in ("frequencies", "match_steps", "descent_steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: at least 1 is needed, got {getattr(self, name)}.")
        if self.passes < 0:
            raise ValueError(f"passes: a number from 0 is needed, got {self.passes}.")
        if not self.log2_powers or min(self.log2_powers) < 0:
            raise ValueError(f"log2_powers: numbers from 0 are needed, got {self.log2_powers}.")


class Restructured(eqx.Module):
    """A structured model and how sure one can be of it.

    Attributes:
        structure: the structure it was matched in.
        parameters: ϑ, in the order of `structure.parameter_names`.
        error_norm: ‖G(ϑ) − G_i‖∞ (L∞ where a pole is unstable).
        peak_frequency: where the norm is reached, rad/s.
        match_costs: least-squares cost that each start ended with, sorted. Where the structure is
            searched in another parameterisation, these are the starts of its start rule.
        hits: how many of them ended in the best minimum.
        margin: cost of the next distinct minimum over the best one (infinite where there is none).
        history: norm before the surrogate stage and after each of its passes.
        status: `successful`, or `nonfinite`.
    """

    structure: AbstractStructure
    parameters: Float[Array, "*batch parameter"]
    error_norm: Float[Array, "*batch"]
    peak_frequency: Float[Array, "*batch"]
    match_costs: Float[Array, "*batch start"]
    hits: Int[Array, "*batch"]
    margin: Float[Array, "*batch"]
    history: Float[Array, "*batch pass"]
    status: Status

    @property
    def model(self) -> StateSpace:
        """The structured model."""
        build = self.structure.matrices
        for _ in range(self.parameters.ndim - 1):
            build = jax.vmap(build)
        return build(self.parameters)

    @property
    def cost(self) -> Float[Array, "*batch"]:
        """F(ϑ) = ‖G(ϑ) − G_i‖∞² (001, equation 6)."""
        return self.error_norm**2


def restructure(
    black_box: StateSpace,
    structure: AbstractStructure,
    *,
    starts: int = 24,
    key: PRNGKeyArray | None = None,
    initial: ArrayLike | Sequence | None = None,
    omega: ArrayLike | Sequence | None = None,
    method: HinfMatching | None = None,
) -> Restructured:
    """Find ϑ that minimises F(ϑ) = ‖G(s, ϑ) − G_i(s)‖∞² (001, equation 6).

    The basis of the black box drops out. Levenberg–Marquardt on the frequency response runs
    from every start in one batch; L-BFGS on a smooth surrogate with growing exponent follows
    from the best. The result is a local minimum of a non-convex function: `hits` and `margin`
    tell how the starts agreed.

    Works under `jax.jit` and `jax.vmap` in `black_box` where the structure's start rule does
    (`ModalStructure`'s does not: it sorts poles eagerly); give `starts=0` and `initial` otherwise.
    Not meant to be differentiated: use the implicit function theorem on the result.

    Args:
        black_box: continuous-time model; a discrete one is converted by `d2c` (zero-order hold).
        structure: what to look for.
        starts: how many starts the structure's start rule gives; 0 to use `initial` alone.
        key: random key of the start rule (needed where `starts` > 0).
        initial: further starting vectors, shape (n_parameters,) or (count, n_parameters), such
            as a neighbour's solution.
        omega: match at these frequencies only (rad/s), to the black box's own response there, a
            discrete one's at e^{jωT}: the right target for band-limited (multisine) records, whose
            models say nothing about other frequencies. The norm is then the largest singular value
            on this grid.
        method: options of the stages.

    Returns:
        The best model found, with what the starts say about it.

    Raises:
        ValueError: sizes do not fit, the black box or a start is not finite, the key is missing,
            there is no start at all, or `omega` exceeds the Nyquist frequency.

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
    if black_box.is_discrete and (starts > 0 or omega is None):
        continuous = d2c(black_box)
    highest = np.pi / black_box.dt if black_box.dt > 0 else np.inf
    search = structure.search_structure() or structure
    scattered = None
    if starts > 0:
        if key is None:
            raise ValueError("key: the start rule is random; give key=jax.random.key(seed).")
        scattered = search.starts(key, starts, continuous)
    given = _initial(initial, structure)
    if scattered is None and given is None:
        raise ValueError("starts: none left; ask for starts > 0 or give initial=.")
    if omega is None:
        target = make_target(continuous, method.frequencies, highest)
    else:
        grid = _grid(omega, highest)
        target = Target(grid, black_box.frequency_response(grid), None)
    return _run(target, structure, search, scattered, given, method)


def restructure_along(
    black_boxes: Sequence[StateSpace],
    structure: AbstractStructure,
    *,
    starts: int = 24,
    key: PRNGKeyArray,
    omega: ArrayLike | Sequence | None = None,
    method: HinfMatching | None = None,
) -> list[Restructured]:
    """Restructure the local models along κ: each one alone, then again from its neighbours.

    A neighbour's solution replaces a point's own where it leads to a lower H∞ error, which mends
    points whose starts all missed the global minimum. Parameters that a structure may list in any
    order (modes) follow their neighbour's. Not for `jit`: it decides point by point.

    Args:
        black_boxes: models ordered along κ.
        structure: what to look for.
        starts: how many starts of the structure's start rule, at each point.
        key: random key of the start rule.
        omega: see `restructure`; one grid for all points.
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
    method = HinfMatching() if method is None else method
    keys = jax.random.split(key, len(black_boxes))
    found = []
    for index, (model, point_key) in enumerate(zip(black_boxes, keys, strict=True)):
        try:
            found.append(
                restructure(
                    model, structure, starts=starts, key=point_key, omega=omega, method=method
                )
            )
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
        again = restructure(model, structure, starts=0, initial=initial, omega=omega, method=method)
        worse = bool(again.error_norm >= (1.0 - 1e-3) * own.error_norm)
        improved.append(own if worse else again)
    for index in range(1, len(improved)):
        aligned = structure.align(improved[index].parameters, improved[index - 1].parameters)
        improved[index] = eqx.tree_at(lambda r: r.parameters, improved[index], aligned)
    return improved


def _run(target, structure, search, scattered, given, method) -> Restructured:
    # Compiled piece by piece: each piece then serves every number and kind of starts, and the
    # norm, dear to compile, is compiled once for all its callers.
    candidates, costs = [], None
    if scattered is not None and search is structure:
        candidates.append(scattered)
    elif scattered is not None:
        found = _match(search, scattered, target, method.match_steps)
        costs = found.cost
        # Two, as many as a point has neighbours: one compilation serves both kinds of start.
        best = found.value[jnp.argsort(found.cost)[:2]]
        candidates.append(jax.vmap(structure.from_search)(best))
    if given is not None:
        candidates.append(given)
    matched = _match(structure, jnp.concatenate(candidates), target, method.match_steps)
    # Hits are counted where the search was made: the polished point is one more trial.
    costs = jnp.sort(matched.cost if costs is None else costs)
    parameters, norm, peak = _lowest_norm(structure, matched, target)
    history = [norm]
    for _ in range(method.passes):
        descent = _descend(structure, parameters, target, peak[None], method)
        moved = error_norm(structure, descent.value, target)
        ahead = jnp.isfinite(moved.value) & (moved.value < norm)
        parameters = jnp.where(ahead, descent.value, parameters)
        # The peak is kept in any case: it is what the last grid lacked.
        norm, peak = jnp.where(ahead, moved.value, norm), moved.frequency
        history.append(norm)
    final = error_norm(structure, parameters, target)
    same = costs <= _SAME_MINIMUM * costs[0] + 1e-16
    return Restructured(
        structure=structure,
        parameters=parameters,
        error_norm=final.value,
        peak_frequency=final.frequency,
        match_costs=costs,
        hits=jnp.sum(same),
        margin=jnp.min(jnp.where(same, jnp.inf, costs)) / jnp.maximum(costs[0], 1e-300),
        history=jnp.stack(history),
        status=_outcome(final, target),
    )


def _lowest_norm(structure, matched: Solution, target):
    """The better one, by the norm, of the two best matches: least squares may miss a spike."""
    best = matched.value[jnp.argsort(matched.cost)[:2]]
    norms = [error_norm(structure, parameters, target) for parameters in best]
    values = jnp.stack([norm.value for norm in norms])
    peaks = jnp.stack([norm.frequency for norm in norms])
    winner = jnp.argmin(jnp.where(jnp.isfinite(values), values, jnp.inf))
    return best[winner], values[winner], peaks[winner]


def _outcome(final: HinfNorm, target) -> Status:
    """The norm's own status, unless the zero model would have done as well."""
    size = largest_gain(target.response)
    poor = (final.value >= 0.999 * size) & (size > 0.0)
    status = Status.where(poor, Status.poor_match, final.status)
    known = jnp.isfinite(final.value) | (final.status == Status.infinite_norm)
    return Status.where(known, status, Status.nonfinite)


@eqx.filter_jit
def _match(structure, starts, target, max_steps):
    return match_from_starts(structure, starts, target, max_steps)


@eqx.filter_jit
def _descend(structure, start, target, peaks, method):
    return refine_smooth(
        structure,
        start,
        target,
        peaks,
        log2_powers=method.log2_powers,
        steps=method.descent_steps,
    )


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
    if grid.ndim != 1 or grid.size == 0 or not np.all((grid >= 0) & (grid <= highest * (1 + 1e-9))):
        raise ValueError(
            f"omega: frequencies from 0 to the Nyquist frequency ({highest:.4g} rad/s) are needed "
            "in a one-dimensional array."
        )
    return jnp.asarray(grid)


def _initial(initial: ArrayLike | Sequence | None, structure: AbstractStructure) -> Array | None:
    if initial is None:
        return None
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
