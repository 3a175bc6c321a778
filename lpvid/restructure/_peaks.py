"""Peaks of the error along the frequency, and the error there as a function of the parameters."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from lpvid._types import Scalar
from lpvid.analysis import peak_frequencies
from lpvid.models import AbstractStructure, StateSpace
from lpvid.restructure._local_model import ErrorAt
from lpvid.restructure._matching import (
    Target,
    error_system,
    is_stable,
    largest_gain,
    response_error,
    weighted_response,
)

# Beyond all poles: as good as infinite frequency, where only D is left.
_FAR = 1e7
# Below this share of the black box's own gain an error is rounding.
_EXACT = 1e-10
_MOST_PEAKS = 12
# Frequencies taken from where the gain is flat; a pole's phases that they are looked for at.
_PLATEAU = 24
_PHASES = np.pi / 4.0 * np.array([-1.8, -1.4, -1.0, -0.6, -0.2, 0.2, 0.6, 1.0, 1.4, 1.8])


class Places(NamedTuple):
    """Where gains are looked at: frequencies, and for a grid the lines that they are."""

    omega: Float[Array, " place"]
    line: Int[Array, " place"]


def join_places(first: Places, second: Places) -> Places:
    """The places of both."""
    return Places(*(jnp.concatenate(pair) for pair in zip(first, second, strict=True)))


class Peaks(NamedTuple):
    """The highest local maxima of the error's gain.

    Attributes:
        places: where they are; the last one is infinite frequency unless a grid is the target.
        gains: largest singular value at each.
        norm: the largest of all; infinite for a model that is refused.
        floor: a norm that is no more than rounding errors.
    """

    places: Places
    gains: Float[Array, " place"]
    norm: Scalar
    floor: Scalar


def find_peaks(
    structure: AbstractStructure, parameters: Array, target: Target, stable: bool
) -> Peaks:
    """Peaks of ‖Σ(jω, ϑ)‖ and their maximum; infinite where `stable` and the model is not."""
    floor = _EXACT * largest_gain(weighted_response(target))
    if target.black_box is None:
        gains = jnp.linalg.svd(response_error(structure, parameters, target), compute_uv=False)
        # Up to one more line than there are parameters can be active at once.
        count = min(gains.shape[0], 2 * parameters.shape[0] + 8)
        gains, lines = jax.lax.top_k(gains[:, 0], count)
        places = Places(target.omega[lines], lines)
    else:
        safe, finite = _safe_system(structure, parameters, target)
        omega, gains = peak_frequencies(safe, min(max(safe.nx // 2 + 2, 4), _MOST_PEAKS))
        direct = jnp.linalg.svd(safe.D, compute_uv=False)[:1]
        gains = jnp.where(finite, jnp.concatenate([gains, direct]), jnp.inf)
        omega = jnp.concatenate([omega, _FAR * target.omega[-1:]])
        places = Places(omega, jnp.zeros(omega.shape, int))
    norm = jnp.max(gains)
    if stable:
        norm = jnp.where(is_stable(structure, parameters), norm, jnp.inf)
    return Peaks(places, gains, jnp.where(jnp.isfinite(norm), norm, jnp.inf), floor)


def _safe_system(
    structure: AbstractStructure, parameters: Array, target: Target
) -> tuple[StateSpace, Bool[Array, ""]]:
    """The error, zero where it is not finite: NaN in LAPACK is undefined behaviour at best."""
    system = error_system(structure, parameters, target)
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(system)]))
    return jax.tree.map(lambda leaf: jnp.where(finite, leaf, 0.0), system), finite


def error_at(
    structure: AbstractStructure, parameters: Array, shape: Array, target: Target, places: Places
) -> ErrorAt:
    """Σ at the places after a step along `shape`'s columns and relative shifts of frequencies."""

    def at(step, shift):
        moved = parameters + shape @ step
        on_grid = target.black_box is None
        there = target.lines(places.line) if on_grid else target.on(places.omega * (1.0 + shift))
        error = response_error(structure, moved, there)
        wide = error.shape[2] > error.shape[1]
        return jnp.swapaxes(error, 1, 2) if wide else error

    return at


def plateau(
    structure: AbstractStructure, parameters: Array, target: Target, peaks: Peaks, tolerance: float
) -> Places:
    """Active frequencies besides the peaks, spread out: an all-pass error is active everywhere.

    The highest peak again where there are none.
    """
    poles = _safe_system(structure, parameters, target)[0].poles()
    near = jnp.imag(poles)[:, None] + jnp.real(poles)[:, None] * jnp.tan(_PHASES)[None]
    omega = jnp.sort(jnp.concatenate([target.omega, jnp.abs(near).reshape(-1)]))
    error = response_error(structure, parameters, target.on(omega))
    gains = jnp.linalg.svd(error, compute_uv=False)[:, 0]
    active = gains >= (1.0 - tolerance) * peaks.norm
    order = jnp.argsort(~active, stable=True)
    count = jnp.sum(active)
    chosen = jnp.linspace(0.0, 1.0, _PLATEAU) * jnp.maximum(count - 1, 0).astype(float)
    omega = omega[order[jnp.round(chosen).astype(int)]]
    omega = jnp.where(count > 0, omega, peaks.places.omega[0])
    return Places(omega, jnp.zeros(omega.shape, int))
