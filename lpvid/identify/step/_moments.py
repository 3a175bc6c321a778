r"""The moments ρ_i = p_i(∞) of repeated integrals, without repeating them.

With $e = p_0 - ρ_0 U$ and $V = sÛ$, p_i(t) = ∫ (p_{i-1} − ρ_{i-1} U) means
$Σ_i ρ_{i+1} s^i V(s) = E(s)$, a division of power series whose coefficients are plain moments
$∫ τ^i/i! e dτ$ and $∫ τ^i/i! (I − U) dτ$. Each is one sum of terms that die out, where the repeated
integrals sum up the rounding of every stage.
"""

from fractions import Fraction
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Integration = Literal["smooth", "held"]
_GREGORY_ORDER = 8


def _gregory() -> np.ndarray:
    """What Gregory's rule takes off the first weights of the plain sum.

    −1/log(1 + Δ) = −1/Δ − 1/2 + Δ/12 − …, Δ the forward difference: the integral from the first
    sample on is the sum less a combination of the differences there.
    """
    g: list[Fraction] = [Fraction(1)]
    for n in range(1, _GREGORY_ORDER + 2):
        terms = (g[n - j] * Fraction((-1) ** j, j + 1) for j in range(1, n + 1))
        g.append(-sum(terms, Fraction(0)))
    correction = np.zeros(_GREGORY_ORDER + 1)
    difference = np.array([1.0])
    for coefficient in g[1:]:
        correction[: difference.size] += float(coefficient) * difference
        difference = np.convolve(difference, [-1.0, 1.0])[: _GREGORY_ORDER + 1]
    return correction


_CORRECTION = _gregory()


def moment_weights(
    count: int, time: int, dt: float, integration: Integration
) -> Float[Array, "moment time"]:
    """Weights of the samples in the moments ∫ τ^i/i! f dτ, i = 0 … count − 1.

    Args:
        count: number of moments.
        time: number of samples.
        dt: sample time in seconds.
        integration: "smooth" for integrals of order eight in the sample time; "held" for the sums
            h^(i+1) C(k+i, i) f_k that belong to δ = (z − 1)/h.
    """
    k = np.arange(time)
    rows = [np.full(time, dt)]
    if integration == "held":
        for i in range(1, count):
            rows.append(rows[-1] * dt * (k + i) / i)
        return jnp.asarray(np.stack(rows))
    rows[0][: _CORRECTION.size] -= dt * _CORRECTION[:time]
    for i in range(1, count):
        rows.append(rows[-1] * dt * k / i)
    return jnp.asarray(np.stack(rows))


def divide_series(
    outputs: Float[Array, "moment ny nu"], inputs: Float[Array, "moment nu nu"]
) -> Float[Array, "moment ny nu"]:
    """ρ_1, ρ_2, … from the moments of e and of I − U."""
    rho = []
    for k in range(outputs.shape[0]):
        value = (-1.0) ** k * outputs[k]
        for j in range(1, k + 1):
            value = value - (-1.0) ** j * rho[k - j] @ inputs[j - 1]
        rho.append(value)
    return jnp.stack(rho)
