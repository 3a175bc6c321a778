"""Black-box identification: one function, the methods are objects."""

import functools
import math
import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from lpvid._results import Status
from lpvid.data import IOData
from lpvid.identify._checks import (
    check_varying,
    describe_excitation,
    largest_order,
    negligible,
    resolve_block_rows,
)
from lpvid.identify._factor import ILL_CONDITIONED, Route, data_factor
from lpvid.identify._linear_fit import solve
from lpvid.identify._methods import AbstractSubspaceMethod, PastOutputMOESP
from lpvid.identify._order import choose_order
from lpvid.identify._realise import left_range, move_inside, realise, spectral_radius
from lpvid.identify._simulation_error import record_equations
from lpvid.models import StateSpace

# Growth of an unstable model over one window that B and D are estimated from.
_LARGEST_GROWTH = 1e3
# The radius is known to about 1e-9; an integrator is not called unstable for that.
_STABILITY_MARGIN = 1e-8


class Fit(eqx.Module):
    """Result of `identify`.

    Attributes:
        model: the discrete-time model, its `dt` that of the data.
        x0: initial state of every record, (record, nx).
        singular_values: of the projected data, largest first, (block_rows ny,), for channels of
            unit RMS and independent of the number of samples.
        order: number of states.
        status: how it ended.
        stats: arrays by name: `spectral_radius` of A as returned, `eigenvalues_moved` by
            stabilisation, `excitation_rank` (full is 2 block_rows nu), `smallest_pivot` (share of a
            data row, in squares, that the others do not explain: the reciprocal condition),
            `reflections` (whether the Gram matrix gave way to Householder reflections),
            `residual_std` of each output's simulation error, (ny,), `window` (samples after which
            the state was freed anew because the model is unstable; 0: never).

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.identify import PastOutputMOESP, identify
        >>> u = np.random.default_rng(0).standard_normal(500)
        >>> y = np.convolve(u, 0.8 ** np.arange(50))[:500]
        >>> fit = identify(IOData(u=u, y=y, dt=0.1), PastOutputMOESP(order=1, block_rows=5))
        >>> fit.order, fit.x0.shape, round(fit.stats["spectral_radius"].item(), 3)
        (1, (1, 1), 0.8)
    """

    model: StateSpace
    x0: Float[Array, "record nx"]
    singular_values: Float[Array, " row"]
    order: int = eqx.field(static=True)
    status: Status
    stats: dict[str, Array]


def identify(
    data: IOData, method: AbstractSubspaceMethod | None = None, *, throw: bool = True
) -> Fit:
    r"""Identify a discrete-time state-space model from input-output records.

    A and C come from the range of the extended observability matrix (the method's projection of
    the data), B, D and one initial state for every record from the simulation error
    $\sum_t \|y(t) - \hat y(t)\|^2$ over channels of unit RMS. The data matrix is never formed: cost
    is linear in the number of samples, memory beside the data independent of it. Where its Gram
    matrix is ill-conditioned (records without noise, slow inputs) Householder reflections replace
    it.

    Runs under `jax.jit`, `jax.vmap` and `jax.lax.map`; there the checks of the data, the fallback
    to reflections, the windows for unstable models and `order="auto"` are not available, since they
    look at values, and `status` says what happened. On a CPU `jax.lax.map` over many records is
    several times faster than `jax.vmap`. Gradients with respect to the data pass through an
    eigenvalue decomposition and hold while the singular values are distinct; with `stabilise` they
    do not exist where an eigenvalue is moved.

    Args:
        data: one or several records.
        method: `PastOutputMOESP()` by default; `PastInputMOESP(...)`.
        throw: raise where the data cannot give a model. `False` returns it with its status.

    Returns:
        The model, with the initial states of the records and what was learned about the data.

    Raises:
        ValueError: naming channel and remedy: too few samples, constant channels, inputs that
            excite too little, an order that the block rows cannot carry.

    Warns:
        UserWarning: the order is above the rank of the data, or the model is unstable.

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
    if not isinstance(method, AbstractSubspaceMethod):
        raise ValueError(
            f"method={method!r} is no subspace method: give an object such as "
            f"PastOutputMOESP(order=6, block_rows=20)."
        )
    block_rows = resolve_block_rows(method, data)
    traced = isinstance(data.u, Tracer) or isinstance(data.y, Tracer)
    if traced and method.order == "auto":
        raise ValueError(
            'order="auto" looks at singular values and cannot run under jit, vmap or lax.map: '
            "identify one record without them first, and give its order here."
        )
    settings = dict(method=method, block_rows=block_rows, lengths=data.lengths)
    route: Route = "gram"
    found = _range(data.u, data.y, route=route, **settings)
    # Not `<`: a factorisation that broke down says NaN.
    if not traced and not float(found["smallest_pivot"]) > ILL_CONDITIONED:
        if throw:
            check_varying(data)
        route = "qr"
        found = _range(data.u, data.y, route=route, **settings)
    order = method.order
    if order == "auto":
        values = np.asarray(found["singular_values"])
        order = choose_order(values, largest_order(block_rows, data.ny))
    complete = functools.partial(
        _complete,
        found,
        data.u,
        data.y,
        negligible(route),
        order=order,
        full_rank=2 * block_rows * data.nu,
        feedthrough=method.feedthrough,
        stabilise=method.stabilise,
    )
    result = complete(windows=data.lengths)
    if not traced and float(result["spectral_radius"]) > 1.0 + _STABILITY_MARGIN:
        result = _free_unstable(result, complete, data.lengths, 2 * block_rows)
    # Read off one number rather than the status: a comparison of those is a computation.
    well = result.pop("successful")
    fit = _as_fit(result | {name: found[name] for name in _RANGE_STATS}, data)
    if not traced and not bool(well):
        _report(fit, data, method, block_rows, negligible(route), throw)
    return fit


_RANGE_STATS = ("singular_values", "smallest_pivot", "excitation_rank", "reflections")


def _as_fit(stats: dict[str, Any], data: IOData) -> Fit:
    A, B, C, D = (stats.pop(name) for name in "ABCD")
    model = StateSpace(A, B, C, D, data.dt)
    return Fit(
        model=model,
        x0=stats.pop("x0"),
        singular_values=stats.pop("singular_values"),
        order=model.nx,
        status=stats.pop("status"),
        stats=stats,
    )


@functools.partial(jax.jit, static_argnames=("method", "block_rows", "lengths", "route"))
def _range(u, y, *, method, block_rows, lengths, route):
    """Left singular vectors and singular values of the projected data."""
    w = jnp.concatenate([u, y], axis=1)
    power = jnp.sqrt(jnp.mean(w * w, axis=0))
    scale = jnp.where(power > 0.0, power, 1.0)
    factor, conditioning = data_factor(
        w,
        scale,
        lengths,
        block_rows=block_rows,
        nu=u.shape[1],
        past_outputs=method.past_outputs,
        route=route,
    )
    projected, weight = method.project(factor)
    vectors, values = left_range(projected, squared=route == "gram")
    if weight is not None:
        vectors = jnp.linalg.solve(weight, vectors)
    columns = sum(n - 2 * block_rows + 1 for n in lengths)
    return dict(
        vectors=vectors,
        singular_values=values / math.sqrt(columns),
        scale=scale,
        smallest_pivot=conditioning.smallest_pivot,
        excitation_rank=conditioning.excitation_rank,
        reflections=jnp.asarray(route == "qr"),
    )


@functools.partial(
    jax.jit, static_argnames=("order", "full_rank", "feedthrough", "stabilise", "windows")
)
def _complete(found, u, y, rounding, *, order, full_rank, feedthrough, stabilise, windows):
    """A and C of a given order, then B, D and x0 of every window."""
    nu = u.shape[1]
    scale = found["scale"]
    values = found["singular_values"]
    observability = found["vectors"][:, :order] * jnp.sqrt(values[:order])[None, :]
    A, C = realise(observability, y.shape[1])
    moved = jnp.asarray(0)
    if stabilise is not False:
        A, moved = move_inside(A, stabilise)
    linear = solve(
        record_equations(A, C, u / scale[None, :nu], y / scale[None, nu:], windows),
        nx=order,
        feedthrough=feedthrough,
    )
    B = linear.B / scale[None, :nu]
    D = linear.D * scale[nu:, None] / scale[None, :nu]
    C = C * scale[nu:, None]
    radius = spectral_radius(A)
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in (A, B, C, D, linear.x0)]))
    poor = (values[order - 1] <= rounding * values[0]) | (found["excitation_rank"] < full_rank)
    status = Status.where(radius > 1.0 + _STABILITY_MARGIN, Status.unstable, Status.successful)
    status = Status.where(poor, Status.ill_conditioned, status)
    status = Status.where(finite, status, Status.nonfinite)
    return dict(
        A=A,
        B=B,
        C=C,
        D=D,
        x0=linear.x0,
        status=status,
        successful=status == Status.successful,
        spectral_radius=radius,
        eigenvalues_moved=moved,
        residual_std=jnp.sqrt(linear.residual / sum(windows)) * scale[nu:],
        window=jnp.asarray(0),
    )


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
    again = complete(windows=tuple(windows))
    return again | dict(x0=again["x0"][np.array(firsts)], window=jnp.asarray(window))


def _report(
    fit: Fit,
    data: IOData,
    method: AbstractSubspaceMethod,
    block_rows: int,
    rounding: float,
    throw: bool,
) -> None:
    """Raise or warn, with the channel and the remedy."""
    if fit.status == Status.unstable:
        remedies = [
            "Ask for stabilise=0.9999",
            f"lower the order ({fit.order})",
            f"raise block_rows ({block_rows})",
        ]
        if not method.past_outputs:
            remedies.append("use past outputs as instruments")
        warnings.warn(
            f"The identified model is unstable (spectral radius "
            f"{float(fit.stats['spectral_radius']):.6g}). {', '.join(remedies[:-1])}, or "
            f"{remedies[-1]}.",
            stacklevel=3,
        )
    elif fit.status == Status.ill_conditioned:
        if int(fit.stats["excitation_rank"]) < 2 * block_rows * data.nu:
            if throw:
                raise ValueError(describe_excitation(data, block_rows))
            return
        values = np.asarray(fit.singular_values)
        rank = int(np.sum(values > rounding * values[0]))
        warnings.warn(
            f"order={fit.order} is above the numerical rank of the data ({rank}): the states "
            f"beyond it are rounding noise. Use order={rank}, or data that excite more modes.",
            stacklevel=3,
        )
    elif throw:
        raise ValueError(
            "The fit is not finite. Look for outliers, extreme channel scales or an order "
            f"({fit.order}) far above the system's; throw=False returns it as it is."
        )
