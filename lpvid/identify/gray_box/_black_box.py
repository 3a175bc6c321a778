"""Black-box identification in continuous time from filtered signals."""

import functools
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from lpvid._results import Status
from lpvid.data import IOData
from lpvid.identify._checks import above_rank, few_samples
from lpvid.identify._order import Evidence, LargestGap
from lpvid.identify.gray_box._candidates import black_boxes
from lpvid.identify.gray_box._methods import AbstractContinuousTimeMethod, ContinuousTimeMOESP
from lpvid.identify.gray_box._search import (
    NEGLIGIBLE,
    UNEXCITED,
    FilterSearch,
    best,
    check_excitation,
    describe_filters,
    resolve_filters,
    search_table,
    unit_rms,
)
from lpvid.identify.gray_box._subspace import dynamics, ranges
from lpvid.models import StateSpace

# Growth over the record that rounding is taken for: an integrator is not called unstable for it.
_GROWTH = 1e-6


class ContinuousTimeFit(eqx.Module):
    """Result of `identify` with a continuous-time method.

    Without covariances, since the filters colour the noise: `lpvid.refine(fit, data)` starts from
    it and has them.

    Attributes:
        model: the continuous-time model.
        x0: initial state of every record, (record, nx).
        order: number of states.
        fit: simulation fit (BFT) to the identification data, percent for each output, (ny,).
        tau: time constant of the filters that were kept, s.
        block_rows: number of rows that was kept.
        search: every filter that was tried.
        singular_values: of the projected data at the filters kept, (row,).
        status: how it ended.
        stats: arrays by name: `smallest_pivot` (share of a filtered input, in squares, that the
            others do not explain), `largest_real_part` of the poles in rad/s, `residual_std` of
            each output's simulation error, (ny,).

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.identify import ContinuousTimeMOESP, identify
        >>> from lpvid.models import StateSpace
        >>> u = np.repeat(np.random.default_rng(0).standard_normal(50), 10)
        >>> y = StateSpace([[-2.0]], [[1.0]], [[1.0]]).simulate(u=u, dt=0.05)
        >>> method = ContinuousTimeMOESP(order=1, tau=(0.2, 0.4), block_rows=3)
        >>> identify(IOData(u=u, y=y, dt=0.05), method).search.tau.tolist()
        [0.2, 0.4]
    """

    model: StateSpace
    x0: Float[Array, "record nx"]
    order: int = eqx.field(static=True)
    fit: Float[Array, " ny"]
    tau: Float[Array, ""]
    block_rows: Int[Array, ""]
    search: FilterSearch
    singular_values: Float[Array, " row"]
    status: Status
    stats: dict[str, Array]


def identify_continuous(
    data: IOData, method: AbstractContinuousTimeMethod | None = None, *, throw: bool = True
) -> ContinuousTimeFit:
    """Identify a continuous-time state-space model from sampled records.

    The signals are filtered by a chain of first-order filters, which takes the place of the forward
    shift in a subspace step for A and C; B, D and the initial states come from the simulation error
    for held inputs. Every τ and number of rows asked for is tried in one batch and the best fit is
    kept.

    Runs under `jit`, `vmap` and `lax.map` where the method gives τ and the order.

    Args:
        data: one or several records.
        method: `ContinuousTimeMOESP()` by default.
        throw: raise where the data cannot give a model. `False` returns it with its status.

    Returns:
        The model in continuous time (`dt` 0), the initial states, and the table of the search.

    Raises:
        ValueError: too few samples, an order the rows cannot carry, τ out of range, constant
            channels, inputs that excite too little.

    Warns:
        UserWarning: the model is unstable, the order is above the rank of the data, or samples are
            few for the order.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.identify import ContinuousTimeMOESP, identify
        >>> from lpvid.models import StateSpace
        >>> u = np.repeat(np.random.default_rng(0).standard_normal(50), 10)
        >>> y = StateSpace([[-2.0]], [[1.0]], [[1.0]]).simulate(u=u, dt=0.05)
        >>> method = ContinuousTimeMOESP(order=1, tau=0.3, block_rows=3)
        >>> identify(IOData(u=u, y=y, dt=0.05), method).model.A.round(3).tolist()
        [[-2.0]]
    """
    method = ContinuousTimeMOESP() if method is None else method
    if not isinstance(method, AbstractContinuousTimeMethod):
        raise ValueError(
            f"method={method!r}: give a continuous-time method such as "
            f"ContinuousTimeMOESP(order=4, tau=0.1, block_rows=6)."
        )
    traced = isinstance(data.u, Tracer) or isinstance(data.y, Tracer)
    order = None if method.order == "auto" else method.order
    if traced and order is None:
        raise ValueError(
            'order="auto" looks at singular values and cannot run under jit, vmap or lax.map: '
            "identify one record without them first, and give its order here."
        )
    taus, rows = resolve_filters(method, data, order)
    u, y, input_scale, output_scale = unit_rms(data.u, data.y)
    samples = jnp.asarray(taus) / data.dt
    found = ranges(u, y, samples, method=method.weights, block_rows=rows, lengths=data.lengths)
    if not traced and throw:
        check_excitation(data, found, min(rows))
    if order is None:
        order = _order(found, rows, data)
    As, Cs = dynamics(found, samples, filters=method.filters, order=order, ny=data.ny)
    candidates = black_boxes(
        As.reshape(-1, order, order),
        Cs.reshape(-1, data.ny, order),
        u,
        y,
        feedthrough=method.feedthrough,
        lengths=data.lengths,
    )
    values = _chosen(
        candidates,
        found,
        y,
        input_scale,
        output_scale,
        jnp.asarray(taus),
        dt=data.dt,
        rows=rows,
        lengths=data.lengths,
    )
    singular_values = values.pop("singular_values")
    if not traced:
        singular_values = singular_values[: int(values["block_rows"]) * data.ny]
    fit = ContinuousTimeFit(**values, order=order, singular_values=singular_values)
    if not traced:
        _report(fit, data, throw)
    return fit


@functools.partial(jax.jit, static_argnames=("dt", "rows", "lengths"))
def _chosen(candidates, found, y, input_scale, output_scale, taus, *, dt, rows, lengths):
    """Attributes of the fit: the best candidate in the data's units."""
    table = search_table(taus, rows, candidates["residual"], y, lengths)
    index = best(candidates)
    filters = describe_filters(found, index, taus.shape[0])
    chosen = jax.tree.map(lambda leaf: leaf[index], candidates)
    A = chosen["A"]
    order = A.shape[0]
    model = StateSpace(
        A=A / dt,
        B=chosen["B"] / dt / input_scale[None, :],
        C=chosen["C"] * output_scale[:, None],
        D=chosen["D"] * output_scale[:, None] / input_scale[None, :],
    )
    growth = jnp.max(jnp.linalg.eigvals(A).real)
    unstable = growth * max(lengths) > _GROWTH
    status = Status.where(unstable, Status.unstable, Status.successful)
    values = filters.singular_values
    poor = ~(filters.pivot > UNEXCITED) | (values[order - 1] <= NEGLIGIBLE * values[0])
    status = Status.where(poor, Status.ill_conditioned, status)
    status = Status.where(jnp.isfinite(jnp.sum(chosen["residual"])), status, Status.nonfinite)
    return dict(
        model=model,
        x0=chosen["x0"],
        fit=table.fit[index],
        tau=table.tau[index],
        block_rows=table.block_rows[index],
        search=table,
        singular_values=filters.singular_values,
        status=status,
        stats={
            "smallest_pivot": filters.pivot,
            "largest_real_part": growth / dt,
            "residual_std": jnp.sqrt(chosen["residual"] / sum(lengths)) * output_scale,
        },
    )


def _order(found: tuple, rows: tuple[int, ...], data: IOData) -> int:
    """Largest gap at the τ in the middle and the most rows."""
    values = found[int(np.argmax(rows))][1]
    # Half the rows, so that a noise floor is seen; no more than the fewest rows carry.
    largest = max(min((min(rows) - 1) * data.ny, max(rows) * data.ny // 2), 1)
    evidence = Evidence(
        singular_values=np.asarray(values[values.shape[0] // 2]),
        correlations=np.zeros(0),
        instruments=max(rows) * (data.nu + data.ny),
        columns=data.n_samples,
        nu=data.nu,
        ny=data.ny,
        largest=largest,
    )
    return LargestGap().choose(evidence)


def _report(fit: ContinuousTimeFit, data: IOData, throw: bool) -> None:
    """Raise or warn, with the remedy."""
    # `identify` calls for the user: one frame more.
    level = 4
    for message in (
        few_samples(fit.order, data.nu, data.ny, data.n_samples),
        above_rank(fit.order, np.asarray(fit.singular_values), NEGLIGIBLE),
    ):
        if message is not None:
            warnings.warn(message, stacklevel=level)
    if fit.status == Status.nonfinite:
        if throw:
            raise ValueError(
                "No filter gave a finite model. Look for outliers, lower the order "
                f"({fit.order}), or try tau and block_rows of your own; throw=False returns what "
                "there is."
            )
    elif fit.status == Status.unstable:
        growth = float(fit.stats["largest_real_part"])
        warnings.warn(
            f"The identified model is unstable (a pole {growth:.4g} rad/s to the right of the "
            f"imaginary axis). Lower the order ({fit.order}), or try other tau and block_rows.",
            stacklevel=level,
        )
