"""Clamped-free modes of a uniform beam: their shapes, slopes and curvatures, as numbers."""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float
from scipy.optimize import brentq


class BeamTables(NamedTuple):
    """Modes at quadrature stations of a beam of unit length.

    Attributes:
        stations: Gauss–Legendre nodes in (0, 1), and the tip, 1.
        weights: of the nodes, sum one; zero for the tip.
        shapes: φ_i (station, mode), ∫φ_i φ_j = δ_ij.
        shortening: ∫₀ˣ φ_i′ φ_j′ (station, mode, mode): twice the shortening of the beam's chord
            per unit of η_i η_j.
        wave_numbers: β_i (mode,), roots of cos β cosh β = −1.
    """

    stations: np.ndarray
    weights: np.ndarray
    shapes: np.ndarray
    shortening: np.ndarray
    wave_numbers: np.ndarray


@functools.cache
def beam_tables(n_modes: int) -> BeamTables:
    """Tables for the first `n_modes` modes; exact to rounding for energies of those modes."""
    wave_numbers = _wave_numbers(n_modes)
    # Products of two shapes vary like exp(2 β x): this many nodes integrate them to rounding.
    nodes, weights = np.polynomial.legendre.leggauss(12 + 4 * n_modes)
    stations = np.append((nodes + 1.0) / 2.0, 1.0)
    # From 0 to each station by the same rule, squeezed.
    inner = stations[:, None] * (nodes[None, :] + 1.0) / 2.0
    slopes = np.asarray(_shape(wave_numbers, inner, derivative=1, xp=np))
    products = np.einsum("sqi,sqj,q->sij", slopes, slopes, weights / 2.0)
    return BeamTables(
        stations=stations,
        weights=np.append(weights / 2.0, 0.0),
        shapes=np.asarray(_shape(wave_numbers, stations, derivative=0, xp=np)),
        shortening=stations[:, None, None] * products,
        wave_numbers=wave_numbers,
    )


def curvatures(n_modes: int, places: ArrayLike) -> Float[Array, "place mode"]:
    """Curvatures φ_i″ at places x / ℓ in [0, 1], differentiable in the places."""
    numbers = _wave_numbers(n_modes)
    return jnp.asarray(_shape(numbers, jnp.asarray(places, float), derivative=2, xp=jnp))


@functools.cache
def _wave_numbers(n_modes: int) -> np.ndarray:
    # cos β + 1 / cosh β: the same roots as cos β cosh β + 1, without its growth.
    guesses = (np.arange(n_modes) + 0.5) * np.pi
    return np.array(
        [brentq(lambda b: np.cos(b) + 1.0 / np.cosh(b), g - 0.6, g + 0.6) for g in guesses]
    )


def _shape(wave_numbers, places, *, derivative, xp):
    """Derivatives of cosh − cos − σ (sinh − sin), its exponentials arranged not to cancel."""
    b = wave_numbers[(None,) * np.ndim(places)]
    x = places[..., None]
    sigma = (np.cosh(b) + np.cos(b)) / (np.sinh(b) + np.sin(b))
    # cosh − σ sinh = ½ (1 − σ) e^{βx} + ½ (1 + σ) e^{−βx}, with 1 − σ written without a difference.
    less = (np.sin(b) - np.cos(b) - np.exp(-b)) / (np.sinh(b) + np.sin(b))
    growing, decaying = 0.5 * less * xp.exp(b * x), 0.5 * (1.0 + sigma) * xp.exp(-b * x)
    cosine, sine = xp.cos(b * x), xp.sin(b * x)
    if derivative == 0:
        return growing + decaying - cosine + sigma * sine
    if derivative == 1:
        return b * (growing - decaying + sine + sigma * cosine)
    return b**2 * (growing + decaying + cosine - sigma * sine)
