"""Smooth renderings of sign, absolute value, clip and dead zone, finite with all derivatives."""

import jax.numpy as jnp
from jaxtyping import Array, Float

LEAST_WIDTH = 1e-12
"""A width below this is taken for this one, so that an unused shape of zero does no harm."""

_CORNER = 1e-12
_ROUNDING = 0.02


def sign(x: Float[Array, ""], width: Float[Array, ""]) -> Float[Array, ""]:
    """sg(x) = tanh(x/width).

    Args:
        x: a signal.
        width: |x| where it has risen to 0.76.

    Example:
        >>> bool(sign(jnp.asarray(1.0), jnp.asarray(0.01)) == 1.0)
        True
    """
    return jnp.tanh(x / jnp.maximum(width, LEAST_WIDTH))


def magnitude(x: Float[Array, ""]) -> Float[Array, ""]:
    """|x| as √(x² + ε²), ε = 1e-12, below any measured signal.

    Args:
        x: a signal.

    Example:
        >>> round(float(magnitude(jnp.asarray(-2.0))), 6)
        2.0
    """
    return jnp.sqrt(x**2 + _CORNER**2)


def clip(x: Float[Array, ""], limit: Float[Array, ""]) -> Float[Array, ""]:
    """x within ±limit, ½ [√((x + U)² + ε²) − √((x − U)² + ε²)], corners of ε = 0.02 U.

    Args:
        x: a signal.
        limit: U.

    Example:
        >>> round(float(clip(jnp.asarray(5.0), jnp.asarray(2.0))), 3)
        2.0
    """
    limit = jnp.maximum(limit, LEAST_WIDTH)
    corner = (_ROUNDING * limit) ** 2
    return 0.5 * (jnp.sqrt((x + limit) ** 2 + corner) - jnp.sqrt((x - limit) ** 2 + corner))


def dead_zone(x: Float[Array, ""], gap: Float[Array, ""]) -> Float[Array, ""]:
    """dz(x, b) = x − clip(x, b): zero within ±gap, x ∓ gap beyond.

    Args:
        x: a signal.
        gap: b, half of the whole play.

    Example:
        >>> round(float(dead_zone(jnp.asarray(5.0), jnp.asarray(2.0))), 3)
        3.0
    """
    return x - clip(x, gap)


def mean_decay(x: Float[Array, ""]) -> Float[Array, ""]:
    """Mean of e^{-s} for s from 0 to x ≥ 0, (1 − e^{-x})/x.

    Args:
        x: how far it decays.

    Example:
        >>> float(mean_decay(jnp.asarray(0.0)))
        1.0
    """
    small = x < 1e-2
    away = jnp.where(small, 1.0, x)
    series = 1.0 - x / 2 * (1.0 - x / 3 * (1.0 - x / 4 * (1.0 - x / 5 * (1.0 - x / 6))))
    return jnp.where(small, series, -jnp.expm1(-away) / away)
