"""Steps of random height at random times: the excitation of the mass–spring–damper study (000)."""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray


def random_steps(
    key: PRNGKeyArray,
    n_samples: int,
    n_channels: int = 1,
    *,
    dt: float,
    amplitude: tuple[float, float] = (0.5, 1.0),
    hold: tuple[float, float] = (1.0, 4.0),
) -> Float[Array, "time channel"]:
    """Piecewise constant signals that jump at random times to random levels of either sign.

    Each channel draws on its own: levels with a magnitude uniform in `amplitude` and a random sign,
    held for a time uniform in `hold`.

    Args:
        key: random key.
        n_samples: length of the record.
        n_channels: number of signals.
        dt: sample time, s.
        amplitude: smallest and largest magnitude, in the input's unit.
        hold: shortest and longest time between jumps, s; at least one sample.

    Raises:
        ValueError: a count below one, or a range that is empty or not positive.

    Source: 000, section III and figure 2.

    Example:
        >>> random_steps(jax.random.key(0), 1000, 2, dt=5e-3).shape
        (1000, 2)
    """
    for name, count in (("n_samples", n_samples), ("n_channels", n_channels)):
        if count < 1:
            raise ValueError(f"{name}={count} must be at least 1.")
    if not (math.isfinite(dt) and dt > 0.0):
        raise ValueError(f"dt={dt}: give the sample time in seconds, positive.")
    for name, (low, high) in (("amplitude", amplitude), ("hold", hold)):
        if not 0.0 < low <= high < math.inf:
            raise ValueError(f"{name}={(low, high)}: give 0 < smallest <= largest.")
    shortest = max(hold[0] / dt, 1.0)
    longest = max(hold[1] / dt, shortest)
    # Enough for the shortest holds, so that the shape does not depend on the draw.
    shape = (math.ceil(n_samples / shortest) + 1, n_channels)
    times, sizes, signs = jax.random.split(key, 3)
    ends = jnp.cumsum(jax.random.uniform(times, shape, float, shortest, longest), axis=0)
    levels = jax.random.uniform(sizes, shape, float, *amplitude)
    levels *= jax.random.rademacher(signs, shape, float)
    sample = jnp.arange(n_samples, dtype=float)
    interval = jax.vmap(lambda column: jnp.searchsorted(column, sample, side="right"), 1, 1)(ends)
    return jnp.take_along_axis(levels, interval, axis=0)
