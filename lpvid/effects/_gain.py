"""Actuators whose gain depends on the command."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from lpvid.effects._law import AbstractShapelessLaw, Amplitude, Signals
from lpvid.effects._smooth import magnitude


class CubicGain(AbstractShapelessLaw):
    """u → u + c u³.

    Seen as: static in u, odd, third harmonics at the input. Confused with saturation (only at large
    |u|).

    Source: Ljung, System Identification (Prentice Hall 1999), section 5.2, input nonlinearities.

    Example:
        >>> CubicGain().regressors(at(input=2.0), jnp.zeros(0), jnp.zeros(2))
        Array([8.], dtype=float64)
    """

    name: ClassVar[str] = "gain-cubic"
    family: ClassVar[str] = "gain"
    ports: ClassVar[tuple[str, ...]] = ("input",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (Amplitude("c", "1/{acts_on}^2"),)
    whole: ClassVar[bool] = False

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """u³."""
        del shape, memory
        return jnp.stack([signals.input**3])


class GainAsymmetry(AbstractShapelessLaw):
    """A gain that differs with the sign of the command, u → u + c |u|.

    Seen as: static in u, even. Confused with a bias and asymmetric viscous friction.

    Source: Ljung, System Identification (Prentice Hall 1999), section 5.2, input nonlinearities.

    Example:
        >>> GainAsymmetry().regressors(at(input=-2.0), jnp.zeros(0), jnp.zeros(2))
        Array([2.], dtype=float64)
    """

    name: ClassVar[str] = "gain-asymmetry"
    family: ClassVar[str] = "gain"
    ports: ClassVar[tuple[str, ...]] = ("input",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (Amplitude("c", "1"),)
    whole: ClassVar[bool] = False

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """|u|."""
        del shape, memory
        return jnp.stack([magnitude(signals.input)])


class SquareGain(AbstractShapelessLaw):
    """An actuator that answers the square of its command, as a propeller does, u → u + c u |u|.

    Seen as: static in u, odd; where u keeps its sign it is u². Confused with a cubic gain, and with
    a gain and a bias while u moves little.

    Source: Leishman, Principles of Helicopter Aerodynamics (Cambridge 2006), thrust ∝ speed².

    Example:
        >>> SquareGain().regressors(at(input=-2.0), jnp.zeros(0), jnp.zeros(2))
        Array([-4.], dtype=float64)
    """

    name: ClassVar[str] = "gain-square"
    family: ClassVar[str] = "gain"
    ports: ClassVar[tuple[str, ...]] = ("input",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (Amplitude("c", "1/{acts_on}"),)
    whole: ClassVar[bool] = False

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """u |u|."""
        del shape, memory
        return jnp.stack([signals.input * magnitude(signals.input)])
