"""Weight."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from lpvid.effects._law import AbstractShapelessLaw, Amplitude, Signals


class Gravity(AbstractShapelessLaw):
    """Weight of a pendulum whose angle counts from anywhere, τ = −g1 sin q − g2 cos q.

    Seen as: static in the angle, there at rest. Confused with a bias and stiffness where the angle
    moves little.

    Source: Craig, Introduction to Robotics (Pearson 2005), section 6.7, G(Θ).

    Example:
        >>> Gravity().regressors(at(position=0.5 * np.pi), jnp.zeros(0), jnp.zeros(2)).round(9)
        Array([-1., -0.], dtype=float64)
    """

    name: ClassVar[str] = "gravity"
    family: ClassVar[str] = "gravity"
    ports: ClassVar[tuple[str, ...]] = ("force",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (
        Amplitude("g1", "{acts_on}"),
        Amplitude("g2", "{acts_on}"),
    )
    whole: ClassVar[bool] = False
    angular: ClassVar[bool] = True

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """−sin q, −cos q."""
        del shape, memory
        return -jnp.stack([jnp.sin(signals.position), jnp.cos(signals.position)])
