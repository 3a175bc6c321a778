"""Exact steps of elements with hysteresis, for any length of step: never stiff."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from lpvid.effects._smooth import LEAST_WIDTH, magnitude, mean_decay


def dahl_step(
    z: Float[Array, ""], way: Float[Array, ""], length: Float[Array, ""]
) -> Float[Array, ""]:
    """z⁺ = σ + (z − σ) e^{−|w|/ℓ}, σ = sgn w: the solution of dz = (dq − |dq| z)/ℓ.

    Written as z e^{−x} + (w/ℓ)(1 − e^{−x})/x, x = |w|/ℓ, it needs no smoothing of the sign.

    Args:
        z: where it was, within ±1.
        way: w, the motion over the step.
        length: ℓ.

    Source: Dahl, Aerospace Corp. TOR-0158 (1968), exponent 1.

    Example:
        >>> round(float(dahl_step(jnp.asarray(0.0), jnp.asarray(1.0), jnp.asarray(1.0))), 4)
        0.6321
    """
    length = jnp.maximum(length, LEAST_WIDTH)
    x = magnitude(way) / length
    return z * jnp.exp(-x) + way / length * mean_decay(x)


def bouc_wen_step(
    z: Float[Array, ""],
    way: Float[Array, ""],
    length: Float[Array, ""],
    ratio: Float[Array, ""],
) -> Float[Array, ""]:
    """The solution of dz = [dq − |z| (ρ |dq| sgn z + (1 − ρ) dq)]/ℓ over a motion one way.

    In terms of x = |w|/ℓ and ζ = z sgn w: unloading, ζ < 0, dζ/dx = 1 − c ζ with c = 2ρ − 1;
    loading, ζ ≥ 0, dζ/dx = 1 − ζ. Both have closed forms, joined where ζ passes zero.

    Args:
        z: where it was, within ±1.
        way: w, the motion over the step.
        length: ℓ.
        ratio: ρ = β/(β + γ), ½ to 1; 1 gives `dahl_step`.

    Source: Wen, J. Engineering Mechanics 102 (1976) 249–263, exponent 1, β + γ = 1/ℓ.

    Example:
        >>> one, half = jnp.asarray(1.0), jnp.asarray(0.5)
        >>> float(bouc_wen_step(-half, 0.25 * one, one, half))
        -0.25
    """
    length = jnp.maximum(length, LEAST_WIDTH)
    side = jnp.where(way < 0.0, -1.0, 1.0)
    x = side * way / length
    c = jnp.maximum(2.0 * ratio - 1.0, 0.0)
    along = z * side
    behind, ahead = jnp.maximum(-along, 0.0), jnp.maximum(along, 0.0)
    # How far until ζ passes zero: log(1 + c·behind)/c, whatever c.
    small = c * behind < 1e-6
    safe = jnp.where(small, 1.0, c)
    to_zero = jnp.where(small, behind * (1.0 - 0.5 * c * behind), jnp.log1p(safe * behind) / safe)
    unloading = -behind * jnp.exp(-c * x) + x * mean_decay(c * x)
    loading = 1.0 - (1.0 - ahead) * jnp.exp(-jnp.maximum(x - to_zero, 0.0))
    return side * jnp.where(x < to_zero, unloading, loading)


def play_step(
    p: Float[Array, ""], position: Float[Array, ""], radius: Float[Array, ""]
) -> Float[Array, ""]:
    """p⁺ = max(q − r, min(q + r, p)): a slot of half width r pushed along by q.

    Args:
        p: where it was.
        position: q now.
        radius: r.

    Source: Visintin, Differential Models of Hysteresis (Springer 1994), section III.2.

    Example:
        >>> float(play_step(jnp.asarray(0.0), jnp.asarray(3.0), jnp.asarray(1.0)))
        2.0
    """
    return jnp.maximum(position - radius, jnp.minimum(position + radius, p))
