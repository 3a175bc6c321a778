"""Local maxima of the gain: the frequencies a surrogate of the H-infinity norm has to contain."""

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from lpvid.analysis._eigensolvers import AbstractEigensolver, default_eigensolver
from lpvid.analysis._hinf import (
    candidates,
    check_system,
    from_normalised,
    largest_peak,
    stability,
    to_normalised_continuous,
)
from lpvid.analysis._modal import (
    modal_form,
    reduced_form,
    refine_peaks,
    response,
    squared_gain,
    trustworthy,
)
from lpvid.models import StateSpace


def peak_frequencies(
    system: StateSpace, count: int
) -> tuple[Float[Array, "*batch {count}"], Float[Array, "*batch {count}"]]:
    """Frequencies of the highest local maxima of the largest singular value, highest first.

    Every pole's frequency, its half-power flanks, the midpoints between poles and zero are climbed
    from; the global maximum is the certified one of `hinf_norm`. Where there are fewer than `count`
    maxima the highest is repeated. Infinite frequency (continuous systems with D) is left out, so a
    gain that is reached only there does not appear; a discrete system's Nyquist frequency is an
    ordinary one. No derivatives: frequencies are for building grids. A system that cannot be
    diagonalised to working precision has its other candidates listed as they are, without the
    climb. Works under `jit` (with `count` static) and `vmap`. Where a pole lies on the stability
    boundary all gains are infinite, as the norm is.

    Args:
        system: continuous or discrete model with any leading batch axes.
        count: how many frequencies to return.

    Returns:
        Frequencies in rad/s and gains, both (..., count).

    Raises:
        ValueError: count below one, a system without states, or non-finite matrices (those are
            checked outside `jit` only).

    Example:
        >>> from lpvid.analysis import peak_frequencies
        >>> from lpvid.models import StateSpace
        >>> system = StateSpace([[0.0, 1.0], [-1.0, -0.02]], [[0.0], [1.0]], [[1.0, 0.0]])
        >>> omega, gain = peak_frequencies(system, 1)
        >>> round(float(omega[0]), 4), round(float(gain[0]), 4)
        (0.9999, 50.0025)
    """
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}.")
    check_system(system)
    matrices = lax.stop_gradient((system.A, system.B, system.C, system.D))
    batch = system.A.shape[:-2]
    flat = tuple(m.reshape(-1, *m.shape[-2:]) for m in matrices)
    omega, gain = _batched(flat, system.dt, count, default_eigensolver())
    return omega.reshape(*batch, count), gain.reshape(*batch, count)


@partial(jax.jit, static_argnums=(1, 2, 3))
def _batched(matrices, dt: float, count: int, eigensolver: AbstractEigensolver):
    single = partial(_single, dt=dt, count=count, eigensolver=eigensolver)
    return jax.vmap(single)(*matrices)


def _single(A, B, C, D, *, dt: float, count: int, eigensolver: AbstractEigensolver):
    continuous, unit = to_normalised_continuous(A, B, C, D, dt=dt)
    form = modal_form(*continuous, eigensolver)
    top, _ = largest_peak(form, continuous, jnp.array(True), 1e-10, eigensolver)
    omega, width = candidates(form)
    ordered = jnp.sort(omega)
    middle = 0.5 * (ordered[1:] + ordered[:-1])
    imag, rate = form.poles.imag, jnp.abs(form.poles.real)
    # A difference of two nearly equal modes has a peak on either side of them, none at the top.
    flanks = jnp.abs(jnp.abs(imag) + jnp.where(imag > 0.0, rate, -rate))
    omega = jnp.concatenate([jnp.where(jnp.isfinite(top), top, 0.0)[None], omega, middle, flanks])
    width = jnp.concatenate([jnp.zeros(1), width, 0.25 * (ordered[1:] - ordered[:-1]), 0.25 * rate])
    omega, squared = lax.cond(
        trustworthy(form),
        lambda start: refine_peaks(form, start[0], start[1], 12),
        lambda start: (
            start[0],
            squared_gain(response(reduced_form(*continuous, eigensolver), start[0])),
        ),
        (omega, width),
    )
    if dt > 0.0:
        # The bilinear map sends the Nyquist frequency to infinity, which no climb reaches.
        nyquist = squared_gain(continuous[3][None].astype(complex))
        omega, squared = jnp.append(omega, jnp.inf), jnp.append(squared, nyquist)
    squared = jnp.where(jnp.isfinite(squared), squared, 0.0)
    order = jnp.argsort(-squared)
    omega = from_normalised(omega[order], unit, dt)
    squared = squared[order]
    # Climbs that met: equal frequencies to the accuracy a peak is known with.
    near = jnp.abs(omega[:, None] - omega[None, :]) <= 1e-6 * (omega[:, None] + omega[None, :])
    repeated = jnp.any(jnp.tril(near, -1), axis=1)
    first = jnp.argsort(repeated, stable=True)
    keep = jnp.where(repeated[first], 0, first)
    keep = jnp.concatenate([keep, jnp.zeros(count, keep.dtype)])[:count]
    _, boundary = stability(form.poles, dt)
    return omega[keep], jnp.where(boundary, jnp.inf, jnp.sqrt(squared[keep]))
