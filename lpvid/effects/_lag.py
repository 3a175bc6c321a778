"""First-order lags of an actuator and of a sensor."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.effects._law import AbstractLaw, Amplitude, Scales, Shape, Signals
from lpvid.effects._ranges import inside, span
from lpvid.effects._smooth import LEAST_WIDTH


def _range(scales: Scales) -> tuple[float, float]:
    # Slower than 200 samples, or a tenth of the record, is a matter of the plant.
    return span(0.1 * scales.dt, min(200.0 * scales.dt, 0.1 * scales.duration))


class ActuatorLag(AbstractLaw):
    """u → z, ż = (u − z)/τ: adds z − u.

    Held u gives z⁺ = u + (z − u) e^{−h/τ} exactly. It starts settled, which the second number of
    the memory is for.

    Seen as: gain that rolls off, with the phase of it. Confused with an input delay (flat gain), a
    sensor's lag (same response, but that one sees the disturbances too).

    Source: Franklin, Powell and Workman, Digital Control of Dynamic Systems (1998), section 4.3.

    Example:
        >>> law, tau, rest = ActuatorLag(), jnp.array([0.1]), jnp.zeros(2)
        >>> memory = law.advance(at(input=0.0), tau, rest, jnp.asarray(0.1))
        >>> law.regressors(at(input=2.0), tau, memory)
        Array([-2.], dtype=float64)
    """

    name: ClassVar[str] = "actuator-lag"
    family: ClassVar[str] = "lag"
    ports: ClassVar[tuple[str, ...]] = ("input",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (Amplitude("a", "1", positive=True),)
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("tau", "{time}"),)
    whole: ClassVar[bool] = True
    memory: ClassVar[int] = 2

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """z − u."""
        del shape
        return jnp.stack([memory[0] - memory[1] * signals.input])

    def advance(
        self,
        signals: Signals,
        shape: Float[Array, " shape"],
        memory: Float[Array, " memory"],
        dt: Float[Array, ""],
    ) -> Float[Array, " memory"]:
        """z one step later, exactly for a held input."""
        decay = jnp.exp(-dt / jnp.maximum(shape[0], LEAST_WIDTH))
        behind = memory[0] - memory[1] * signals.input
        return memory.at[:2].set(jnp.stack([signals.input + behind * decay, jnp.ones(())]))

    def grid(self, scales: Scales) -> np.ndarray:
        """Four time constants."""
        return inside(*_range(scales), 4)[:, None]

    def bounds(self, scales: Scales) -> tuple[np.ndarray, np.ndarray]:
        """From a tenth of a sample to 200 samples or a tenth of the record."""
        low, high = _range(scales)
        return np.array([low]), np.array([high])


class SensorLag(AbstractLaw):
    """y → z, ż = (y − z)/τ: adds z − y.

    Advanced by the output in the step's middle, held over it: z⁺ = y + (z − y) e^{−h/τ}. It starts
    settled, which the second number of the memory is for. (A form exact for straight outputs would
    take the jumps that an observer's corrections make for motion.)

    Seen as: gain that rolls off, with the phase of it, at one sensor. Confused with an actuator's
    lag and an input delay.

    Source: Franklin, Powell and Workman, Digital Control of Dynamic Systems (1998), section 4.3.

    Example:
        >>> law, tau, rest = SensorLag(), jnp.array([0.1]), jnp.zeros(2)
        >>> law.regressors(at(output=2.0), tau, rest)
        Array([0.], dtype=float64)
    """

    name: ClassVar[str] = "sensor-lag"
    family: ClassVar[str] = "lag"
    ports: ClassVar[tuple[str, ...]] = ("output",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (Amplitude("a", "1", positive=True),)
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("tau", "{time}"),)
    whole: ClassVar[bool] = True
    memory: ClassVar[int] = 2

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """z − y."""
        del shape
        return jnp.stack([memory[0] - memory[1] * signals.output])

    def advance(
        self,
        signals: Signals,
        shape: Float[Array, " shape"],
        memory: Float[Array, " memory"],
        dt: Float[Array, ""],
    ) -> Float[Array, " memory"]:
        """z at the step's end."""
        decay = jnp.exp(-dt / jnp.maximum(shape[0], LEAST_WIDTH))
        behind = memory[0] - memory[1] * signals.output
        return memory.at[:2].set(jnp.stack([signals.output + behind * decay, jnp.ones(())]))

    def grid(self, scales: Scales) -> np.ndarray:
        """Four time constants."""
        return inside(*_range(scales), 4)[:, None]

    def bounds(self, scales: Scales) -> tuple[np.ndarray, np.ndarray]:
        """From a tenth of a sample to 200 samples or a tenth of the record."""
        low, high = _range(scales)
        return np.array([low]), np.array([high])
