"""The non-smooth stage: a proximity-control bundle on ‖G(ϑ) − G_i‖∞ (001, section 2.5)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from lpvid._solve import Bounds
from lpvid._types import Scalar
from lpvid.models import AbstractStructure
from lpvid.restructure._local_model import (
    ErrorAt,
    Expansion,
    curvature,
    cutting_planes,
    expand,
    model_directions,
)
from lpvid.restructure._matching import Target, response_error, scaling
from lpvid.restructure._peaks import Peaks, Places, error_at, find_peaks, join_places, plateau
from lpvid.restructure._quadratic import Rows, join_rows, minimise_level

# Proximity control: shares of the promised decrease, and what they do to the proximal weight.
_ACCEPTED = 0.05
_POOR, _GOOD = 0.25, 0.7
_LOWERED, _RAISED = 0.1, 4.0
_FIRST_WEIGHT, _LEAST_WEIGHT, _REJECTED_WEIGHT, _MOST_WEIGHT = 1e-2, 1e-8, 1e-3, 1e8
# A peak and one of the model before it are the same one this close (in logarithms).
_SAME_PEAK = 0.1
# A relative decrease below the accuracy of the norm cannot be judged.
_ROUNDING = 1e-12


class Descent(NamedTuple):
    """Result of the non-smooth stage: the best point, its peaks, the scaling and the trials.

    `others` are the peaks of the last trial that was refused: a climb to the peaks may miss one.
    """

    value: Float[Array, " parameter"]
    peaks: Peaks
    others: Places
    scaling: Float[Array, "parameter direction"]
    steps: Int[Array, ""]


class _State(NamedTuple):
    point: Float[Array, " parameter"]
    peaks: Peaks
    others: Places
    trial: Float[Array, " parameter"]
    step: Float[Array, " direction"]
    promised: Scalar
    aggregate: Rows
    metric: Float[Array, "direction direction"]
    bend: Float[Array, "direction direction"]
    weight: Scalar
    refused: Bool[Array, ""]
    steps: Int[Array, ""]
    ended: Bool[Array, ""]


class _Refused(NamedTuple):
    """A trial that did not lower the norm, seen from the point that it was made from.

    Attributes:
        model: the error at the trial and its slopes there.
        step: the trial, from the point.
        kept: whether there is one.
        home: which of the point's places each peak of the trial belongs to.
    """

    model: Expansion
    step: Float[Array, " direction"]
    kept: Bool[Array, ""]
    home: Int[Array, " place"]

    def planes(self, metric: Array) -> Rows:
        """Tangent planes of the trial, less the metric's share, which is added to all planes.

        They bring what the trial showed of each gain's own curvature, without which no step along
        several curved gains is short enough (the Maratos effect). Shifted down to the present
        level where they cut off the point itself, as the norm is not convex.
        """
        cuts = cutting_planes(self.model, self.model.vectors[:, :, 0])
        bent = metric @ self.step
        room = cuts.limits + cuts.slopes @ self.step - 0.5 * self.step @ bent
        cuts = Rows(cuts.slopes - bent[None], cuts.lifted, jnp.maximum(room, 0.0))
        return cuts.only(jnp.broadcast_to(self.kept, room.shape))


class _Step(NamedTuple):
    """A step of the local model: what it promises, the model's aggregate, and the next metric.

    `bend` is the curvature of the cuts' combination, the metric its absolute value.
    """

    x: Float[Array, " direction"]
    promised: Scalar
    left: Scalar
    aggregate: Rows
    metric: Float[Array, "direction direction"]
    bend: Float[Array, "direction direction"]


def _solve_model(
    error: ErrorAt,
    model: Expansion,
    refused: _Refused,
    limits: Rows,
    before: tuple[Array, Array],
    weight: Array,
    stationary: Array,
) -> _Step:
    """Cutting planes, then the curvature that their multipliers ask for, then the step again.

    `before` are the metric and the signed curvature of the last step, whose aggregate comes first
    in `limits`.
    """
    metric, carried = before
    count, n = model.error.shape[0], model.slopes.shape[0]
    # One input or output has but one singular vector; else the model is met again where it turns.
    planes, rounds = (1, 2) if model.error.shape[2] == 1 else (3, 3)

    def solve(index, carry):
        directions, metric, _ = carry
        there = jnp.repeat(jnp.arange(planes) <= index, count)
        cuts = join_rows(*(cutting_planes(model, v) for v in directions)).only(there)
        rows = join_rows(cuts, refused.planes(metric), limits)
        weighted = metric + weight * jnp.eye(n)
        found = minimise_level(weighted, rows)
        multipliers = jnp.where(rows.lifted > 0.0, found.multipliers, 0.0)
        aggregate = Rows(
            (multipliers @ rows.slopes)[None], jnp.ones(1), (multipliers @ rows.limits)[None]
        )
        by_plane = multipliers[: planes * count].reshape(planes, count)
        later = multipliers[planes * count :][: refused.home.shape[0]]
        by_plane = by_plane.at[0, refused.home].add(later)
        # What the aggregate stands for bends as it did when the aggregate was made.
        bend = curvature(error, model, directions, by_plane, stationary)
        bend = bend + multipliers[planes * count + refused.home.shape[0]] * carried
        values, vectors = jnp.linalg.eigh(bend)
        renewed = (vectors * jnp.abs(values)[None]) @ vectors.T
        turned = model_directions(model, found.x)
        after = (jnp.arange(planes) == index + 1)[:, None, None]
        directions = jnp.where(after, turned[None], directions)
        promised = -(found.level + 0.5 * found.x @ metric @ found.x)
        left = jnp.linalg.norm(weighted @ found.x)
        return directions, renewed, _Step(found.x, promised, left, aggregate, renewed, bend)

    zero = jnp.asarray(0.0)
    nothing = Rows(jnp.zeros((1, n)), jnp.ones(1), jnp.zeros(1))
    unsolved = _Step(jnp.zeros(n), zero, zero, nothing, metric, carried)
    directions = jnp.broadcast_to(
        model.vectors[None, :, :, 0], (planes, count, model.error.shape[2])
    )
    return jax.lax.fori_loop(0, rounds, solve, (directions, metric, unsolved))[2]


def _homes(trial: Places, point: Places) -> Int[Array, " place"]:
    """Nearest peak of the point for each of the trial's; itself, further on, where none is near."""
    first, second = (jnp.log(jnp.maximum(places.omega, 1e-12)) for places in (trial, point))
    apart = jnp.abs(first[:, None] - second[None])
    own = second.shape[0] + jnp.arange(first.shape[0])
    return jnp.where(jnp.min(apart, axis=1) < _SAME_PEAK, jnp.argmin(apart, axis=1), own)


def bound_rows(bounds: Bounds, point: Array, shape: Array) -> Rows:
    """What the bounds leave of a step in scaled directions."""
    slopes = jnp.concatenate([shape, -shape])
    room = jnp.concatenate([bounds.upper - point, point - bounds.lower])
    rows = Rows(slopes, jnp.zeros_like(room), jnp.maximum(room, 0.0))
    return rows.only(jnp.isfinite(room) & jnp.any(slopes != 0.0, axis=1))


def descend_nonsmooth(
    structure: AbstractStructure,
    start: Array,
    target: Target,
    *,
    steps: int,
    tolerance: float,
    stable: bool,
) -> Descent:
    """Minimise ‖Σ(ϑ)‖∞ from `start` to a point where zero is a subgradient.

    The bundle is one of frequencies: the peaks of the error at the best point, some more where its
    gain is flat, and the peaks of the last trial that was refused. Their cutting planes (equations
    19 and 20, also along the singular vectors that the local model turns to), the tangent planes of
    that trial and the aggregate of the last program make the piecewise linear model; its step
    minimises the model plus a quadratic, half Hessian of the Lagrangian and half proximal weight,
    which falls after steps as good as promised and rises after others (P. Apkarian, D. Noll,
    O. Prot, J. Convex Anal. 16 (2009) 641-666). Bounds are constraints of the program, so a
    solution may lie on them. Steps to unstable models are refused where `stable` says so.

    Works under `jit`; a batch costs least through `jax.lax.map`.
    """
    bounds = Bounds(*structure.bounds())
    lower, upper = bounds.lower, bounds.upper
    start = jnp.clip(start, lower, upper)
    held = upper <= lower
    shape = jnp.where(
        held[:, None], 0.0, scaling(lambda x: response_error(structure, x, target), start)
    )
    shape = jnp.where(jnp.isfinite(shape), shape, 0.0)
    n = start.shape[0]

    def advance(state: _State) -> _State:
        tried = find_peaks(structure, state.trial, target, stable)
        first = state.steps == 0
        gained = 0.5 * (1.0 - (tried.norm / state.peaks.norm) ** 2)
        share = gained / jnp.maximum(state.promised, 1e-300)
        better = jnp.isfinite(tried.norm) & (gained > 0.0) & (share > _ACCEPTED)
        accepted = first | better
        factor = jnp.where(share > _GOOD, _LOWERED, jnp.where(share > _POOR, 1.0, _RAISED))
        # What a first refusal shows may be all that lacked; only the next ones shorten the step.
        weight = jnp.where(state.refused, _RAISED, 1.0) * state.weight
        weight = jnp.maximum(weight, _REJECTED_WEIGHT)
        weight = jnp.where(better, jnp.maximum(factor * state.weight, _LEAST_WEIGHT), weight)
        weight = jnp.where(first, _FIRST_WEIGHT, weight)
        point = jnp.where(accepted, state.trial, state.point)
        peaks = jax.tree.map(lambda new, old: jnp.where(accepted, new, old), tried, state.peaks)

        # Kept after a trial that was accepted: what refused one trial may refuse the next.
        finite = jnp.isfinite(tried.norm)
        seen = (accepted & ~first) | ~finite
        others = Places(
            *(
                jnp.where(seen, old, new)
                for old, new in zip(state.others, tried.places, strict=True)
            )
        )
        places = join_places(peaks.places, others)
        if target.black_box is not None:
            places = join_places(places, plateau(structure, point, target, peaks, tolerance))
        count = places.omega.shape[0]
        error = error_at(structure, point, shape, target, places)
        # The aggregate belongs to the local model of a point: it goes when the point does.
        aggregate = state.aggregate.only(~accepted[None])
        limits = join_rows(aggregate, bound_rows(bounds, point, shape))
        stationary = jnp.arange(count) < peaks.gains.shape[0]
        model = expand(error, n, count)
        refused = _Refused(
            expand(
                error_at(structure, state.trial, shape, target, tried.places),
                n,
                tried.gains.shape[0],
            )._replace(top=model.top),
            state.step,
            ~accepted & finite,
            _homes(tried.places, peaks.places),
        )
        step = _solve_model(
            error, model, refused, limits, (state.metric, state.bend), weight, stationary
        )

        small = 0.1 * tolerance
        certain = (step.left <= small) & (step.aggregate.limits[0] <= small)
        hopeless = (step.promised <= _ROUNDING) | (weight > _MOST_WEIGHT)
        nothing_left = ~((peaks.norm > peaks.floor) & jnp.isfinite(peaks.norm))
        return _State(
            point=point,
            peaks=peaks,
            others=others,
            trial=jnp.clip(point + shape @ step.x, lower, upper),
            step=step.x,
            promised=step.promised,
            aggregate=step.aggregate,
            metric=step.metric,
            bend=step.bend,
            weight=weight,
            refused=~accepted,
            steps=state.steps + 1,
            ended=certain | hopeless | nothing_left,
        )

    unknown = jax.eval_shape(lambda: find_peaks(structure, start, target, stable))
    begun = jax.tree.map(lambda leaf: jnp.ones(leaf.shape, leaf.dtype), unknown)
    state = _State(
        point=start,
        peaks=begun,
        others=begun.places,
        trial=start,
        step=jnp.zeros(n),
        promised=jnp.asarray(0.0),
        aggregate=Rows(jnp.zeros((1, n)), jnp.ones(1), jnp.zeros(1)),
        metric=jnp.zeros((n, n)),
        bend=jnp.zeros((n, n)),
        weight=jnp.asarray(_FIRST_WEIGHT),
        refused=jnp.asarray(False),
        steps=jnp.asarray(0),
        ended=jnp.asarray(False),
    )
    found = jax.lax.while_loop(lambda s: (s.steps < steps + 1) & ~s.ended, advance, state)
    return Descent(found.point, found.peaks, found.others, shape, found.steps - 1)
