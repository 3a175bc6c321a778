"""Parameters that follow a measured signal."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from lpvid.effects._law import AbstractShapelessLaw, Amplitude, Signals


class Scheduling(AbstractShapelessLaw):
    """A parameter that varies with a measured signal, θ (1 + a φ), φ the signal scaled to ±1.

    φ comes as the port's schedule.

    Seen as: the residual times the parameter's regressor varies with the signal. Confused with a
    drift where the signal is slow, and with effects of the position where it is the position.

    Source: Tóth, Modeling and Identification of Linear Parameter-Varying Systems (Springer 2010).

    Example:
        >>> Scheduling().regressors(at(input=0.5), jnp.zeros(0), jnp.zeros(2))
        Array([0.5], dtype=float64)
    """

    name: ClassVar[str] = "scheduling"
    family: ClassVar[str] = "scheduling"
    ports: ClassVar[tuple[str, ...]] = ("parameter",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (Amplitude("a", "1"),)
    whole: ClassVar[bool] = False

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """φ, which multiplies the parameter."""
        del shape, memory
        return jnp.stack([signals.input])
