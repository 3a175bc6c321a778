"""Gains that minimise a cost within bounds, from several starts."""

from collections.abc import Callable, Sequence
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid._results import Solution, Status
from lpvid._solve import Bounds, minimise
from lpvid.control._closed_loop import Numbers
from lpvid.mechanics import SampledController
from lpvid.models import StateSpace

# Of the gradient of a logarithmic cost in the bounds' free coordinates.
_TOLERANCE = 1e-5
# By what share a constraint may be missed and still count as met.
_SLACK = 1e-4
# At 3000 samples a growth of 1e64.
_LARGEST_RADIUS = 1.05

Gains = Float[Array, " gain"]
GainBounds: TypeAlias = tuple[Sequence[float], Sequence[float]]


class ControllerDesign(eqx.Module):
    """A controller found by minimisation.

    Attributes:
        controller: the best one.
        cost: its cost.
        status: how its search ended; `infeasible` where a constraint does not hold.
        gains: where every start ended (start, gain).
        costs: of those (start,), infinite where a constraint does not hold.
        names: of the gains; static.
    """

    controller: SampledController
    cost: Float[Array, ""]
    status: Status
    gains: Float[Array, "start gain"]
    costs: Float[Array, " start"]
    names: tuple[str, ...] = eqx.field(static=True)


def bounds_of(
    bounds: GainBounds, starts: Numbers, count: int
) -> tuple[Bounds, Float[Array, "start gain"]]:
    """Bounds and starts as arrays, checked.

    Raises:
        ValueError: another number of gains, bounds the wrong way round, a start outside.
    """
    lower, upper = (np.asarray(side, float) for side in bounds)
    starts = np.atleast_2d(np.asarray(starts, float))
    if lower.shape != (count,) or upper.shape != (count,) or starts.shape[1:] != (count,):
        raise ValueError(
            f"bounds and starts: {count} gains each are needed, got {lower.shape}, {upper.shape} "
            f"and {starts.shape}."
        )
    if not np.all(lower < upper):
        raise ValueError(f"bounds: {lower} must lie below {upper}.")
    if not np.all((starts >= lower) & (starts <= upper)):
        raise ValueError(f"starts: {starts.tolist()} leave the bounds {bounds}; move them inside.")
    return Bounds(jnp.asarray(lower), jnp.asarray(upper)), jnp.asarray(starts)


def settled(loop: StateSpace) -> StateSpace:
    """A stable loop itself; one whose poles leave the circle too far, with slower growth.

    A search passes gains whose simulation would overflow, and its gradient with it. The slower
    growth still costs more than any stable loop.
    """
    radius = jnp.max(jnp.abs(jnp.linalg.eigvals(jax.lax.stop_gradient(loop.A))))
    return StateSpace(
        loop.A * jnp.minimum(_LARGEST_RADIUS / radius, 1.0), loop.B, loop.C, loop.D, dt=loop.dt
    )


def search_gains(
    loss: Callable[[Gains], Float[Array, ""]], start: Gains, bounds: Bounds, max_steps: int
) -> Solution:
    """Minimise a loss of the gains from one start, in the bounds' free coordinates.

    Few gains and long simulations: the gradient is taken in forward mode, one pass a gain. Works
    under `jit` and `vmap` over `start`.

    Args:
        loss: of the gains.
        start: where to begin.
        bounds: of the gains.
        max_steps: limit on the steps.
    """

    def cost_of(free):
        return loss(bounds.bounded(free))

    def with_gradient(free):
        directions = jnp.eye(free.shape[0])
        push = jax.vmap(lambda d: jax.jvp(cost_of, (free,), (d,)), out_axes=(None, 0))
        return push(directions)

    objective = jax.custom_vjp(cost_of)
    objective.defvjp(with_gradient, lambda gradient, slope: (slope * gradient,))

    found = minimise(
        objective,
        bounds.free(start),
        max_steps=max_steps,
        tolerance=_TOLERANCE,
        # Absolute errors make kinks.
        stop_if_stuck=True,
    )
    return eqx.tree_at(lambda s: s.value, found, bounds.bounded(found.value))


class Multipliers(eqx.Module):
    """State of an augmented Lagrangian (Powell, Rockafellar) for constraints `lacking` ≤ 0.

    Attributes:
        values: of every constraint.
        penalty: weight of the squares.
        missed: by how much the worst constraint was missed.
    """

    values: Float[Array, "*start constraint"]
    penalty: Float[Array, "*start"]
    missed: Float[Array, "*start"]

    def added(self, lacking: Float[Array, " constraint"]) -> Float[Array, ""]:
        """What the constraints add to a loss."""
        push = jnp.maximum(self.values + self.penalty * lacking, 0.0)
        return 0.5 * jnp.sum(push**2 - self.values**2) / self.penalty

    def updated(self, lacking: Float[Array, " constraint"]) -> "Multipliers":
        """After a minimisation that ended so."""
        worst = jnp.maximum(jnp.max(lacking), 0.0)
        heavier = jnp.where(worst > 0.25 * self.missed, 4.0 * self.penalty, self.penalty)
        values = jnp.maximum(self.values + self.penalty * lacking, 0.0)
        return Multipliers(values, heavier, worst)


def no_multipliers(starts: int, constraints: int) -> Multipliers:
    """Where an augmented Lagrangian begins.

    Args:
        starts: how many searches.
        constraints: how many each has.
    """
    return Multipliers(
        jnp.zeros((starts, constraints)),
        # Typed, or the second round compiles everything again.
        jnp.full(starts, 10.0, float),
        jnp.full(starts, jnp.inf, float),
    )


def search_round(
    cost: Callable[[Gains], Array],
    lacking: Callable[[Gains], Array],
    starts: Float[Array, "start gain"],
    multipliers: Multipliers,
    bounds: Bounds,
    max_steps: int,
) -> tuple[Solution, Float[Array, " start"], Multipliers]:
    """One round of an augmented Lagrangian, from every start at once.

    Args:
        cost: of gains, positive.
        lacking: by what share gains miss each constraint.
        starts: where to begin.
        multipliers: of the round before.
        bounds: of the gains.
        max_steps: of each search.
    """

    def one(start, multipliers):
        # The logarithm tames the growth of a loop that is not stable.
        found = search_gains(
            lambda gains: jnp.log(cost(gains)) + multipliers.added(lacking(gains)),
            start,
            bounds,
            max_steps,
        )
        return found, cost(found.value), multipliers.updated(lacking(found.value))

    return jax.vmap(one)(starts, multipliers)


def search_in_rounds(
    one_round: Callable[..., tuple[Solution, Array, Multipliers]],
    starts: Float[Array, "start gain"],
    constraints: int,
    *,
    rounds: int,
    tolerance: float,
    controller: Callable[[Gains], SampledController],
    names: tuple[str, ...],
) -> ControllerDesign:
    """Rounds until costs stay and constraints hold, and the best design of those that hold them.

    Args:
        one_round: starts and multipliers to solutions, costs and multipliers.
        starts: where to begin.
        constraints: how many there are.
        rounds: after the first one, at most.
        tolerance: change of the costs, as a share, that counts as none.
        controller: of gains.
        names: of the gains.
    """
    found, costs, multipliers = one_round(starts, no_multipliers(len(starts), constraints))
    for _ in range(rounds):
        before = costs
        found, costs, multipliers = one_round(found.value, multipliers)
        # A search that a kink ended may go on from there; margins that bind need several rounds.
        moved = jnp.abs(costs / before - 1.0) > tolerance
        if not jnp.any(moved | (multipliers.missed > _SLACK)):
            break
    holds = multipliers.missed <= _SLACK
    worst = jnp.where(jnp.any(holds), jnp.where(holds, costs, jnp.inf), multipliers.missed)
    chosen = jnp.argmin(worst)
    best = jax.tree.map(lambda leaf: leaf[chosen], found)
    return ControllerDesign(
        controller=controller(best.value),
        cost=costs[chosen],
        status=Status.where(holds[chosen], best.status, Status.infeasible),
        gains=found.value,
        costs=jnp.where(holds, costs, jnp.inf),
        names=names,
    )
