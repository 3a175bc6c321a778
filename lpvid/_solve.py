"""Minimisation: the one place that calls optimistix and jaxopt; long records by their own search.

Adds to them what every problem here needs: bounds (by a change of variables), never a worse point
than the start, and one status enumeration. Several starts go through `jax.vmap`.
"""

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Bool, Float

from lpvid._results import Solution, Status

with warnings.catch_warnings():
    # Unmaintained but complete; its one warning on import is known.
    warnings.filterwarnings("ignore", message="JAXopt is no longer maintained")
    import jaxopt

Parameters = Float[Array, " parameter"]


class Bounds(eqx.Module):
    """Lower and upper bounds, with the smooth change of variables that keeps within them.

    A one-sided bound becomes an exponential, a two-sided one a logistic curve; a free parameter
    stays itself, and one with equal bounds is fixed.

    Attributes:
        lower: lower bounds, minus infinity where there is none.
        upper: upper bounds, infinity where there is none.

    Example:
        >>> bounds = Bounds(jnp.array([0.0]), jnp.array([jnp.inf]))
        >>> round(bounds.bounded(bounds.free(jnp.array([2.0]))).item(), 12)
        2.0
    """

    lower: Parameters
    upper: Parameters

    def free(self, bounded: Parameters) -> Parameters:
        """Unbounded coordinates of a point, which is first moved just inside the bounds."""
        low, high, has_low, has_high = self._finite()
        two_sided = has_low & has_high & (high > low)
        width = jnp.where(two_sided, high - low, 1.0)
        share = jnp.where(two_sided, jnp.clip((bounded - low) / width, 1e-8, 1.0 - 1e-8), 0.5)
        # With one bound there is no width to measure by: a point inside stays, however near.
        margin = 1e-8 * jnp.maximum(jnp.abs(bounded), 1.0)
        inside = jnp.where(has_low & (bounded <= low), low + margin, bounded)
        inside = jnp.where(has_high & (bounded >= high), high - margin, inside)
        both = jnp.log(share) - jnp.log1p(-share)
        above = jnp.log(jnp.where(has_low & ~has_high, inside - low, 1.0))
        below = -jnp.log(jnp.where(has_high & ~has_low, high - inside, 1.0))
        one = jnp.where(has_low, above, jnp.where(has_high, below, inside))
        return jnp.where(has_low & has_high, both, one)

    def bounded(self, free: Parameters) -> Parameters:
        """The point within the bounds that has these unbounded coordinates."""
        low, high, has_low, has_high = self._finite()
        both = low + (high - low) * jax.nn.sigmoid(free)
        # Exponentials only where they are used: elsewhere they could overflow and poison gradients.
        above = low + jnp.exp(jnp.where(has_low & ~has_high, free, 0.0))
        below = high - jnp.exp(-jnp.where(has_high & ~has_low, free, 0.0))
        one = jnp.where(has_low, above, jnp.where(has_high, below, free))
        return jnp.where(has_low & has_high, both, one)

    def _finite(self):
        has_low, has_high = jnp.isfinite(self.lower), jnp.isfinite(self.upper)
        low = jnp.where(has_low, self.lower, 0.0)
        # A width of one where there are no two bounds keeps the unused branch finite.
        high = jnp.where(has_high, self.upper, low + 1.0)
        return low, high, has_low, has_high


def _status(result, cost) -> Status:
    ended = Status.where(result == optx.RESULTS.successful, Status.successful, Status.max_steps)
    return Status.where(jnp.isfinite(cost), ended, Status.nonfinite)


def least_squares(
    residual: Callable[[Parameters], Array],
    start: Parameters,
    *,
    max_steps: int = 80,
    tolerance: float = 1e-8,
) -> Solution:
    """Minimise half the sum of squares of a residual from one start; never raises.

    Levenberg–Marquardt, the Jacobian taken in forward mode. Use `jax.vmap` over `start` for several
    starts. Works under `jit`; derivatives of the minimum follow from the implicit function theorem.

    Args:
        residual: function of the parameters, real values of any shape.
        start: where to begin.
        max_steps: limit on the steps, rejected ones included.
        tolerance: relative and absolute, on the last step and its gain.

    Returns:
        The best point seen, half the sum of squares there (infinite where it is not finite) and the
        status: `successful`, `max_steps` or `nonfinite`.

    Example:
        >>> least_squares(lambda x: x - 3.0, jnp.zeros(1)).value.round(6).tolist()
        [3.0]
    """
    solver = optx.BestSoFarLeastSquares(
        optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance, linear_solver=lx.QR())
    )
    solution = optx.least_squares(
        lambda x, _: residual(x),
        solver,
        start,
        max_steps=max_steps,
        throw=False,
        adjoint=optx.ImplicitAdjoint(),
    )
    cost = 0.5 * jnp.sum(residual(solution.value) ** 2)
    return Solution(
        value=solution.value,
        cost=jnp.where(jnp.isfinite(cost), cost, jnp.inf),
        status=_status(solution.result, cost),
        steps=jnp.asarray(solution.stats["num_steps"]),
    )


def minimise(
    loss: Callable[[Parameters], Float[Array, ""]],
    start: Parameters,
    *,
    max_steps: int = 50,
    tolerance: float = 1e-9,
) -> Solution:
    """Minimise a smooth function by L-BFGS (zoom line search) from one start; never raises.

    Works under `jit` and `vmap` over `start`.

    Args:
        loss: smooth function of the parameters.
        start: where to begin.
        max_steps: limit on the steps.
        tolerance: on the gradient's norm.

    Returns:
        The better one of the last point and the start, its cost (infinite where it is not finite)
        and the status: `successful`, `max_steps` or `nonfinite`.

    Example:
        >>> minimise(lambda x: jnp.sum((x - 3.0) ** 2), jnp.zeros(1)).value.round(6).tolist()
        [3.0]
    """
    solver = jaxopt.LBFGS(loss, maxiter=max_steps, tol=tolerance, history_size=12, jit=True)
    value, state = solver.run(start)
    cost, first = loss(value), loss(start)
    # A line search that fails may leave a worse point than it came from.
    better = jnp.isfinite(cost) & ((cost <= first) | ~jnp.isfinite(first))
    value = jnp.where(better, value, start)
    cost = jnp.where(better, cost, first)
    ended = Status.where(state.error <= tolerance, Status.successful, Status.max_steps)
    return Solution(
        value=value,
        cost=jnp.where(jnp.isfinite(cost), cost, jnp.inf),
        status=Status.where(jnp.isfinite(cost), ended, Status.nonfinite),
        steps=jnp.asarray(state.iter_num),
    )


class NormalEquations(eqx.Module):
    """A cost and its quadratic model in shared unknowns and in unknowns of each member's own.

    Members (records, say) meet through the shared unknowns only: the matrix is an arrow, and each
    member's block is eliminated on its own.

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


class Unknowns(NamedTuple):
    """Unknowns shared by all members, and each member's own."""

    shared: Float[Array, " shared"]
    own: Float[Array, "member own"]


# Damping of the step that convergence is judged by: directions below it cannot be told apart.
_LEAST_DAMPING = 1e-10
_FIRST_DAMPING = 1e-5
_REJECTED_DAMPING = 1e-3
_MOST_DAMPING = 1e12
_ROUNDING = 1e-13


def _root(diagonal: Array) -> Array:
    """Reciprocal square roots; one where a diagonal entry is nothing (or no number)."""
    positive = diagonal > 0.0
    return jnp.where(positive, jax.lax.rsqrt(jnp.where(positive, diagonal, 1.0)), 1.0)


def damped_step(
    equations: NormalEquations, damping: Float[Array, ""], held: Bool[Array, " shared"]
) -> Unknowns:
    """Step of the damped normal equations, both kinds of unknowns scaled to a unit diagonal.

    Args:
        equations: quadratic model of the cost.
        damping: added to the unit diagonal (Marquardt 1963).
        held: shared unknowns that stay where they are.
    """
    scale = jnp.where(held, 0.0, _root(jnp.diagonal(equations.matrix)))
    identity = jnp.eye(scale.shape[0])
    matrix = equations.matrix * scale[:, None] * scale[None, :]
    matrix = matrix + damping * identity + jnp.diag(jnp.where(held, 1.0, 0.0))
    right = -equations.gradient * scale
    members, own = equations.own_gradient.shape
    if members * own == 0:
        solved = cho_solve((jnp.linalg.cholesky(matrix), True), right)
        return Unknowns(scale * solved, jnp.zeros((members, own)))
    own_scale = _root(jnp.diagonal(equations.own_matrix, axis1=1, axis2=2))
    blocks = equations.own_matrix * own_scale[:, :, None] * own_scale[:, None, :]
    factors = jnp.linalg.cholesky(blocks + damping * jnp.eye(own)[None])
    coupling = equations.coupling * scale[None, :, None] * own_scale[:, None, :]
    own_right = -equations.own_gradient * own_scale
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


def _gain(equations: NormalEquations, step: Unknowns) -> Float[Array, ""]:
    """Decrease of the cost that the quadratic model promises."""
    shared, own = step
    slope = shared @ equations.gradient + jnp.sum(own * equations.own_gradient)
    bend = shared @ equations.matrix @ shared
    bend += jnp.einsum("ka,kab,kb->", own, equations.own_matrix, own)
    bend += 2.0 * jnp.einsum("p,kpa,ka->", shared, equations.coupling, own)
    return -slope - 0.5 * bend


class _Search(NamedTuple):
    point: Unknowns
    trial: Unknowns
    kept: Any
    first_kept: Any
    promised: Array
    equations: NormalEquations
    damping: Array
    steps: Array
    ended: Array
    converged: Array


def levenberg_marquardt(
    cost: Callable[[Unknowns], tuple[Float[Array, ""], Any]],
    linearise: Callable[[Unknowns, Any], NormalEquations],
    start: Unknowns,
    bounds: Bounds,
    *,
    max_steps: int | Array = 50,
    tolerance: float = 1e-8,
) -> tuple[Unknowns, Solution, tuple[Any, Any]]:
    """Minimise a cost of many residuals from its normal equations; never raises.

    For long records, where the Jacobian (and a QR factorisation of it at every trial, as
    `least_squares` does) costs more than all else. The members' own unknowns are eliminated in
    every step, the first of which moves them alone. Bounds are kept by projection, so a solution
    may lie on them. Works under `jit` and `vmap`; not meant to be differentiated.

    Args:
        cost: the cost, and what `linearise` can use of it (residuals).
        linearise: cost and its Gauss–Newton model, from a point and what `cost` kept there; called
            at accepted points only.
        start: where to begin.
        bounds: of the shared unknowns; the start is moved inside.
        max_steps: limit on the trials, rejected ones included.
        tolerance: decrease of the cost that is not worth another step, absolute. For a cost that
            is a negative log likelihood, 1e-8 stops within 1.5e-4 standard deviations.

    Returns:
        The best point seen; the solution: `value` its shared part, `cost` infinite and
        `nonfinite` the status where the start has no finite cost; and what `cost` kept at the
        start and at the best point.

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
        damping = jnp.clip(damping, _LEAST_DAMPING, None)
        damping = jnp.where(first, _FIRST_DAMPING, damping)

        lower = (point.shared <= bounds.lower) & (equations.gradient >= 0.0)
        upper = (point.shared >= bounds.upper) & (equations.gradient <= 0.0)
        held = lower | upper
        # Both steps by one compiled solver: the whole one to judge by, the damped one to take.
        steps = jax.vmap(damped_step, in_axes=(None, 0, 0))(
            equations,
            jnp.stack([jnp.asarray(_LEAST_DAMPING), damping]),
            jnp.stack([held, held | first]),
        )
        whole, step = (jax.tree.map(lambda leaf, i=i: leaf[i], steps) for i in range(2))
        # Beyond the cost's own rounding no step can be judged.
        enough = tolerance + _ROUNDING * jnp.abs(equations.cost)
        converged = _gain(equations, whole) <= enough
        shared = jnp.clip(point.shared + step.shared, bounds.lower, bounds.upper)
        step = Unknowns(shared - point.shared, step.own)
        count = search.steps + 1
        stuck = ~jnp.isfinite(equations.cost) | (damping > _MOST_DAMPING) | (count >= max_steps)
        return _Search(
            point=point,
            trial=Unknowns(shared, point.own + step.own),
            kept=kept_here,
            first_kept=kept_first,
            promised=_gain(equations, step),
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
    return found.point, solution, (found.first_kept, found.kept)
