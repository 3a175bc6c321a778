"""Levenberg–Marquardt for long records: from quadratic models of the cost, member by member."""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Bool, Float

from lpvid._results import Solution, Status
from lpvid._solve import Bounds


class Unknowns(NamedTuple):
    """Unknowns shared by all members, and each member's own."""

    shared: Float[Array, " shared"]
    own: Float[Array, "member own"]


class AbstractQuadratic(eqx.Module):
    """A cost and its Gauss–Newton model about a point.

    Attributes:
        cost: the cost itself.
        gradient: with respect to the shared unknowns.
    """

    cost: eqx.AbstractVar[Float[Array, ""]]
    gradient: eqx.AbstractVar[Float[Array, " shared"]]

    @property
    @abc.abstractmethod
    def least_damping(self) -> float:
        """Damping of the step that convergence is judged by: below it rounding decides."""

    @abc.abstractmethod
    def step(self, damping: Float[Array, ""], held: Bool[Array, " shared"]) -> Unknowns:
        """The damped step (Marquardt 1963), all unknowns scaled to a unit diagonal.

        Args:
            damping: added to the unit diagonal.
            held: shared unknowns that stay where they are.
        """

    @abc.abstractmethod
    def gain(self, step: Unknowns) -> Float[Array, ""]:
        """Decrease of the cost that the model promises."""


Quadratic = TypeVar("Quadratic", bound=AbstractQuadratic)


class NormalEquations(AbstractQuadratic):
    """Members (records, say) that meet through the shared unknowns only.

    The matrix is an arrow, and each member's block is eliminated on its own.

    Attributes:
        cost: the cost itself.
        gradient: with respect to the shared unknowns.
        matrix: Gauss–Newton matrix of the shared unknowns.
        own_gradient: with respect to the unknowns of each member.
        own_matrix: block of each member.
        coupling: between the shared unknowns and each member's.
    """

    cost: Float[Array, ""]
    gradient: Float[Array, " shared"]
    matrix: Float[Array, "shared shared"]
    own_gradient: Float[Array, "member own"]
    own_matrix: Float[Array, "member own own"]
    coupling: Float[Array, "member shared own"]

    @property
    def least_damping(self) -> float:
        """Directions that 1e-5 of the strongest shows are told apart: the matrix is squared."""
        return 1e-10

    def step(self, damping: Float[Array, ""], held: Bool[Array, " shared"]) -> Unknowns:
        """The damped step, by Cholesky factors."""
        scale = jnp.where(held, 0.0, _root(jnp.diag(self.matrix)))
        identity = jnp.eye(scale.shape[0])
        matrix = self.matrix * scale[:, None] * scale[None, :]
        matrix = matrix + damping * identity + jnp.diag(jnp.where(held, 1.0, 0.0))
        right = -self.gradient * scale
        members, own = self.own_gradient.shape
        if members * own == 0:
            solved = cho_solve((jnp.linalg.cholesky(matrix), True), right)
            return Unknowns(scale * solved, jnp.zeros((members, own)))
        own_scale = _root(jnp.diagonal(self.own_matrix, axis1=1, axis2=2))
        blocks = self.own_matrix * own_scale[:, :, None] * own_scale[:, None, :]
        factors = jnp.linalg.cholesky(blocks + damping * jnp.eye(own)[None])
        coupling = self.coupling * scale[None, :, None] * own_scale[:, None, :]
        own_right = -self.own_gradient * own_scale
        known = jnp.concatenate([coupling.mT, own_right[:, :, None]], axis=2)
        half = jax.scipy.linalg.solve_triangular(factors, known, lower=True)
        left, last = half[:, :, :-1], half[:, :, -1]
        matrix = matrix - jnp.einsum("kap,kaq->pq", left, left)
        right = right - jnp.einsum("kap,ka->p", left, last)
        solved = cho_solve((jnp.linalg.cholesky(matrix), True), right)
        own_solved = jax.scipy.linalg.solve_triangular(
            factors.mT, (last - left @ solved)[:, :, None], lower=False
        )[:, :, 0]
        return Unknowns(scale * solved, own_scale * own_solved)

    def gain(self, step: Unknowns) -> Float[Array, ""]:
        """−gᵀδ − ½ δᵀHδ."""
        shared, own = step
        slope = shared @ self.gradient + jnp.sum(own * self.own_gradient)
        bend = shared @ self.matrix @ shared
        bend += jnp.einsum("ka,kab,kb->", own, self.own_matrix, own)
        bend += 2.0 * jnp.einsum("p,kpa,ka->", shared, self.coupling, own)
        return -slope - 0.5 * bend


def _root(diagonal: Array) -> Array:
    """Reciprocal square roots; one where a diagonal entry is nothing (or no number)."""
    positive = diagonal > 0.0
    return jnp.where(positive, jax.lax.rsqrt(jnp.where(positive, diagonal, 1.0)), 1.0)


_FIRST_DAMPING = 1e-5
# From here a step that keeps its promise goes to the least damping at once.
_LITTLE_DAMPING = 1e-8
_REJECTED_DAMPING = 1e-3
_MOST_DAMPING = 1e12
_ROUNDING = 1e-13


class _Search(NamedTuple):
    point: Unknowns
    trial: Unknowns
    kept: Any
    first_kept: Any
    promised: Array
    equations: Any
    damping: Array
    steps: Array
    ended: Array
    converged: Array


def levenberg_marquardt(
    cost: Callable[[Unknowns], tuple[Float[Array, ""], Any]],
    linearise: Callable[[Unknowns, Any], Quadratic],
    start: Unknowns,
    bounds: Bounds,
    *,
    max_steps: int | Array = 50,
    tolerance: float | Array = 1e-8,
    near: bool | Array = False,
) -> tuple[Unknowns, Solution, tuple[Any, Any], Quadratic]:
    """Minimise a cost of many residuals from its quadratic models; never raises.

    For long records, where the Jacobian (and a QR factorisation of it at every trial, as
    `lpvid._solve.least_squares` does) costs more than all else, and for costs that are no sum of
    squares. The members' own unknowns are eliminated in every step, the first of which moves them
    alone. Bounds are kept by projection, so a solution may lie on them. Works under `jit` and
    `vmap`; not meant to be differentiated.

    Args:
        cost: the cost, and what `linearise` can use of it (residuals).
        linearise: cost and its Gauss–Newton model, from a point and what `cost` kept there; called
            at accepted points only.
        start: where to begin.
        bounds: of the shared unknowns; the start is moved inside.
        max_steps: limit on the trials, rejected ones included.
        tolerance: decrease of the cost that is not worth another step, absolute. For a cost that
            is a negative log likelihood, 1e-8 stops within 1.5e-4 standard deviations.
        near: whether the start is next to the solution: full steps at once.

    Returns:
        The best point seen; the solution: `value` its shared part, `cost` infinite and
        `nonfinite` the status where the start has no finite cost; what `cost` kept at the start
        and at the best point; and the quadratic model there.

    Example:
        >>> def cost(x):
        ...     return 0.5 * jnp.sum((x.shared - 3.0) ** 2), x.shared - 3.0
        >>> def linearise(x, residual):
        ...     own = jnp.zeros((0, 0)), jnp.zeros((0, 0, 0)), jnp.zeros((0, 1, 0))
        ...     return NormalEquations(0.5 * residual @ residual, residual, jnp.eye(1), *own)
        >>> start = Unknowns(jnp.zeros(1), jnp.zeros((0, 0)))
        >>> free = Bounds(jnp.array([-jnp.inf]), jnp.array([2.0]))
        >>> levenberg_marquardt(cost, linearise, start, free)[1].value.tolist()
        [2.0]
    """
    start = Unknowns(jnp.clip(start.shared, bounds.lower, bounds.upper), start.own)

    def advance(search: _Search) -> _Search:
        value, kept = cost(search.trial)
        gained = search.equations.cost - value
        accepted = jnp.isfinite(value) & (gained > 0.0)
        first = search.steps == 0
        kept_here = jax.tree.map(
            lambda new, old: jnp.where(accepted | first, new, old), kept, search.kept
        )
        kept_first = jax.tree.map(
            lambda new, old: jnp.where(first, new, old), kept, search.first_kept
        )
        point, equations = jax.lax.cond(
            accepted,
            lambda: (search.trial, linearise(search.trial, kept)),
            lambda: (search.point, search.equations),
        )
        # A model that promised well is trusted more; a rejected step is tried much shorter.
        good = gained > 0.5 * search.promised
        damping = jnp.where(accepted, jnp.where(good, 0.1, 1.0), 10.0) * search.damping
        damping = jnp.where(accepted, damping, jnp.maximum(damping, _REJECTED_DAMPING))
        damping = jnp.where(damping < _LITTLE_DAMPING, equations.least_damping, damping)
        damping = jnp.where(
            first, jnp.where(near, equations.least_damping, _FIRST_DAMPING), damping
        )
        states_only = first & ~jnp.asarray(near)

        lower = (point.shared <= bounds.lower) & (equations.gradient >= 0.0)
        upper = (point.shared >= bounds.upper) & (equations.gradient <= 0.0)
        held = lower | upper
        # Both steps by one compiled solver: the whole one to judge by, the damped one to take.
        steps = jax.vmap(equations.step)(
            jnp.stack([jnp.asarray(equations.least_damping), damping]),
            jnp.stack([held, held | states_only]),
        )
        whole, step = (jax.tree.map(lambda leaf, i=i: leaf[i], steps) for i in range(2))
        # Beyond the cost's own rounding no step can be judged.
        enough = tolerance + _ROUNDING * jnp.abs(equations.cost)
        converged = equations.gain(whole) <= enough
        shared = jnp.clip(point.shared + step.shared, bounds.lower, bounds.upper)
        step = Unknowns(shared - point.shared, step.own)
        count = search.steps + 1
        stuck = ~jnp.isfinite(equations.cost) | (damping > _MOST_DAMPING) | (count >= max_steps)
        return _Search(
            point=point,
            trial=Unknowns(shared, point.own + step.own),
            kept=kept_here,
            first_kept=kept_first,
            promised=equations.gain(step),
            equations=equations,
            damping=damping,
            steps=count,
            ended=converged | stuck,
            converged=converged,
        )

    def both(x):
        kept = cost(x)[1]
        return linearise(x, kept), kept

    empty, nothing = jax.tree.map(
        lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(both, start)
    )
    infinite = eqx.tree_at(lambda e: e.cost, empty, jnp.asarray(jnp.inf))
    no = jnp.asarray(False)
    zero = jnp.asarray(0.0)
    begun = _Search(start, start, nothing, nothing, zero, infinite, zero, jnp.asarray(0), no, no)
    found = jax.lax.while_loop(lambda search: ~search.ended, advance, begun)
    value = found.equations.cost
    ended = Status.where(found.converged, Status.successful, Status.max_steps)
    solution = Solution(
        value=found.point.shared,
        cost=jnp.where(jnp.isfinite(value), value, jnp.inf),
        status=Status.where(jnp.isfinite(value), ended, Status.nonfinite),
        steps=found.steps,
    )
    return found.point, solution, (found.first_kept, found.kept), found.equations
