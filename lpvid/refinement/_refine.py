"""Refinement: maximum likelihood from a start, by Levenberg–Marquardt over the records."""

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from lpvid._results import Status
from lpvid._solve import Bounds
from lpvid.data import IOData
from lpvid.refinement._coordinates import Selection, Ties, matching, select
from lpvid.refinement._losses import AbstractLoss, SquaredLoss
from lpvid.refinement._offset import (
    Constants,
    WithOffset,
    starting_offset,
    without_constants,
)
from lpvid.refinement._parameterisation import (
    AbstractParameterisation,
    LinearParameterisation,
    channel_sizes,
    padded_records,
)
from lpvid.refinement._predictors import AbstractPredictor, OutputError
from lpvid.refinement._recognise import Start, recognise
from lpvid.refinement._refined import Refined
from lpvid.refinement._search import Outcome, Task, assess, search


def refine(
    model: Any,
    data: IOData,
    *,
    predictor: AbstractPredictor | None = None,
    loss: AbstractLoss | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    fixed: Sequence[str] = (),
    tied: Ties = (),
    initial_state: str | ArrayLike = "free",
    output_offset: str | ArrayLike | None = None,
    max_steps: int = 100,
    throw: bool = True,
) -> Refined:
    r"""Fit a model to records by maximum likelihood, starting from a model of the same kind.

    Minimises $\frac N2 \log\det \hat\Lambda$ of the residual y − ŷ (or a robust loss) over all
    records by Levenberg–Marquardt with forward-mode derivatives of the blocked simulation; each
    record has an initial state of its own. What comes out reaches the Cramér–Rao bound where the
    model holds and the noise is Gaussian, with covariances for white and for coloured noise.

    A black box is balanced first, and searched in the local coordinates that no change of the
    state's basis can imitate (McKelvey et al. 2004). Its D is estimated unless it is exactly zero.

    Runs under `jax.jit`, `jax.vmap` and `jax.lax.map` over the data (and over a model that
    `identify` found there): `jax.lax.map(lambda y: refine(model, data.replace(y=y)).parameters,
    ys)`. Checks that look at numbers are not made there. Not for `jax.grad`. Memory is that of one
    record's Jacobian; records are padded to the longest.

    Args:
        model: what `identify`, `identify_mechanical`, `identify_step_response` or `refine`
            returned, a `StateSpace` (discrete at the data's sample time, or continuous: zero-order
            hold), `StructuredModel`, `LPVStateSpace` (its coefficients, along the data's `kappa`),
            `GrayBoxLPV` (its parameters), `NonlinearModel`, or any `eqx.Module` with
            `simulate(u=, dt=, x0=)` or `step(x, u, dt=)` (which `Innovation` needs), and `kappa=`
            where it takes one, whose inexact arrays are the parameters and whose `n_states` (or
            `nx`) says how long x0 is; without it, x0 is not passed.
        data: one or several records.
        predictor: `OutputError()` by default, or `Innovation()`.
        loss: `SquaredLoss()` by default, or `HuberLoss()`.
        bounds: lower and upper bound by parameter name (* and ? are wildcards), in place of the
            structure's own.
        fixed: names of parameters that keep the value they start with.
        tied: names of parameters that share one value: a pattern, or several patterns, a group. Of
            a black box, `fixed` and `tied` may name entries of D and offsets alone.
        initial_state: `"free"` (estimated, one a record), `"zero"`, or known states (nx,) or
            (record, nx).
        output_offset: a constant in each output, estimated from the mean on: `"free"`, one common
            to all records, as `offset[k]`, or `"per record"`, one of each record r, as
            `offset[r,k]`; or known constants, (ny,) or (record, ny), such as the `y` of a
            `lpvid.data.Offset`. By default, what the fit that is refined did, so that an estimated
            offset stays an unknown and the intervals of the gain account for it. Where offsets
            differ, start from a model of records freed of their means: `identify` knows one offset
            for all. Constants of each record belong to these records in this order.
        max_steps: limit on the trial steps.
        throw: raise where no fit came out. `False` returns it with its status, and warns.

    Returns:
        The model and what is known about it.

    Raises:
        ValueError: model and data do not fit, a name matches no parameter, bounds are given for a
            black box's entries, or (with `throw`) the simulation is not finite from this start.

    Warns:
        UserWarning: the search did not converge, or parameters are at a bound or unidentified.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.models import StateSpace
        >>> from lpvid.refinement import refine
        >>> u = np.random.default_rng(0).standard_normal(300)
        >>> truth = StateSpace([[0.8]], [[1.0]], [[1.0]], dt=0.1)
        >>> data = IOData(u=u, y=truth.simulate(u=u), dt=0.1)
        >>> start = StateSpace([[0.7]], [[0.9]], [[1.0]], dt=0.1)
        >>> round(refine(start, data).model.A.item(), 6)
        0.8
    """
    predictor = OutputError() if predictor is None else predictor
    loss = SquaredLoss() if loss is None else loss
    if not isinstance(predictor, AbstractPredictor):
        raise ValueError(f"predictor={predictor!r}: give OutputError() or Innovation().")
    if not isinstance(loss, AbstractLoss):
        raise ValueError(f"loss={loss!r}: give SquaredLoss() or HuberLoss().")
    if max_steps < 1:
        raise ValueError(f"max_steps: at least 1 is needed, got {max_steps}.")
    offset, estimated = starting_offset(model, output_offset, data)
    if offset is not None:
        data = without_constants(data, offset)
    start = recognise(model, data, predictor)
    if estimated and offset is not None:
        kind = WithOffset(start.parameterisation, offset, channel_sizes(data.y))
        start = Start(kind, jnp.concatenate([start.values, offset.reshape(-1)]))
    task, chosen = prepare(start, data, predictor, loss, bounds, fixed, tied, initial_state)
    records = padded_records(data)
    own = task.own(*records[1].shape)
    found = search(task, *records, chosen, own, jnp.asarray(max_steps))
    outcome = assess(task, *records, found)
    refined = as_refined(task, outcome, data, offset)
    if not isinstance(refined.cost, Tracer):
        _report(refined, throw)
    return refined


def prepare(
    start: Start,
    data: IOData,
    predictor: AbstractPredictor,
    loss: AbstractLoss,
    bounds: Mapping[str, tuple[float, float]] | None,
    fixed: Sequence[str],
    tied: Ties,
    initial_state: str | ArrayLike,
) -> tuple[Task, Float[Array, " chosen"]]:
    """The task, and where its search starts."""
    kind = start.parameterisation
    selection = select(kind.names, start.values, fixed, tied)
    lower, upper = _bounds(kind, bounds)
    black_box = _is_black_box(kind)
    remaining = 0
    if black_box:
        remaining = kind.n_states**2
        _check_basis_free(kind, fixed, tied)
    for pattern in bounds or ():
        rows = matching(kind.names, pattern, "bounds")
        if isinstance(selection.matrix, Tracer):
            break
        if not np.all(np.any(np.asarray(selection.matrix)[rows] > 0.0, axis=1)):
            raise ValueError(
                f"bounds[{pattern!r}]: names a parameter that is fixed; leave one of the two out."
            )
    twice = sorted({name for name in kind.names if kind.names.count(name) > 1})
    if twice:
        raise ValueError(
            f"model: {', '.join(twice)} would name two values each, one of them the gain's or the "
            "offset's; rename the model's own."
        )
    chosen, inner_lower, inner_upper = _chosen(selection, start.values, lower, upper)
    free, x0 = _initial_state(initial_state, kind, black_box, len(data.lengths))
    shooting = predictor.shooting if isinstance(predictor, OutputError) else None
    if shooting is not None and not kind.n_states:
        raise ValueError("predictor: shooting needs a model with states; this one names none.")
    task = Task(
        parameterisation=kind,
        loss=loss,
        selection=selection,
        bounds=Bounds(inner_lower, inner_upper),
        x0=x0,
        free_start=free,
        remaining=remaining,
        shooting=None if shooting is None else min(shooting, max(data.lengths)),
    )
    return task, chosen


def _is_black_box(kind: AbstractParameterisation) -> bool:
    """Whether the values depend on the basis of the state."""
    kind = kind.model if isinstance(kind, WithOffset) else kind
    return isinstance(kind, LinearParameterisation) and kind.black_box


def _check_basis_free(kind: AbstractParameterisation, fixed: Sequence[str], tied: Ties) -> None:
    """Raise where something is to be held that depends on the basis of the state."""
    groups = [[pattern] if isinstance(pattern, str) else pattern for pattern in tied]
    for pattern in (*fixed, *(pattern for group in groups for pattern in group)):
        if not _basis_free(kind, pattern, "fixed, tied"):
            raise ValueError(
                f"fixed, tied: {pattern!r} names entries that depend on the basis of the state, "
                "which the search of a black box changes; hold entries of D or offsets only, or "
                "give a StructuredModel."
            )


def _basis_free(kind: AbstractParameterisation, pattern: str, argument: str) -> list[str]:
    """The names that a pattern matches, none if any depends on the basis of the state."""
    names = [kind.names[i] for i in matching(kind.names, pattern, argument)]
    return names if all(name.startswith(("D", "offset")) for name in names) else []


@jax.jit
def _chosen(
    selection: Selection, values: Array, lower: Array, upper: Array
) -> tuple[Array, Array, Array]:
    """The chosen values of all, and their bounds: the narrowest of what is tied."""
    membership = selection.matrix > 0.0
    inner_lower = jnp.max(jnp.where(membership, lower[:, None], -jnp.inf), axis=0)
    inner_upper = jnp.min(jnp.where(membership, upper[:, None], jnp.inf), axis=0)
    return selection.chosen(values), inner_lower, inner_upper


def _bounds(
    kind: AbstractParameterisation, given: Mapping[str, tuple[float, float]] | None
) -> tuple[Array, Array]:
    lower, upper = kind.bounds()
    if not given:
        return lower, upper
    if _is_black_box(kind):
        own = [name for pattern in given for name in _basis_free(kind, pattern, "bounds")]
        if own:
            raise ValueError(
                f"bounds: {', '.join(own)} cannot be bounded in a black box, which is searched in "
                "coordinates that mix all values; hold it (fixed=), or give a StructuredModel."
            )
        raise ValueError(
            "bounds: the entries of a black box depend on the basis of its state, so they have no "
            "bounds; give a StructuredModel, for example of a ModalStructure."
        )
    for pattern, ends in given.items():
        low, high = (float(end) for end in ends)
        if not low <= high:
            raise ValueError(f"bounds[{pattern!r}]: {low} lies above {high}.")
        at = jnp.asarray(matching(kind.names, pattern, "bounds"))
        lower, upper = lower.at[at].set(low), upper.at[at].set(high)
    return lower, upper


def _initial_state(
    given: str | ArrayLike, kind: AbstractParameterisation, any_basis: bool, records: int
) -> tuple[bool, Float[Array, "record nx"]]:
    zero = jnp.zeros((records, kind.n_states))
    if isinstance(given, str):
        if given not in ("free", "zero"):
            raise ValueError(f"initial_state={given!r}: give 'free', 'zero' or known states.")
        return given == "free", zero
    states = jnp.asarray(given, float)
    if any_basis:
        raise ValueError(
            "initial_state: a black box's states have no basis of their own; use 'free' or 'zero'."
        )
    if states.shape not in ((kind.n_states,), zero.shape):
        raise ValueError(
            f"initial_state: shape {states.shape} given; ({kind.n_states},) or {zero.shape} is "
            "needed."
        )
    states = states[None] if states.ndim == 1 else states
    return False, jnp.broadcast_to(states, zero.shape)


def as_refined(task: Task, outcome: Outcome, data: IOData, offset: Constants | None) -> Refined:
    """The public record of an outcome."""
    kind = task.parameterisation
    if isinstance(kind, WithOffset):
        offset = kind.output_offset(outcome.values)
    pieces = [outcome.residual[i, :length] for i, length in enumerate(data.lengths)]
    return Refined(
        model=kind.build(outcome.values),
        parameters=outcome.values,
        parameter_names=kind.names,
        covariance=outcome.covariance,
        robust_covariance=outcome.robust_covariance,
        x0=outcome.x0,
        output_offset=offset,
        innovation_gain=kind.innovation_gain(outcome.values),
        noise_covariance=outcome.noise_covariance,
        residual=jnp.concatenate(pieces),
        cost=outcome.cost,
        initial_cost=outcome.initial_cost,
        status=outcome.status,
        stats={
            "steps": outcome.steps,
            "degrees_of_freedom": jnp.asarray(outcome.degrees_of_freedom),
            "unidentified": outcome.unidentified,
            "at_bound": outcome.at_bound,
            "largest_gap": outcome.gap,
        },
        task=task,
    )


def _report(refined: Refined, throw: bool) -> None:
    """Raise or warn, with the parameter's name and the remedy."""
    if refined.status == Status.successful:
        return
    if throw and (refined.status == Status.nonfinite or refined.status == Status.overflow):
        raise ValueError(f"The fit failed. {refined.advice} throw=False returns it as it is.")
    warnings.warn(f"refine: {refined.advice}", stacklevel=3)
