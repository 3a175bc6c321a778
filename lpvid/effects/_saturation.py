"""Limits of an actuator."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.effects._law import AbstractStaticLaw, Amplitude, Scales, Shape, Signals
from lpvid.effects._ranges import span
from lpvid.effects._smooth import clip


class Saturation(AbstractStaticLaw):
    """An actuator with a limit, u → clip(u, U): adds a [clip(u, U) − u], a = 1 once found.

    Seen as: at large |u| only. Confused with a cubic gain: raise the amplitude.

    Source: Ljung, System Identification (Prentice Hall 1999), section 5.2, input nonlinearities.

    Example:
        >>> Saturation().regressors(at(input=3.0), jnp.array([1.0]), jnp.zeros(2)).round(3)
        Array([-2.], dtype=float64)
    """

    name: ClassVar[str] = "saturation"
    family: ClassVar[str] = "saturation"
    ports: ClassVar[tuple[str, ...]] = ("input",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (Amplitude("a", "1", positive=True),)
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("U", "{acts_on}"),)
    whole: ClassVar[bool] = True

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """clip(u, U) − u."""
        del memory
        return jnp.stack([clip(signals.input, shape[0]) - signals.input])

    def grid(self, scales: Scales) -> np.ndarray:
        """Four limits U, 0.35 to 0.9 of the peak."""
        lower, upper = self.bounds(scales)
        return upper * np.array([[0.35], [0.55], [0.75], [0.9]])

    def bounds(self, scales: Scales) -> tuple[np.ndarray, np.ndarray]:
        """From 0.15 to 0.98 of the input's peak."""
        low, high = span(0.15 * scales.input.peak, 0.98 * scales.input.peak)
        return np.array([low]), np.array([high])
