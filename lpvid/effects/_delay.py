"""Dead time of an actuator."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.effects._law import HISTORY, AbstractLaw, Amplitude, Scales, Shape, Signals
from lpvid.effects._smooth import LEAST_WIDTH


class InputDelay(AbstractLaw):
    """u(t) → u(t − d): adds u(t − d) − u(t), d of whole and broken samples.

    Of an input held over the sample, a delay of m + f samples passes u_{k−m−1} for f of the sample
    and u_{k−m} for the rest; the regressor is their mean. The memory holds the sample time, which a
    law learns when it is advanced: at a record's first sample nothing is delayed yet.

    Seen as: phase −ω d at a flat gain. Confused with an actuator lag (gain rolls off), a missing
    fast mode.

    Source: Ljung, System Identification (Prentice Hall 1999), section 4.2; Åström and Wittenmark,
    Computer-Controlled Systems (Prentice Hall 1997), section 2.4.

    Example:
        >>> past = jnp.array([4.0, 2.0] + 11 * [0.0])
        >>> signals = at(input=4.0, history=past)
        >>> InputDelay().regressors(signals, jnp.array([0.015]), jnp.array([0.01, 0.0]))
        Array([-3.], dtype=float64)
    """

    name: ClassVar[str] = "input-delay"
    family: ClassVar[str] = "delay"
    ports: ClassVar[tuple[str, ...]] = ("input",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (Amplitude("a", "1", positive=True),)
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("d", "{time}"),)
    whole: ClassVar[bool] = True
    memory: ClassVar[int] = 1

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """u(t − d) − u(t)."""
        known = memory[0] > LEAST_WIDTH
        samples = jnp.where(known, shape[0] / jnp.where(known, memory[0], 1.0), 0.0)
        samples = jnp.clip(samples, 0.0, HISTORY - 1.0)
        weights = jnp.maximum(1.0 - jnp.abs(samples - jnp.arange(HISTORY, dtype=float)), 0.0)
        return jnp.stack([weights @ signals.history - signals.history[0]])

    def advance(
        self,
        signals: Signals,
        shape: Float[Array, " shape"],
        memory: Float[Array, " memory"],
        dt: Float[Array, ""],
    ) -> Float[Array, " memory"]:
        """The sample time."""
        del signals, shape
        return memory.at[0].set(dt)

    def grid(self, scales: Scales) -> np.ndarray:
        """0.7, 1.6, 3.4 and 7.2 samples, in s."""
        return scales.dt * np.array([[0.7], [1.6], [3.4], [7.2]])

    def bounds(self, scales: Scales) -> tuple[np.ndarray, np.ndarray]:
        """From none to twelve samples, in s."""
        return np.array([0.0]), np.array([(HISTORY - 1.0) * scales.dt])
