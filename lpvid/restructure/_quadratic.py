"""The small convex quadratic programs of the bundle, by a primal-dual interior-point method."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Float

# Complementarity that ends the iteration, and the share of the way to the boundary that is gone.
_GAP = 1e-14
_BACK_OFF = 0.995


class Rows(NamedTuple):
    """Linear constraints `slopes · x − lifted t ≤ limits`.

    A row with `lifted` one is a cutting plane of a function below t, one with zero an ordinary
    constraint.
    """

    slopes: Float[Array, "row direction"]
    lifted: Float[Array, " row"]
    limits: Float[Array, " row"]

    def only(self, kept: Array) -> "Rows":
        """The rows that are kept; the others become 0 ≤ 1."""
        return Rows(
            jnp.where(kept[:, None], self.slopes, 0.0),
            jnp.where(kept, self.lifted, 0.0),
            jnp.where(kept, self.limits, 1.0),
        )


class QuadraticProgram(NamedTuple):
    """Solution: the point, the level t and a multiplier for each row (lifted ones sum to one)."""

    x: Float[Array, " direction"]
    level: Float[Array, ""]
    multipliers: Float[Array, " row"]


def join_rows(*parts: Rows) -> Rows:
    """All rows in one."""
    return Rows(*(jnp.concatenate(fields) for fields in zip(*parts, strict=True)))


def minimise_level(
    metric: Float[Array, "direction direction"], rows: Rows, *, max_steps: int = 40
) -> QuadraticProgram:
    """Minimise t + ½ xᵀ·metric·x under the rows: a bundle's step with its multipliers.

    Mehrotra's predictor-corrector method (S. Mehrotra, SIAM J. Optim. 2 (1992) 575-601), which
    takes the same few steps whatever rows are active; the metric must be positive definite and
    x = 0 within the rows that are not lifted. Works under `jit` and `vmap`.

    Args:
        metric: of the proximal term.
        rows: cutting planes and constraints.
        max_steps: limit on the steps.
    """
    n = metric.shape[0]
    count = rows.limits.shape[0]
    matrix = jnp.concatenate([rows.slopes, -rows.lifted[:, None]], axis=1)
    curvature = jnp.zeros((n + 1, n + 1)).at[:n, :n].set(metric)
    slope = jnp.zeros(n + 1).at[n].set(1.0)

    def factorised(weights):
        normal = curvature + matrix.T @ (weights[:, None] * matrix)
        return cho_factor(normal, lower=True)

    # Far enough inside, by the least-squares start: residuals then vanish before the slacks do.
    right = matrix.T @ rows.limits - slope
    start = cho_solve(factorised(jnp.ones(count)), right)
    room = rows.limits - matrix @ start
    slack = jnp.maximum(jnp.abs(room), 1.0)
    multipliers = jnp.maximum(jnp.abs(room), 1.0)

    def longest(values, steps):
        ratio = jnp.where(steps < 0.0, -values / jnp.where(steps < 0.0, steps, -1.0), jnp.inf)
        return jnp.minimum(1.0, _BACK_OFF * jnp.min(ratio))

    def advance(carry):
        z, s, y, step, _ = carry
        dual = curvature @ z + slope + matrix.T @ y
        primal = matrix @ z + s - rows.limits
        gap = s @ y / count
        factor = factorised(y / s)

        def direction(complementary):
            right = -dual - matrix.T @ ((y * primal - complementary) / s)
            dz = cho_solve(factor, right)
            ds = -primal - matrix @ dz
            return dz, ds, -(complementary + y * ds) / s

        _, ds, dy = direction(s * y)
        predicted = (s + longest(s, ds) * ds) @ (y + longest(y, dy) * dy) / count
        # Slacks must not vanish before the residuals do: then no step is long enough to mend them.
        behind = jnp.maximum(jnp.max(jnp.abs(dual)), jnp.max(jnp.abs(primal))) > gap
        centred = gap * jnp.maximum((predicted / gap) ** 3, jnp.where(behind, 0.2, 0.0))
        dz, ds, dy = direction(s * y + ds * dy - centred)
        ahead, up = longest(s, ds), longest(y, dy)
        # One length for both: the quadratic term couples them.
        length = jnp.minimum(ahead, up)
        new = (z + length * dz, s + length * ds, y + length * dy)
        sound = jnp.all(jnp.stack([jnp.all(jnp.isfinite(part)) for part in new]))
        new = jax.tree.map(lambda a, b: jnp.where(sound, a, b), new, (z, s, y))
        error = jnp.maximum(jnp.max(jnp.abs(dual)), jnp.max(jnp.abs(primal)))
        ended = ~sound | ((gap < _GAP) & (error < 1e-11))
        return (*new, step + 1, ended)

    begun = (start, slack, multipliers, jnp.asarray(0), jnp.asarray(False))
    z, _, y, _, _ = jax.lax.while_loop(lambda c: (c[3] < max_steps) & ~c[4], advance, begun)
    return QuadraticProgram(z[:n], z[n], y)
