"""What a controller is tuned for."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def itae(error: Float[Array, "*batch time"], dt: float) -> Float[Array, "*batch"]:
    """Integral of time-multiplied absolute error, Δt Σ t(k) |e(k)| with t(k) = k Δt, k = 0, 1, …

    Args:
        error: e(k), time last.
        dt: sample time Δt, s.

    Returns:
        The integral, in units of the error times s².

    Source: 002, equation 4-1.

    Example:
        >>> itae(jnp.array([5.0, 1.0, -1.0]), 0.5).item()
        0.75
    """
    time = dt * jnp.arange(error.shape[-1], dtype=float)
    return dt * jnp.sum(jnp.abs(error) * time.reshape((1,) * (error.ndim - 1) + (-1,)), axis=-1)
