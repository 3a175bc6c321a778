"""Laws along the path that their signals take over a step."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.effects import AbstractLaw, Signals

AMPLITUDES = 2
"""Amplitudes that a law may have at most."""


def path_rule(spots: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where on its way over a step a law is read, for a sharp one may switch in between.

    Args:
        spots: how many, odd.

    Returns:
        Fractions of the step, Simpson's weights for the mean, weights for a straight line's slope.
    """
    fractions = np.linspace(0.0, 1.0, spots)
    weights = np.where(np.arange(spots) % 2 == 1, 4.0, 2.0)
    weights[[0, -1]] = 1.0
    weights = weights / np.sum(weights)
    slopes = weights * (fractions - 0.5)
    return fractions, weights, slopes / np.sum(slopes * (fractions - 0.5))


def path_of(law: AbstractLaw):
    """A law along the path that its signals take over a step.

    The function takes its signals at several fractions of the step (fraction,), those in the
    step's middle, the fractions times the step in s, the shape, the memory, and the step in s; it
    gives the regressors (fraction, amplitude) and the memory at the step's end.

    Args:
        law: of the library.
    """
    own, spare = len(law.shapes), AMPLITUDES - len(law.amplitudes)

    def evaluate(path: Signals, middle: Signals, after: Array, shape: Array, memory: Array, dt):
        shape = shape[:own]

        def at(signals, passed):
            now = law.advance(middle, shape, memory, passed) if law.memory else memory
            return law.regressors(signals, shape, now)

        values = jax.vmap(at)(path, after)
        end = law.advance(middle, shape, memory, dt) if law.memory else memory
        return jnp.concatenate([values, jnp.zeros((values.shape[0], spare))], axis=1), end

    return evaluate


def moments(values: Float[Array, "fraction *rest"]) -> tuple[Array, Array]:
    """Start and change over a step of the straight line that fits values along it.

    Args:
        values: at the fractions of `path_rule`.
    """
    _, weights, slopes = path_rule(values.shape[0])
    mean = jnp.tensordot(jnp.asarray(weights), values, axes=1)
    change = jnp.tensordot(jnp.asarray(slopes), values, axes=1)
    return mean - 0.5 * change, change
