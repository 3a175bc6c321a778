"""The compiled stages of an identification: range of the observability matrix, then the rest."""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lpvid._results import Status
from lpvid.identify._factor import (
    Factored,
    Layout,
    Route,
    factor_of_gram,
    factor_of_triangle,
    solve_lower,
)
from lpvid.identify._gram import HankelMoments, hankel_factor, hankel_gram, hankel_moments
from lpvid.identify._innovation import Projections
from lpvid.identify._linear_fit import solve
from lpvid.identify._methods import AbstractSubspaceMethod
from lpvid.identify._realise import left_range, move_inside, realise, spectral_radius
from lpvid.identify._simulation_error import NormalEquations, record_equations

# The radius is known to about 1e-9; an integrator is not called unstable for that.
STABILITY_MARGIN = 1e-8
# Range of a channel, as a share of its size, up to which it is constant.
STILL = 1e-12


def channel_scale(
    total: Float[Array, " channel"], square: Float[Array, " channel"], n: int, offset: bool
) -> Float[Array, " channel"]:
    """What every channel is divided by, from its sums over n samples near their mean."""
    mean = total / n
    power = square / n - mean * mean if offset else square / n
    # Not by the root of zero: its derivative is not finite.
    moves = power > 0.0
    return jnp.where(moves, jnp.sqrt(jnp.where(moves, power, 1.0)), 1.0)


def never_moves(signal: Float[Array, "time channel"]) -> Bool[Array, " channel"]:
    """Which channels stay at their first sample, but for rounding."""
    first = signal[:1]
    return jnp.max(jnp.abs(signal - first), axis=0) <= STILL * jnp.abs(first[0])


@functools.partial(jax.jit, static_argnames=("method", "layout", "lengths", "route", "correlate"))
def range_of_records(u, y, *, method, layout, lengths, route, correlate):
    """Left singular vectors and values of the projected data, and what was seen on the way."""
    w = jnp.concatenate([u, y], axis=1)
    still = jnp.any(never_moves(w))
    centre = jnp.zeros(w.shape[1])
    if method.offset:
        centre = jnp.mean(w, axis=0)
        w = w - centre[None]
    total, square = jnp.sum(w, axis=0), jnp.sum(w * w, axis=0)
    scale = channel_scale(total, square, w.shape[0], method.offset)
    columns = layout.columns(lengths)
    if route == "qr":
        whole = hankel_factor(w / scale[None], lengths, layout.rows(), constant=method.offset)
        found = range_of_triangle(whole, centre, scale, columns, method, layout, correlate)
    else:
        moments = hankel_moments(w, lengths, layout.n_lags)
        found = range_of_moments(moments, centre, scale, columns, method, layout, correlate)
    return found | dict(still=still)


def range_of_moments(
    moments: HankelMoments,
    centre: Array,
    scale: Array,
    columns: int,
    method: AbstractSubspaceMethod,
    layout: Layout,
    correlate: bool,
) -> dict[str, Any]:
    """The same from the moments of the data, by the Gram matrix."""
    rows = layout.rows()
    weight = 1.0 / (scale * math.sqrt(columns))[rows[:, 1]]
    gram = hankel_gram(moments, rows, columns, constant=method.offset)
    factored = factor_of_gram(gram * weight[:, None] * weight[None, :], layout)
    return _range(factored, centre, scale, method, "gram", layout, correlate)


def range_of_triangle(
    whole: Array,
    centre: Array,
    scale: Array,
    columns: int,
    method: AbstractSubspaceMethod,
    layout: Layout,
    correlate: bool,
) -> dict[str, Any]:
    """The same from the triangle that reflections gave of the scaled data."""
    factored = factor_of_triangle(whole / math.sqrt(columns), layout)
    return _range(factored, centre, scale, method, "qr", layout, correlate)


def _range(factored: Factored, centre, scale, method, route: Route, layout, correlate):
    factor, now, conditioning = factored
    projected, root = method.project(factor)
    vectors, values = left_range(projected, squared=route == "gram")
    if root is not None:
        vectors = root @ vectors
    correlations = jnp.zeros(0)
    if correlate and factor.outputs_instruments.shape[1]:
        whitened = solve_lower(factor.future_root(), factor.outputs_instruments)
        correlations = jnp.linalg.svd(whitened, compute_uv=False)
    projections = None
    if layout.past_outputs:
        projections = Projections(
            inputs=factor.inputs,
            outputs_inputs=factor.outputs_inputs,
            outputs_instruments=factor.outputs_instruments,
            outputs_now=now,
        )
    return dict(
        vectors=vectors,
        singular_values=values,
        correlations=correlations,
        projections=projections,
        centre=centre,
        scale=scale,
        smallest_pivot=conditioning.smallest_pivot,
        excitation_pivot=conditioning.excitation_pivot,
        excitation_rank=conditioning.excitation_rank,
        reflections=jnp.asarray(route == "qr"),
    )


def realisation(
    found: dict[str, Any], ny: int, order: int, stabilise
) -> tuple[Float[Array, "nx nx"], Float[Array, "ny nx"], Array]:
    """A, C of the scaled outputs, and how many eigenvalues were moved."""
    weight = jnp.sqrt(found["singular_values"][:order])
    A, C = realise(found["vectors"][:, :order] * weight[None, :], ny)
    if stabilise is False:
        return A, C, jnp.asarray(0)
    A, moved = move_inside(A, stabilise)
    return A, C, moved


def scaled_signals(found: dict[str, Any], u: Array, y: Array, offset: bool) -> tuple[Array, Array]:
    """Inputs and outputs as B and D are estimated from: scaled, a row of ones for an offset.

    Inputs keep their mean: only with it does a constant state belong to it.
    """
    nu = u.shape[1]
    scale = found["scale"]
    u, y = u / scale[None, :nu], (y - found["centre"][None, nu:]) / scale[None, nu:]
    if offset:
        u = jnp.concatenate([u, jnp.ones((u.shape[0], 1))], axis=1)
    return u, y


@functools.partial(
    jax.jit,
    static_argnames=("order", "full_rank", "feedthrough", "stabilise", "offset", "windows"),
)
def complete_records(
    found, u, y, rounding, *, order, full_rank, feedthrough, stabilise, offset, windows
):
    """A and C of a given order, then B, D, offset and x0 of every window."""
    A, C, moved = realisation(found, y.shape[1], order, stabilise)
    equations = record_equations(A, C, *scaled_signals(found, u, y, offset), windows)
    return finish(
        found,
        A,
        C,
        moved,
        equations,
        rounding,
        samples=sum(windows),
        full_rank=full_rank,
        feedthrough=feedthrough,
        offset=offset,
    )


def finish(
    found: dict[str, Any],
    A: Array,
    C: Array,
    moved: Array,
    equations: NormalEquations,
    rounding: Array | float,
    *,
    samples: int,
    full_rank: int,
    feedthrough: bool,
    offset: bool,
) -> dict[str, Any]:
    """B, D, offset and x0 from the normal equations, in the channels' own units; status."""
    order, ny = A.shape[0], C.shape[0]
    scale, values = found["scale"], found["singular_values"]
    nu = scale.shape[0] - ny
    linear = solve(equations, nx=order, feedthrough=feedthrough, offset=offset)
    B = linear.B / scale[None, :nu]
    D = linear.D * scale[nu:, None] / scale[None, :nu]
    C = C * scale[nu:, None]
    radius = spectral_radius(A)
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in (A, B, C, D, linear.x0)]))
    poor = (values[order - 1] <= rounding * values[0]) | (found["excitation_rank"] < full_rank)
    status = Status.where(radius > 1.0 + STABILITY_MARGIN, Status.unstable, Status.successful)
    status = Status.where(poor, Status.ill_conditioned, status)
    status = Status.where(finite, status, Status.nonfinite)
    # It may be why the fit is poor or not finite.
    status = Status.where(found["still"], Status.constant_channel, status)
    return dict(
        A=A,
        B=B,
        C=C,
        D=D,
        x0=linear.x0,
        output_offset=linear.offset * scale[nu:] + found["centre"][nu:],
        normal_matrix=equations.matrix,
        status=status,
        successful=status == Status.successful,
        spectral_radius=radius,
        eigenvalues_moved=moved,
        residual_std=jnp.sqrt(linear.residual / samples) * scale[nu:],
        window=jnp.asarray(0),
    )
