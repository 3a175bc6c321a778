"""Torque that repeats with the angle: cogging, commutation, gear teeth."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.effects._law import AbstractStaticLaw, Amplitude, Scales, Shape, Signals

_ORDERS = np.array([2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32, 48, 64], dtype=float)


class TorqueRipple(AbstractStaticLaw):
    """τ = c1 sin N q + c2 cos N q, N periods a turn.

    Seen as: locked to the angle, so its frequency follows the speed. Confused with a periodic
    disturbance (locked to the clock: change the speed), and where the angle moves little with
    stiffness, gravity and a bias.

    Source: Holtz and Springob, IEEE Trans. Industrial Electronics 43 (1996) 309–317.

    Example:
        >>> law = TorqueRipple()
        >>> law.regressors(at(position=np.pi / 8), jnp.array([4.0]), jnp.zeros(2)).round(9)
        Array([1., 0.], dtype=float64)
    """

    name: ClassVar[str] = "torque-ripple"
    family: ClassVar[str] = "ripple"
    ports: ClassVar[tuple[str, ...]] = ("force",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (
        Amplitude("c1", "{acts_on}"),
        Amplitude("c2", "{acts_on}"),
    )
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("N", "1"),)
    whole: ClassVar[bool] = False
    angular: ClassVar[bool] = True

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """sin N q, cos N q."""
        del memory
        phase = shape[0] * signals.position
        return jnp.stack([jnp.sin(phase), jnp.cos(phase)])

    def grid(self, scales: Scales) -> np.ndarray:
        """At most eight orders: the lowest of those whose period the angle and the sampling see."""
        lower, upper = self.bounds(scales)
        seen = _ORDERS[(lower[0] < _ORDERS) & (upper[0] > _ORDERS)]
        return (seen[:8] if seen.size else np.sqrt(lower * upper))[:, None]

    def bounds(self, scales: Scales) -> tuple[np.ndarray, np.ndarray]:
        """From a third of a period within the peak angle, 1.5 at least, to a quarter of the
        sampling at peak speed, 80 at most."""
        low = max(1.5, 2.0 / max(scales.position.peak, 1e-3))
        high = 0.5 * np.pi / max(scales.velocity.peak * scales.dt, 1e-9)
        return np.array([low]), np.array([max(min(high, 80.0), 2.0 * low)])
