"""Dead time of an actuator."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.effects._law import HISTORY, AbstractStaticLaw, Amplitude, Scales, Shape, Signals
from lpvid.effects._smooth import LEAST_WIDTH


class InputDelay(AbstractStaticLaw):
    """u(t) → u(t − d): adds u(t − d) − u(t), d of whole and broken samples.

    Of an input held over the sample, a delay of m + f samples passes u_{k−m−1} for f of the sample
    and u_{k−m} for the rest; the regressor is their mean over the step that is taken.

    Seen as: phase −ω d at a flat gain. Confused with an actuator lag (gain rolls off), a missing
    fast mode.

    Source: Ljung, System Identification (Prentice Hall 1999), section 4.2; Åström and Wittenmark,
    Computer-Controlled Systems (Prentice Hall 1997), section 2.4.

    Example:
        >>> past = jnp.array([4.0, 2.0] + 11 * [0.0])
        >>> signals = at(input=4.0, history=past, sample=0.01)
        >>> InputDelay().regressors(signals, jnp.array([0.015]), jnp.zeros(2))
        Array([-3.], dtype=float64)
    """

    name: ClassVar[str] = "input-delay"
    family: ClassVar[str] = "delay"
    ports: ClassVar[tuple[str, ...]] = ("input",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (Amplitude("a", "1", positive=True),)
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("d", "{time}"),)
    whole: ClassVar[bool] = True

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """u(t − d) − u(t)."""
        del memory
        sample = jnp.maximum(signals.sample, LEAST_WIDTH)
        samples = jnp.clip(shape[0] / sample, 0.0, HISTORY - 1.0)
        width = jnp.clip(signals.step / sample, LEAST_WIDTH, 1.0)
        # The step as it was sent; entry i of the history was held from i samples ago on.
        begin = jnp.clip(signals.step_start / sample, 0.0, 1.0 - width) - samples
        held = -jnp.arange(HISTORY, dtype=float)
        shared = jnp.minimum(begin + width, held + 1.0) - jnp.maximum(begin, held)
        weights = jnp.maximum(shared, 0.0) / width
        return jnp.stack([weights @ signals.history - signals.history[0]])

    def grid(self, scales: Scales) -> np.ndarray:
        """0.7, 1.6, 3.4 and 7.2 samples, in s."""
        return scales.dt * np.array([[0.7], [1.6], [3.4], [7.2]])

    def bounds(self, scales: Scales) -> tuple[np.ndarray, np.ndarray]:
        """From none to twelve samples, in s."""
        return np.array([0.0]), np.array([(HISTORY - 1.0) * scales.dt])
