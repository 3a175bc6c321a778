"""Black-box identification: one function, the methods are objects."""

import functools
import math
import operator
import sys
import warnings
from collections.abc import Callable
from typing import Any, overload

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from lpvid._results import Status
from lpvid.data import IOData
from lpvid.identify._checks import (
    above_rank,
    check_varying,
    describe_excitation,
    few_samples,
    input_factor,
    largest_order,
    make_layout,
    negligible,
    weak_excitation,
)
from lpvid.identify._chunks import ChunkedSource, Chunks
from lpvid.identify._engine import STABILITY_MARGIN, complete_records, range_of_records
from lpvid.identify._factor import ILL_CONDITIONED, Layout, Route
from lpvid.identify._fit import Fit, Moments
from lpvid.identify._methods import AbstractSubspaceMethod, PastOutputMOESP, projection_only
from lpvid.identify._order import Evidence
from lpvid.identify.gray_box import (
    AbstractContinuousTimeMethod,
    ContinuousTimeFit,
    identify_continuous,
)
from lpvid.models import StateSpace

# Growth of an unstable model over one window that B and D are estimated from.
_LARGEST_GROWTH = 1e3
# Share of an input row that the other inputs leave, in squares, below which excitation is weak.
_WEAK_EXCITATION = 1e-14


@overload
def identify(
    data: IOData, method: AbstractContinuousTimeMethod, *, throw: bool = ...
) -> ContinuousTimeFit: ...
@overload
def identify(
    data: IOData | Chunks, method: AbstractSubspaceMethod | None = ..., *, throw: bool = ...
) -> Fit: ...
def identify(
    data: IOData | Chunks,
    method: AbstractSubspaceMethod | AbstractContinuousTimeMethod | None = None,
    *,
    throw: bool = True,
) -> Fit | ContinuousTimeFit:
    r"""Identify a state-space model from input-output records.

    In discrete time, or in continuous time by a `ContinuousTimeMOESP`, `ContinuousTimeN4SID` or
    `ContinuousTimeCVA`, for which see `ContinuousTimeFit`; what follows is of discrete time.

    A and C come from the range of the extended observability matrix (the method's projection of
    the data), B, D and one initial state for every record from the simulation error
    $\sum_t \|y(t) - \hat y(t)\|^2$ over channels of unit RMS. The data matrix is never formed: cost
    is linear in the number of samples, memory beside the data independent of it. Where its Gram
    matrix is ill-conditioned (records without noise, slow inputs) Householder reflections replace
    it.

    Runs under `jax.jit`, `jax.vmap` and `jax.lax.map`; there the checks of the data, the fallback
    to reflections, the windows for unstable models and rules for the order are not available, since
    they look at values, and `status` says what happened. On a CPU `jax.lax.map` over many records
    is several times faster than `jax.vmap`. Gradients with respect to the data pass through an
    eigenvalue decomposition and hold while the singular values are distinct; with `stabilise` they
    do not exist where an eigenvalue is moved.

    Args:
        data: one or several records; or `Chunks` of one record that is larger than memory.
        method: `PastOutputMOESP()` by default; `N4SID`, `CVA`, `PastInputMOESP`, `ORSE`.
        throw: raise where the data cannot give a model. `False` returns it with its status.

    Returns:
        The model, with the initial states of the records and what was learned about the data.

    Raises:
        ValueError: naming channel and remedy: too few samples, constant channels, inputs that
            excite too little, an order that the block rows cannot carry.

    Warns:
        UserWarning: the order is above the rank of the data, the model is unstable, samples are few
            for the order, or an input hardly excites.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.identify import PastOutputMOESP, identify
        >>> u = np.random.default_rng(0).standard_normal(500)
        >>> y = np.convolve(u, 0.8 ** np.arange(50))[:500]
        >>> fit = identify(IOData(u=u, y=y, dt=0.1), PastOutputMOESP(order=1, block_rows=5))
        >>> round(fit.model.A.item(), 3)
        0.8
    """
    method = PastOutputMOESP() if method is None else method
    if isinstance(method, AbstractContinuousTimeMethod):
        if isinstance(data, Chunks):
            raise ValueError(
                "data: chunks are for methods in discrete time; give PastOutputMOESP(...) or "
                "another of them, or a record that fits in memory."
            )
        return identify_continuous(data, method, throw=throw)
    if not isinstance(method, AbstractSubspaceMethod):
        raise ValueError(
            f"method={method!r} is no subspace method: give an object such as "
            f"PastOutputMOESP(order=6, block_rows=20)."
        )
    source: _Records | ChunkedSource
    if isinstance(data, Chunks):
        head = data.first()
        # How long the record is comes out only at its end.
        layout = make_layout(method, head, (sys.maxsize,))
        source = ChunkedSource(data, head, method)
    else:
        head = data
        layout = make_layout(method, data, data.lengths)
        source = _Records(data, method.offset)
    traced = isinstance(head.u, Tracer) or isinstance(head.y, Tracer)
    rule = method.rule
    if traced and rule is not None:
        raise ValueError(
            "order: a rule looks at singular values and cannot run under jit, vmap or lax.map: "
            "identify one record without them first, and give its order here."
        )
    projection = projection_only(method)
    route: Route = "gram"
    found = source.range(projection, layout, route, rule is not None)
    if not traced and throw:
        source.check_varying()
    # Not `<`: a factorisation that broke down says NaN.
    if not traced and not float(found["smallest_pivot"]) > ILL_CONDITIONED:
        route = "qr"
        found = source.range(projection, layout, route, rule is not None)
    lengths = source.lengths
    if rule is None:
        order = method.order
        assert isinstance(order, int)
    else:
        order = operator.index(rule.choose(_evidence(found, layout, lengths)))
        most = (layout.block_rows - 1) * layout.ny
        if not 1 <= order <= most:
            raise ValueError(
                f"order={rule!r} chose {order}, but block_rows={layout.block_rows} carries 1 to "
                f"{most} states with {layout.ny} outputs: let the rule keep to evidence.largest, "
                f"or raise block_rows."
            )
    complete = functools.partial(
        source.complete,
        found,
        negligible(route),
        order=order,
        full_rank=layout.input_rows,
        feedthrough=method.feedthrough,
        stabilise=method.stabilise,
        offset=method.offset,
    )
    result = complete(windows=lengths)
    if not traced and float(result["spectral_radius"]) > 1.0 + STABILITY_MARGIN:
        result = _free_unstable(result, complete, lengths, 2 * layout.block_rows)
    # Read off one number rather than the status: a comparison of those is a computation.
    well = result.pop("successful")
    fit = _as_fit(found, result, method, layout, lengths, head.dt)
    if not traced:
        names = head.input_names
        _warn(fit, source, names, layout, route)
        if not bool(well):
            _report(fit, source, names, method, layout, negligible(route), throw)
    return fit


class _Records:
    """The stages of an identification of records in memory."""

    def __init__(self, data: IOData, offset: bool):
        self.data, self.offset = data, offset
        self.lengths = data.lengths

    def range(self, method, layout: Layout, route: Route, correlate: bool) -> dict[str, Any]:
        """Range of the observability matrix."""
        return range_of_records(
            self.data.u,
            self.data.y,
            method=method,
            layout=layout,
            lengths=self.lengths,
            route=route,
            correlate=correlate,
        )

    def complete(self, found: dict[str, Any], rounding: float, **settings) -> dict[str, Any]:
        """B, D, offset and x0 for a given order."""
        needed = {name: found[name] for name in _NEEDED}
        done = complete_records(needed, self.data.u, self.data.y, rounding, **settings)
        return done | dict(samples=self.data.n_samples)

    def check_varying(self) -> None:
        """Raise for a constant channel."""
        check_varying(self.data)

    def input_factor(self, channel: int, layout: Layout) -> np.ndarray:
        """Triangle of the rows of one input."""
        return input_factor(self.data, channel, layout, self.offset)


_NEEDED = ("vectors", "singular_values", "scale", "centre", "excitation_rank", "still")


def _evidence(found: dict[str, Any], layout: Layout, lengths: tuple[int, ...]) -> Evidence:
    return Evidence(
        singular_values=np.asarray(found["singular_values"]),
        correlations=np.asarray(found["correlations"]),
        instruments=layout.known_rows - layout.future_inputs,
        columns=layout.columns(lengths),
        nu=layout.nu,
        ny=layout.ny,
        largest=largest_order(layout.block_rows, layout.ny),
    )


_STATS = (
    "spectral_radius",
    "eigenvalues_moved",
    "residual_std",
    "window",
    "smallest_pivot",
    "excitation_pivot",
    "excitation_rank",
    "reflections",
)


def _as_fit(
    found: dict[str, Any],
    result: dict[str, Any],
    method: AbstractSubspaceMethod,
    layout: Layout,
    lengths: tuple[int, ...],
    dt: float,
) -> Fit:
    both = found | result
    model = jax.tree.unflatten(_structure(dt), [result[name] for name in "ABCD"])
    shared = model.nx * layout.nu + layout.ny * (layout.nu * method.feedthrough + method.offset)
    # The state is unknown at the start of every window, not only of every record.
    windows, samples = result["normal_matrix"].shape[0], result["samples"]
    unknowns = (shared + model.nx * windows) / layout.ny
    moments = Moments(
        scale=found["scale"],
        projections=found["projections"],
        normal_matrix=result["normal_matrix"],
        firsts=result.get("firsts"),
        columns=layout.columns(lengths),
        dilution=samples / max(samples - unknowns, 1.0),
        feedthrough=method.feedthrough,
        offset=method.offset,
    )
    return Fit(
        model=model,
        x0=result["x0"],
        output_offset=result["output_offset"],
        singular_values=found["singular_values"],
        order=model.nx,
        status=result["status"],
        stats={name: both[name] for name in _STATS},
        moments=moments,
    )


@functools.lru_cache
def _structure(dt: float):
    """A model's tree: filling it skips the constructor's checks, a share of a short fit's time."""
    return jax.tree.structure(StateSpace(np.eye(1), np.eye(1), np.eye(1), np.eye(1), dt))


def _free_unstable(
    result: dict[str, Any], complete: Callable[..., dict], lengths: tuple[int, ...], least: int
) -> dict[str, Any]:
    """B and D of an unstable model from windows short enough that nothing grows out of bounds.

    The state is free at the start of every window, which is the simulation error of many short
    records; over the whole record the regressors would overflow.
    """
    growth = math.log(float(result["spectral_radius"]))
    window = max(int(math.log(_LARGEST_GROWTH) / growth), least)
    if window >= max(lengths):
        return result
    windows, firsts = [], []
    for length in lengths:
        firsts.append(len(windows))
        count = max(length // window, 1)
        windows += [window] * (count - 1) + [length - (count - 1) * window]
    # Too few samples for two windows in any record.
    if len(windows) == len(lengths):
        return result
    again, starts = complete(windows=tuple(windows)), jnp.asarray(firsts)
    return again | dict(x0=again["x0"][starts], firsts=starts, window=jnp.asarray(window))


def _warn(
    fit: Fit,
    source: "_Records | ChunkedSource",
    names: tuple[str, ...],
    layout: Layout,
    route: Route,
) -> None:
    """Warn of too few samples and of inputs that only just excite enough."""
    message = few_samples(fit.order, layout.nu, layout.ny, sum(source.lengths))
    if message is not None:
        warnings.warn(message, stacklevel=3)
    if route == "qr":
        pivot = float(fit.stats["excitation_pivot"])
        full = int(fit.stats["excitation_rank"]) == layout.input_rows
        if full and pivot < _WEAK_EXCITATION:
            message = weak_excitation(names, layout, source.input_factor, pivot)
            warnings.warn(message, stacklevel=3)


def _report(
    fit: Fit,
    source: "_Records | ChunkedSource",
    names: tuple[str, ...],
    method: AbstractSubspaceMethod,
    layout: Layout,
    rounding: float,
    throw: bool,
) -> None:
    """Raise or warn, with the channel and the remedy."""
    if fit.status == Status.constant_channel:
        # With `throw` it has raised before.
        return
    if fit.status == Status.unstable:
        remedies = [
            "Ask for stabilise=0.9999",
            f"lower the order ({fit.order})",
            f"raise block_rows ({layout.block_rows})",
        ]
        if not method.past_outputs:
            remedies.append("use past outputs as instruments (PastOutputMOESP)")
        warnings.warn(
            f"The identified model is unstable (spectral radius "
            f"{float(fit.stats['spectral_radius']):.6g}). {', '.join(remedies[:-1])}, or "
            f"{remedies[-1]}.",
            stacklevel=3,
        )
        return
    # What makes a fit poor comes first: it may be why the fit is not finite.
    if int(fit.stats["excitation_rank"]) < layout.input_rows:
        if throw:
            raise ValueError(describe_excitation(names, layout, source.input_factor))
        return
    message = above_rank(fit.order, np.asarray(fit.singular_values), rounding)
    if message is not None:
        if throw and fit.status == Status.nonfinite:
            raise ValueError(message)
        warnings.warn(message, stacklevel=3)
    elif throw:
        raise ValueError(
            "The fit is not finite. Look for outliers, extreme channel scales or an order "
            f"({fit.order}) far above the system's; throw=False returns it as it is."
        )
