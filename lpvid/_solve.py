"""Minimisation: the one place that calls optimistix and jaxopt.

Adds to them what every problem here needs: bounds (by a change of variables), never a worse point
than the start, and one status enumeration. Several starts go through `jax.vmap`.
"""

import warnings
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jaxtyping import Array, Float

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
    stop_if_stuck: bool = False,
) -> Solution:
    """Minimise a smooth function by L-BFGS (zoom line search) from one start; never raises.

    Works under `jit` and `vmap` over `start`.

    Args:
        loss: smooth function of the parameters.
        start: where to begin.
        max_steps: limit on the steps.
        tolerance: on the gradient's norm.
        stop_if_stuck: end when a line search fails, as at a kink, where more steps only cost time.

    Returns:
        The better one of the last point and the start, its cost (infinite where it is not finite)
        and the status: `successful`, `max_steps` or `nonfinite`.

    Example:
        >>> minimise(lambda x: jnp.sum((x - 3.0) ** 2), jnp.zeros(1)).value.round(6).tolist()
        [3.0]
    """
    solver = jaxopt.LBFGS(
        loss,
        maxiter=max_steps,
        tol=tolerance,
        history_size=12,
        stop_if_linesearch_fails=stop_if_stuck,
        jit=True,
    )
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
