"""Constants that were taken for zero."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from lpvid.effects._law import AbstractShapelessLaw, Amplitude, Signals


class TorqueBias(AbstractShapelessLaw):
    """A constant at an input or a force at a coordinate, τ = b.

    Seen as: a mean that the plant filters. Confused with a sensor's bias (under an integrator not:
    that one does not drift), asymmetric friction (zero at rest), gravity.

    Source: Janot, Gautier and Brunot, EMPS benchmark (2019), offset of the drive.

    Example:
        >>> TorqueBias().regressors(at(), jnp.zeros(0), jnp.zeros(2))
        Array([1.], dtype=float64)
    """

    name: ClassVar[str] = "torque-bias"
    family: ClassVar[str] = "bias"
    ports: ClassVar[tuple[str, ...]] = ("input", "force")
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (Amplitude("b", "{acts_on}"),)
    whole: ClassVar[bool] = False

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """1."""
        del signals, shape, memory
        return jnp.ones(1)


class SensorBias(AbstractShapelessLaw):
    """y → y + b.

    Seen as: a mean from the first sample on. Confused with a torque's bias; under an integrator the
    initial position takes it up and nothing can tell.

    Source: Ljung, System Identification (Prentice Hall 1999), section 14.1.

    Example:
        >>> SensorBias().regressors(at(), jnp.zeros(0), jnp.zeros(2))
        Array([1.], dtype=float64)
    """

    name: ClassVar[str] = "sensor-bias"
    family: ClassVar[str] = "bias"
    ports: ClassVar[tuple[str, ...]] = ("output",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (Amplitude("b", "{acts_on}"),)
    whole: ClassVar[bool] = False

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """1."""
        del signals, shape, memory
        return jnp.ones(1)
