"""The search, and what is known about its result: two compiled functions of arrays."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lpvid._results import Solution, Status
from lpvid._solve import Bounds, Unknowns, levenberg_marquardt
from lpvid.refinement._coordinates import Selection, complement
from lpvid.refinement._covariance import uncertainty
from lpvid.refinement._criterion import Problem
from lpvid.refinement._losses import AbstractLoss, Mask, Residual, covariance, rounding_floor
from lpvid.refinement._parameterisation import AbstractParameterisation, Record

# Residual variance over the output's power that says a simulation has grown out of bounds.
_GROWN = 10.0


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
    """

    parameterisation: AbstractParameterisation
    loss: AbstractLoss
    selection: Selection
    bounds: Bounds
    x0: Float[Array, "record nx"]
    free_start: bool = eqx.field(static=True)
    remaining: int = eqx.field(static=True)

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
    status: Status


@eqx.filter_jit
def search(
    task: Task,
    records: Record,
    mask: Mask,
    start: Float[Array, " chosen"],
    own: Float[Array, "record own"],
    max_steps: Array,
) -> tuple[Array, Array, Solution, tuple[Residual, Residual]]:
    """Minimise from one start: chosen values, initial states, how it ended, residuals at both ends.

    A black box is searched in local coordinates, renewed once at the first solution; a robust loss
    renews its scale.
    """
    start = jnp.clip(start, task.bounds.lower, task.bounds.upper)

    def one_round(carry, _):
        chosen, own, before = carry
        problem, local = task.problem(records, mask, chosen)
        begin = Unknowns(jnp.zeros(local.shape[1]), own)
        problem = task.scaled(problem, begin) if task.loss.rounds > 1 else problem
        point, solution, residuals = levenberg_marquardt(
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
    ends = every[2][0][0], residual
    return chosen, own, Solution(value=chosen, cost=cost, status=status, steps=steps), ends


@eqx.filter_jit
def start_residual(task: Task, records: Record, mask: Mask, chosen: Array, own: Array) -> Residual:
    """The residual before a search."""
    problem, local = task.problem(records, mask, chosen)
    return problem.residual(Unknowns(jnp.zeros(local.shape[1]), own))


@eqx.filter_jit
def assess(
    task: Task,
    records: Record,
    mask: Mask,
    chosen: Array,
    own: Array,
    solution: Solution,
    ends: tuple[Residual, Residual],
) -> Outcome:
    """What is known at a solution: covariances, and what cannot be told.

    Args:
        task: what was fitted.
        records: to these.
        mask: where they count.
        chosen: the solution.
        own: its initial states.
        solution: how the search ended.
        ends: residuals at the start and at the solution.
    """
    problem, local = task.problem(records, mask, chosen)
    plain = not task.remaining
    residual = ends[1]
    scale = task.loss.scale(residual, mask, problem.floor)
    problem = eqx.tree_at(lambda p: p.scale, problem, scale)
    costs = jax.lax.map(
        lambda each: task.loss.cost(each, mask, scale, problem.floor), jnp.stack(ends)
    )
    held = jnp.zeros(local.shape[1], bool)
    if plain:
        slack = 1e-9 * jnp.abs(chosen)
        held = (chosen <= task.bounds.lower + slack) | (chosen >= task.bounds.upper - slack)
    degrees = local.shape[1] + own.size
    at = Unknowns(jnp.zeros(local.shape[1]), own)
    known = uncertainty(problem, at, residual, held, degrees)
    samples = jnp.sum(mask, dtype=float)
    noise = covariance(residual, mask)
    power = covariance(records.y, mask)
    status = Status.where(jnp.any(held), Status.at_bound, Status.successful)
    status = Status.where(jnp.any(known.unidentified), Status.unidentified, status)
    status = Status.where(solution.status == Status.successful, status, solution.status)
    # Worse than no model at all: the search never came down from a simulation that grows.
    grown = ~(jnp.diagonal(noise) <= _GROWN * jnp.diagonal(power) + problem.floor)
    status = Status.where(jnp.any(grown), Status.overflow, status)
    moved = task.selection.matrix @ held.astype(float) if plain else jnp.zeros(problem.base.shape)
    share = jnp.maximum(samples - degrees / noise.shape[0], 1.0)
    return Outcome(
        values=problem.base,
        x0=own if task.free_start else task.x0,
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
        status=status,
    )
