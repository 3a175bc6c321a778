"""What creeps as time goes by."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from lpvid.effects._law import AbstractShapelessLaw, Amplitude, Signals


class SensorDrift(AbstractShapelessLaw):
    """y → y + c t.

    Seen as: a straight line in the output. Confused with a torque's bias on an integrator with
    friction, whose velocity is constant: the integrator's own start takes it up.

    Source: Ljung, System Identification (Prentice Hall 1999), section 14.1.

    Example:
        >>> SensorDrift().regressors(at(time=3.0), jnp.zeros(0), jnp.zeros(2))
        Array([3.], dtype=float64)
    """

    name: ClassVar[str] = "sensor-drift"
    family: ClassVar[str] = "drift"
    ports: ClassVar[tuple[str, ...]] = ("output",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (Amplitude("c", "{acts_on}/{time}"),)
    whole: ClassVar[bool] = False

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """t."""
        del shape, memory
        return jnp.stack([signals.time])


class ParameterDrift(AbstractShapelessLaw):
    """A parameter that warms up or wears, θ (1 + a φ), φ the time scaled to ±1.

    φ comes as the port's schedule.

    Seen as: skirts on the spectral lines, residuals that grow to both ends. Confused with a
    parameter that follows a measured signal.

    Source: Ljung and Söderström, Theory and Practice of Recursive Identification (MIT 1983).

    Example:
        >>> ParameterDrift().regressors(at(input=0.5), jnp.zeros(0), jnp.zeros(2))
        Array([0.5], dtype=float64)
    """

    name: ClassVar[str] = "parameter-drift"
    family: ClassVar[str] = "drift"
    ports: ClassVar[tuple[str, ...]] = ("parameter",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (Amplitude("a", "1"),)
    whole: ClassVar[bool] = False

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """φ, which multiplies the parameter."""
        del shape, memory
        return jnp.stack([signals.input])
