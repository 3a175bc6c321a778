"""The classical Runge–Kutta rule, the input held."""

from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

Dynamics: TypeAlias = Callable[[Array, Array], Array]


def runge_kutta_step(
    dynamics: Dynamics, state: Float[Array, " state"], held: Array, step: ArrayLike
) -> Float[Array, " state"]:
    """One step of the classical Runge–Kutta method for ẋ = f(x, u), u held.

    Of fourth order, and stable while |λ| step < 2.61 for the fastest pole λ.

    Args:
        dynamics: f(x, u).
        state: x at the step's start.
        held: u, whatever f takes.
        step: length of the step, s.

    Returns:
        x at the step's end.

    Example:
        >>> from lpvid.models import runge_kutta_step
        >>> runge_kutta_step(lambda x, u: u - x, jnp.zeros(1), jnp.ones(1), 0.1)
        Array([0.0951625], dtype=float64)
    """
    # The four stages as a loop: the dynamics are traced and compiled once instead of four times.
    look_ahead = jnp.array([0.0, 0.5, 0.5, 1.0])
    weights = jnp.array([1.0, 2.0, 2.0, 1.0]) / 6.0

    def stage(carry, coefficients):
        slope, increment = carry
        ahead, weight = coefficients
        slope = dynamics(state + step * ahead * slope, held)
        return (slope, increment + weight * slope), None

    zero = jnp.zeros_like(state)
    (_, increment), _ = jax.lax.scan(stage, (zero, zero), (look_ahead, weights))
    return state + step * increment
