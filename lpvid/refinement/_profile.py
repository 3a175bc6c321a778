"""Profile likelihood: how the best fit worsens as one parameter is held elsewhere."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from lpvid._results import Status
from lpvid._solve import Bounds
from lpvid.data import IOData
from lpvid.refinement._offset import taken_out, without_constants
from lpvid.refinement._parameterisation import padded_records
from lpvid.refinement._refined import Refined
from lpvid.refinement._search import search


class ProfileLikelihood(eqx.Module):
    """Cost of the best fit against the value of one parameter.

    Attributes:
        name: the parameter.
        estimate: where the fit put it.
        values: where it was held, ascending.
        increase: cost of the best fit there over the fit's own: half the likelihood ratio.
        standard_error: of the fit; a parabola of that width is what the covariance says.
        status: how each search ended.
    """

    name: str = eqx.field(static=True)
    estimate: Float[Array, ""]
    values: Float[Array, " point"]
    increase: Float[Array, " point"]
    standard_error: Float[Array, ""]
    status: Status

    def interval(self, level: float = 0.95) -> Float[Array, "2"]:
        """Where the likelihood ratio crosses the quantile of χ² with one degree of freedom.

        Unlike the covariance's interval it follows a skewed likelihood. Infinite on a side where
        the values held do not reach the crossing.

        Args:
            level: share of intervals that contain the truth, between 0 and 1.

        Raises:
            ValueError: the level is not between 0 and 1.
        """
        if not 0.0 < level < 1.0:
            raise ValueError(f"level: a share between 0 and 1 is needed, got {level}.")
        reach = float(jax.scipy.stats.norm.ppf(0.5 + 0.5 * level))
        # Signed roots of the ratio: nearly straight lines, so interpolation is good.
        root = np.sqrt(2.0 * np.maximum(np.asarray(self.increase), 0.0))
        values, centre = np.asarray(self.values), float(self.estimate)
        ends = []
        for side in (-1.0, 1.0):
            outside = (values - centre) * side > 0.0
            at = np.argsort(np.abs(values[outside] - centre))
            roots = np.concatenate([[0.0], root[outside][at]])
            places = np.concatenate([[centre], values[outside][at]])
            beyond = np.flatnonzero(roots >= reach)
            if not beyond.size:
                ends.append(side * np.inf)
                continue
            last = int(beyond[0])
            share = (reach - roots[last - 1]) / (roots[last] - roots[last - 1])
            ends.append(places[last - 1] + share * (places[last] - places[last - 1]))
        return jnp.asarray(ends)


def profile_likelihood(
    refined: Refined,
    data: IOData,
    name: str,
    *,
    points: ArrayLike | None = None,
    max_steps: int = 100,
) -> ProfileLikelihood:
    """Hold one parameter at several values and fit the rest again at each.

    Tells whether the interval from the covariance can be trusted: it can where the increase is a
    parabola. Each search starts from its neighbour's solution and uses the fit's compiled code.

    Args:
        refined: of a model whose parameters have a meaning of their own (no black box).
        data: the records that it was fitted to.
        name: the parameter, as in `refined.parameter_names`.
        points: values to hold it at; by default 13 within three standard errors and its bounds.
        max_steps: limit on the trial steps at each.

    Returns:
        The increase of the cost at every value.

    Raises:
        ValueError: the parameter is unknown, fixed, or an entry of a black box, or the loss is
            robust.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.models import FunctionStructure, StructuredModel
        >>> lag = FunctionStructure(lambda p: (-p[:1, None], p[:1, None], jnp.eye(1)), nominal=1.0)
        >>> rng = np.random.default_rng(0)
        >>> u = rng.standard_normal(100)
        >>> y = StructuredModel(lag, [2.0]).simulate(u=u, dt=0.1)[:, 0]
        >>> data = IOData(u=u, y=y + 0.1 * rng.standard_normal(100), dt=0.1)
        >>> fit = refine(StructuredModel(lag, [1.0]), data)
        >>> profile_likelihood(fit, data, "parameter 1").interval().shape
        (2,)
    """
    task = refined.task
    if task.loss.rounds > 1:
        raise ValueError(
            "refined: a robust loss is no likelihood (its scale is estimated apart); refine with "
            "SquaredLoss() for a profile."
        )
    offset = taken_out(refined)
    if offset is not None:
        data = without_constants(data, offset)
    if name not in refined.parameter_names:
        raise ValueError(
            f"name: there is no parameter {name!r}; there are {', '.join(refined.parameter_names)}."
        )
    if task.parameterisation.gauge(refined.parameters) is not None:
        if name.startswith(("D", "offset")):
            raise ValueError(
                f"name: {name!r} of a black box has no profile: it is searched in coordinates that "
                "mix all values. Use its confidence_intervals(), or profile a StructuredModel."
            )
        raise ValueError(
            "refined: the entries of a black box depend on the basis of its state; profile a "
            "StructuredModel."
        )
    row = refined.parameter_names.index(name)
    column = int(np.argmax(np.asarray(task.selection.matrix[row])))
    if not task.selection.matrix[row, column] > 0.0:
        raise ValueError(f"name: {name!r} was fixed.")
    estimate, error = refined.parameters[row], refined.standard_errors[row]
    lower, upper = task.bounds.lower[column], task.bounds.upper[column]
    if points is None:
        width = jnp.where(jnp.isfinite(error), error, jnp.maximum(jnp.abs(estimate), 1.0))
        values = np.unique(np.clip(estimate + width * jnp.linspace(-3.0, 3.0, 13), lower, upper))
    else:
        values = np.unique(np.asarray(points, float).reshape(-1))
    records = padded_records(data)
    found = task.selection.chosen(refined.parameters)
    own = task.own(*records[1].shape)
    if task.free_start:
        own = own.at[:, : refined.x0.shape[1]].set(refined.x0)
    increase, statuses = np.zeros(values.size), [Status.successful] * values.size
    centre = int(np.searchsorted(values, float(estimate)))
    for side in (range(centre, values.size), range(centre - 1, -1, -1)):
        chosen, starts = found, own
        for i in side:
            held = Bounds(
                task.bounds.lower.at[column].set(values[i]),
                task.bounds.upper.at[column].set(values[i]),
            )
            there = eqx.tree_at(lambda t: t.bounds, task, held)
            at = search(there, *records, chosen, starts, jnp.asarray(max_steps))
            chosen, starts = at.chosen, at.own
            increase[i] = float(at.solution.cost - refined.cost)
            statuses[i] = at.solution.status
    return ProfileLikelihood(
        name=name,
        estimate=estimate,
        values=jnp.asarray(values),
        increase=jnp.asarray(increase),
        standard_error=error,
        status=jax.tree.map(lambda *each: jnp.stack(each), *statuses),
    )
