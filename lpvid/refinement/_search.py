"""The search, and what is known about its result: two compiled functions of arrays."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lpvid._results import Solution, Status
from lpvid._solve import Bounds
from lpvid.refinement._coordinates import Selection, complement
from lpvid.refinement._covariance import uncertainty
from lpvid.refinement._criterion import Problem
from lpvid.refinement._levenberg_marquardt import Unknowns, levenberg_marquardt
from lpvid.refinement._losses import AbstractLoss, Mask, Residual, covariance, rounding_floor
from lpvid.refinement._parameterisation import AbstractParameterisation, Record
from lpvid.refinement._shooting import Shooting, cut_up, unweighted

# Residual variance over the output's power that says a simulation has grown out of bounds.
_GROWN = 10.0
# Gap between pieces, over the size of the state, that still counts as none.
_CLOSED = 1e-8
# Weights of the gaps from round to round, over what a piece tells of its state; below the one
# named free, steps begin short. The last ones are the multipliers' work.
_STRENGTHS = (0.0, 1e-2, 1.0, 1e2, 1e4, 1e6, 1e8, 1e8)
_TOLERANCES = (1e-1, 1e-1, 1e-2, 1e-2, 1e-3, 1e-4, 1e-6, 1e-8)
_FREE = 0.1


class Task(eqx.Module):
    """Everything a search needs but the records and a start.

    Attributes:
        parameterisation: the kind of model.
        loss: what is minimised.
        selection: which values are estimated.
        bounds: of the chosen values.
        x0: initial states where they are not estimated.
        free_start: whether they are.
        remaining: directions of the gauge among the chosen values.
        shooting: samples in a piece of a shooting search; None for whole records.
    """

    parameterisation: AbstractParameterisation
    loss: AbstractLoss
    selection: Selection
    bounds: Bounds
    x0: Float[Array, "record nx"]
    free_start: bool = eqx.field(static=True)
    remaining: int = eqx.field(static=True)
    shooting: int | None = eqx.field(static=True)

    def own(self, records: int, longest: int) -> Float[Array, "record own"]:
        """Zero states of all records, at the start of every piece where there are pieces."""
        states = self.parameterisation.n_states
        if self.shooting is None:
            return jnp.zeros((records, states if self.free_start else 0))
        return jnp.zeros((records, states * -(-longest // self.shooting)))

    def problem(self, records: Record, mask: Mask, chosen: Array) -> tuple[Problem, Array]:
        """The problem in coordinates about a point, and these coordinates' directions."""
        base = self.selection.values(chosen)
        gauge = self.parameterisation.gauge(base)
        if gauge is None:
            local = jnp.eye(chosen.shape[0])
        else:
            local = complement(self.selection, gauge, self.parameterisation.scale, self.remaining)
        floor = rounding_floor(records.y, mask)
        problem = Problem(
            parameterisation=self.parameterisation,
            loss=self.loss,
            records=records,
            mask=mask,
            base=base,
            basis=self.selection.matrix @ local,
            x0=self.x0,
            free_start=self.free_start,
            floor=floor,
            scale=jnp.ones_like(floor),
        )
        return problem, local

    def scaled(self, problem: Problem, unknowns: Unknowns) -> Problem:
        """The problem with the residual's scale at a point."""
        scale = self.loss.scale(problem.residual(unknowns), problem.mask, problem.floor)
        return eqx.tree_at(lambda p: p.scale, problem, scale)

    def local_bounds(self, chosen: Array, count: int) -> Bounds:
        """Bounds of the coordinates about a point."""
        if count != chosen.shape[0] or self.remaining:
            infinite = jnp.full((count,), jnp.inf)
            return Bounds(-infinite, infinite)
        return Bounds(self.bounds.lower - chosen, self.bounds.upper - chosen)


class Outcome(eqx.Module):
    """What the search found and what is known about it, in the model's own values.

    Attributes:
        values: all values.
        x0: initial states of the records.
        cost: the loss.
        initial_cost: the loss at the start.
        residual: y − ŷ, padded.
        noise_covariance: of the residual, corrected for degrees of freedom.
        covariance: of the values.
        robust_covariance: of the values, for noise that is not white.
        unidentified: values that the records say nothing about.
        at_bound: values that ended at a bound.
        degrees_of_freedom: unknowns estimated.
        steps: of the search.
        gap: largest gap between pieces; zero without shooting.
        status: how it ended.
    """

    values: Float[Array, " value"]
    x0: Float[Array, "record nx"]
    cost: Float[Array, ""]
    initial_cost: Float[Array, ""]
    residual: Float[Array, "record time ny"]
    noise_covariance: Float[Array, "ny ny"]
    covariance: Float[Array, "value value"]
    robust_covariance: Float[Array, "value value"]
    unidentified: Bool[Array, " value"]
    at_bound: Bool[Array, " value"]
    degrees_of_freedom: int = eqx.field(static=True)
    steps: Array
    gap: Float[Array, ""]
    status: Status


class Found(eqx.Module):
    """Where a search ended.

    Attributes:
        chosen: the chosen values.
        own: states of all records.
        solution: how it ended.
        first: residual at the start.
        residual: at the solution.
        gap: largest gap between pieces, over the size of what does not meet.
    """

    chosen: Float[Array, " chosen"]
    own: Float[Array, "record own"]
    solution: Solution
    first: Residual
    residual: Residual
    gap: Float[Array, ""]


@eqx.filter_jit
def search(
    task: Task,
    records: Record,
    mask: Mask,
    start: Float[Array, " chosen"],
    own: Float[Array, "record own"],
    max_steps: Array,
) -> Found:
    """Minimise from one start.

    A black box is searched in local coordinates, renewed once at the first solution; a robust loss
    renews its scale.
    """
    start = jnp.clip(start, task.bounds.lower, task.bounds.upper)
    if task.shooting is not None:
        return _shoot(task, records, mask, start, own, max_steps, task.shooting)

    def one_round(carry, _):
        chosen, own, before = carry
        problem, local = task.problem(records, mask, chosen)
        begin = Unknowns(jnp.zeros(local.shape[1]), own)
        problem = task.scaled(problem, begin) if task.loss.rounds > 1 else problem
        point, solution, residuals, _ = levenberg_marquardt(
            problem.cost,
            problem.linearise,
            begin,
            task.local_bounds(chosen, local.shape[1]),
            max_steps=jnp.maximum(max_steps - before, 1),
        )
        steps = before + solution.steps
        chosen = chosen + local @ point.shared
        return (chosen, point.own, steps), (solution.cost, solution.status, residuals)

    rounds = max(task.loss.rounds, 2 if task.remaining else 1)
    carry = (start, own, jnp.asarray(0))
    (chosen, own, steps), every = jax.lax.scan(one_round, carry, length=rounds)
    cost, status, (_, residual) = jax.tree.map(lambda leaf: leaf[-1], every)
    solution = Solution(value=chosen, cost=cost, status=status, steps=steps)
    return Found(chosen, own, solution, every[2][0][0], residual, jnp.asarray(0.0))


def _shoot(
    task: Task,
    records: Record,
    mask: Mask,
    start: Array,
    own: Array,
    max_steps: Array,
    length: int,
) -> Found:
    """Search over pieces that are free at first, and then made to meet more and more strictly."""
    pieces = cut_up(records, mask, length, task.parameterisation.overlap)
    whole, local = task.problem(records, mask, start)
    states = own.reshape(own.shape[0], pieces.joined.shape[1], -1)[:, 0]
    at_start = Unknowns(jnp.zeros(local.shape[1]), states)
    everything = Unknowns(at_start.shared, own)
    gaps = jax.eval_shape(unweighted(whole, pieces).simulate, everything).gaps

    def one_round(carry, each):
        chosen, own, before, information, multipliers = carry
        strength, tolerance = each
        problem, local = task.problem(records, mask, chosen)
        begin = Unknowns(jnp.zeros(local.shape[1]), own)
        shooting = Shooting(problem, pieces, strength * information, multipliers)
        if task.loss.rounds > 1:
            residual = shooting.simulate(begin).residual
            scale = task.loss.scale(residual, mask, problem.floor)
            shooting = eqx.tree_at(lambda s: s.problem.scale, shooting, scale)
        point, solution, (_, simulated), equations = levenberg_marquardt(
            shooting.cost,
            shooting.linearise,
            begin,
            task.local_bounds(chosen, local.shape[1]),
            max_steps=jnp.maximum(max_steps - before, 1),
            tolerance=tolerance,
            near=strength > _FREE,
        )
        carry = (
            chosen + local @ point.shared,
            point.own,
            before + solution.steps,
            equations.information,
            shooting.pushed(simulated),
        )
        return carry, (solution.status, simulated.residual, shooting.largest_gap(simulated))

    carry = (start, own, jnp.asarray(0), jnp.zeros(gaps.shape[2]), jnp.zeros(gaps.shape))
    schedule = (jnp.asarray(_STRENGTHS), jnp.asarray(_TOLERANCES))
    (chosen, own, steps, _, _), every = jax.lax.scan(one_round, carry, schedule)
    status, residual, gap = jax.tree.map(lambda leaf: leaf[-1], every)
    cost = task.loss.cost(residual, mask, whole.scale, whole.floor)
    solution = Solution(value=chosen, cost=cost, status=status, steps=steps)
    return Found(chosen, own, solution, whole.residual(at_start), residual, gap)


@eqx.filter_jit
def assess(
    task: Task,
    records: Record,
    mask: Mask,
    found: Found,
) -> Outcome:
    """What is known at a solution: covariances, and what cannot be told.

    Args:
        task: what was fitted.
        records: to these.
        mask: where they count.
        found: the solution.
    """
    chosen, residual, solution = found.chosen, found.residual, found.solution
    problem, local = task.problem(records, mask, chosen)
    plain = not task.remaining
    states = found.own[:, : task.parameterisation.n_states] if task.free_start else task.x0
    scale = task.loss.scale(residual, mask, problem.floor)
    problem = eqx.tree_at(lambda p: p.scale, problem, scale)
    costs = jax.lax.map(
        lambda each: task.loss.cost(each, mask, scale, problem.floor),
        jnp.stack([found.first, residual]),
    )
    held = jnp.zeros(local.shape[1], bool)
    if plain:
        slack = 1e-9 * jnp.abs(chosen)
        held = (chosen <= task.bounds.lower + slack) | (chosen >= task.bounds.upper - slack)
    degrees = local.shape[1] + (states.size if task.free_start else 0)
    at = Unknowns(jnp.zeros(local.shape[1]), found.own)
    projected = problem.projected
    if task.shooting is not None:
        pieces = cut_up(records, mask, task.shooting, task.parameterisation.overlap)
        projected = unweighted(problem, pieces).projected
    known = uncertainty(problem, projected, at, residual, held, degrees)
    samples = jnp.sum(mask, dtype=float)
    noise = covariance(residual, mask)
    power = covariance(records.y, mask)
    status = Status.where(jnp.any(held), Status.at_bound, Status.successful)
    status = Status.where(jnp.any(known.unidentified), Status.unidentified, status)
    status = Status.where(solution.status == Status.successful, status, solution.status)
    status = Status.where(found.gap <= _CLOSED, status, Status.discontinuous)
    if task.free_start and task.parameterisation.innovation_gain(problem.base) is not None:
        status = Status.where(problem.forgetful(at), status, Status.unstable_predictor)
    # Worse than no model at all: the search never came down from a simulation that grows.
    grown = ~(jnp.diagonal(noise) <= _GROWN * jnp.diagonal(power) + problem.floor)
    status = Status.where(jnp.any(grown), Status.overflow, status)
    moved = task.selection.matrix @ held.astype(float) if plain else jnp.zeros(problem.base.shape)
    share = jnp.maximum(samples - degrees / noise.shape[0], 1.0)
    return Outcome(
        values=problem.base,
        x0=states,
        cost=costs[1],
        initial_cost=costs[0],
        residual=residual,
        noise_covariance=noise * samples / share,
        covariance=known.covariance,
        robust_covariance=known.robust_covariance,
        unidentified=known.unidentified,
        at_bound=moved > 0.0,
        degrees_of_freedom=degrees,
        steps=solution.steps,
        gap=found.gap,
        status=status,
    )
