"""The certificate of a minimum: how far zero is from the subgradients of the norm."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lpvid._solve import Bounds
from lpvid.models import AbstractStructure
from lpvid.restructure._bundle import Descent, bound_rows
from lpvid.restructure._local_model import (
    adjoint_product,
    cutting_planes,
    expand,
    gram_eigenvectors,
)
from lpvid.restructure._matching import Target
from lpvid.restructure._peaks import error_at, join_places, plateau
from lpvid.restructure._quadratic import join_rows, minimise_level

# A bound counts as reached within this share of a unit step.
_AT_BOUND = 1e-6
# Singular vectors taken up one after the other where several gains are largest together.
_TURNS = 12


class Certificate(eqx.Module):
    """Proof that no small step lowers ‖G(ϑ) − G_i‖∞ to first order, or how far from one.

    Slopes are those of the norm's logarithm along the columns of `scaling`, steps that change the
    response (root mean square) by as much as the whole error that is left. The shortest vector
    among the subgradients at the active frequencies (and the normals of bounds that are reached)
    is the steepest descent: a unit step can lower the norm by the share `distance` at most, to
    first order. Zero says that the point is stationary.

    Attributes:
        distance: length of the shortest subgradient.
        tolerance: what it has to stay below; gains within this share of the norm are active.
        frequencies: peaks of the gain, rad/s, at the point and at the last trial that was refused,
            the last of each far beyond all poles; then some, repeated where there are few, at
            which the gain is within the tolerance of the norm. Lines of the grid where a grid is
            the target.
        gains: largest singular value at each.
        active: which of them are within the tolerance of the norm.
        multipliers: weight of each frequency in the shortest subgradient; they sum to one.
        at_bound: parameters that a bound holds.
        scaling: directions of a unit step, as columns.
        certified: whether the distance is below the tolerance, or nothing but rounding is left
            of the norm.
    """

    distance: Float[Array, "*batch"]
    tolerance: Float[Array, "*batch"]
    frequencies: Float[Array, "*batch peak"]
    gains: Float[Array, "*batch peak"]
    active: Bool[Array, "*batch peak"]
    multipliers: Float[Array, "*batch peak"]
    at_bound: Bool[Array, "*batch parameter"]
    scaling: Float[Array, "*batch parameter direction"]
    certified: Bool[Array, "*batch"]


def certify(
    structure: AbstractStructure, descent: Descent, target: Target, tolerance: float
) -> Certificate:
    """Shortest convex combination of the subgradients at a descent's end.

    Where the largest singular value is multiple, the subgradients of a frequency are not finitely
    many: the vectors of the leading eigenspace that matter are found one by one, each the steepest
    against the combination of those before.
    """
    point, shape = descent.value, descent.scaling
    bounds = Bounds(*structure.bounds())
    peaks = descent.peaks
    places = join_places(peaks.places, descent.others)
    if target.black_box is not None:
        places = join_places(places, plateau(structure, point, target, peaks, tolerance))
    count, n = places.omega.shape[0], point.shape[0]
    model = expand(error_at(structure, point, shape, target, places), n, count)
    gains = jnp.sqrt(model.gains[:, 0])
    active = gains >= (1.0 - tolerance) * peaks.norm
    leading = jnp.sqrt(model.gains / model.top) >= 1.0 - tolerance
    dtype = model.slopes.dtype
    turns = 1 if model.error.shape[2] == 1 else _TURNS
    held = bound_rows(bounds, point, shape)
    held = held.only(held.limits <= _AT_BOUND * jnp.linalg.norm(held.slopes, axis=1))

    def solve(index, carry):
        directions, _, _ = carry
        there = (jnp.arange(turns)[:, None] <= index) & active[None, :]
        cuts = join_rows(*(cutting_planes(model, v) for v in directions)).only(there.reshape(-1))
        # Active is active: what is left of a gap does not count.
        cuts = cuts._replace(limits=jnp.where(there.reshape(-1), 0.0, cuts.limits))
        normals = held._replace(limits=jnp.where(held.limits < 1.0, 0.0, held.limits))
        found = minimise_level(jnp.eye(n), join_rows(cuts, normals))
        moved = jnp.einsum("d,dfos->fos", found.x.astype(dtype), model.slopes)
        change = adjoint_product(model.error, moved)
        change = change + jnp.conj(jnp.swapaxes(change, 1, 2))
        inside = adjoint_product(model.vectors, change @ model.vectors)
        both = leading[:, :, None] & leading[:, None, :]
        apart = jnp.where(leading, 0.0, -1e6 * model.top)
        outside = apart[:, :, None] * jnp.eye(leading.shape[1])[None]
        inside = jnp.where(both, inside, outside.astype(inside.dtype))
        chosen = jnp.einsum("fsk,fk->fs", model.vectors, gram_eigenvectors(inside)[1][:, :, 0])
        after = (jnp.arange(turns) == index + 1)[:, None, None]
        weights = jnp.sum(found.multipliers[: turns * count].reshape(turns, count), axis=0)
        return jnp.where(after, chosen[None], directions), found.x, jnp.where(active, weights, 0.0)

    first = jnp.broadcast_to(model.vectors[None, :, :, 0], (turns, count, model.error.shape[2]))
    begun = (first, jnp.zeros(n), jnp.zeros(count))
    _, shortest, multipliers = jax.lax.fori_loop(0, turns, solve, begun)
    # Where the numbers overflow nothing is known.
    distance = jnp.nan_to_num(jnp.linalg.norm(shortest), nan=jnp.inf)
    exact = peaks.norm <= peaks.floor
    upper, lower = bounds.upper - point, point - bounds.lower
    reach = _AT_BOUND * jnp.linalg.norm(shape, axis=1)
    return Certificate(
        distance=distance,
        tolerance=jnp.asarray(tolerance),
        frequencies=places.omega,
        gains=gains,
        active=active,
        multipliers=multipliers,
        at_bound=jnp.minimum(upper, lower) <= reach,
        scaling=shape,
        certified=(distance <= tolerance) | exact,
    )
