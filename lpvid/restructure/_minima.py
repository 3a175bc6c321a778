"""How many searches ended in one minimum, and how many minima there are."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from lpvid._results import Solution, Status
from lpvid.models import AbstractStructure
from lpvid.restructure._matching import Target, channel_weights, response_error

# Two searches ended in the same minimum if their costs differ by less than this share of it ...
_SAME_COST = 0.02
# ... or by less than this: exact matches.
_NO_COST = 1e-16


class Tally(NamedTuple):
    """What the searches say together.

    Attributes:
        costs: of each search, sorted.
        hits: searches that ended in the best minimum.
        minima: distinct minima among the searches that converged, and the best point.
        margin: cost of the next distinct minimum over the best one's.
    """

    costs: Float[Array, " start"]
    hits: Int[Array, ""]
    minima: Int[Array, ""]
    margin: Float[Array, ""]


def tally(structure: AbstractStructure, found: Solution, target: Target) -> Tally:
    """Sort the searches' end points into minima: one cost *and* one model.

    About a minimum of cost c a point of cost c + δ has a response √(2δ) away, in the norm of the
    cost; two such points lie at most twice that apart. So points of nearly one cost whose
    responses lie further apart are different models, and different parameters of one response
    (modes in another order) are the same. A search that ran out of steps tells of no minimum.
    """
    order = jnp.argsort(found.cost)
    costs = found.cost[order]
    converged = (found.status == Status.successful)[order] & jnp.isfinite(costs)
    converged = converged.at[0].set(jnp.isfinite(costs[0]))
    scale = channel_weights(target)[None] / jnp.sqrt(float(target.response.size))
    errors = jax.vmap(lambda p: response_error(structure, p, target))(found.value[order])
    errors = jnp.stack([jnp.real(errors), jnp.imag(errors)]) * scale[None, None]
    errors = jnp.moveaxis(errors, 1, 0).reshape(costs.shape[0], -1)
    apart = jnp.sum((errors[:, None] - errors[None]) ** 2, axis=2)
    # The lower cost of each pair, as they are sorted; infinite costs are nobody's equals.
    low = jnp.minimum(costs[:, None], costs[None])
    slack = _SAME_COST * low + _NO_COST
    same = (jnp.abs(costs[:, None] - costs[None]) <= slack) & (apart <= 8.0 * slack)
    earlier = jnp.tril(jnp.ones(same.shape, bool), -1) & converged[None]
    new = converged & ~jnp.any(same & earlier, axis=1)
    others = jnp.where(converged & ~same[0], costs, jnp.inf)
    return Tally(
        costs=costs,
        hits=jnp.sum(same[0]),
        minima=jnp.sum(new),
        margin=jnp.min(others) / jnp.maximum(costs[0], 1e-300),
    )
