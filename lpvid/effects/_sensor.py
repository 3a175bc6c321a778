"""Sensors that are not linear."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from lpvid.effects._law import AbstractShapelessLaw, Amplitude, Signals
from lpvid.effects._smooth import magnitude


class AbsoluteValueSensor(AbstractShapelessLaw):
    """A sensor that cannot tell the sign, y → |y|: adds |y| − y, a = 1 once found.

    Seen as: an output that never crosses zero and bounces off it. Confused with a gain that differs
    by direction (gain asymmetry), a bias.

    Source: Wigren and Schoukens, coupled electric drives, Uppsala TR 2017-024: the pulse counter.

    Example:
        >>> AbsoluteValueSensor().regressors(at(output=-2.0), jnp.zeros(0), jnp.zeros(2))
        Array([4.], dtype=float64)
    """

    name: ClassVar[str] = "absolute-value-sensor"
    family: ClassVar[str] = "sensor"
    ports: ClassVar[tuple[str, ...]] = ("output",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (Amplitude("a", "1", positive=True),)
    whole: ClassVar[bool] = True

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """|y| − y."""
        del shape, memory
        return jnp.stack([magnitude(signals.output) - signals.output])


class CubicSensor(AbstractShapelessLaw):
    """y → y + c y³.

    Seen as: static in the output, odd. Confused with a cubic gain of the input and, where the plant
    is quasi-static, cubic stiffness.

    Source: Ljung, System Identification (Prentice Hall 1999), section 5.2, output nonlinearities.

    Example:
        >>> CubicSensor().regressors(at(output=2.0), jnp.zeros(0), jnp.zeros(2))
        Array([8.], dtype=float64)
    """

    name: ClassVar[str] = "cubic-sensor"
    family: ClassVar[str] = "sensor"
    ports: ClassVar[tuple[str, ...]] = ("output",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (Amplitude("c", "1/{acts_on}^2"),)
    whole: ClassVar[bool] = False

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """y³."""
        del shape, memory
        return jnp.stack([signals.output**3])
