"""Springs that are not linear."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from lpvid.effects._law import AbstractShapelessLaw, Amplitude, Signals
from lpvid.effects._smooth import magnitude


class CubicStiffness(AbstractShapelessLaw):
    """Duffing's spring, τ = −k3 q³; hardens for k3 > 0.

    Seen as: resonance shifted in proportion to amplitude², third harmonics. Confused with backlash
    and saturation, which level off at large amplitude.

    Source: Duffing, Erzwungene Schwingungen bei veränderlicher Eigenfrequenz (Vieweg 1918).

    Example:
        >>> CubicStiffness().regressors(at(position=2.0), jnp.zeros(0), jnp.zeros(2))
        Array([-8.], dtype=float64)
    """

    name: ClassVar[str] = "cubic-stiffness"
    family: ClassVar[str] = "stiffness"
    ports: ClassVar[tuple[str, ...]] = ("force",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (Amplitude("k3", "{acts_on}/{position}^3"),)
    whole: ClassVar[bool] = False

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """−q³."""
        del shape, memory
        return jnp.stack([-(signals.position**3)])


class QuadraticStiffness(AbstractShapelessLaw):
    """A spring harder one way than the other, τ = −k2 q².

    Seen as: even in the position, second harmonics, a mean that moves with the amplitude. Confused
    with a bias, gravity about an angle that is not upright.

    Source: Nayfeh and Mook, Nonlinear Oscillations (Wiley 1979), section 2.2.

    Example:
        >>> QuadraticStiffness().regressors(at(position=-2.0), jnp.zeros(0), jnp.zeros(2))
        Array([-4.], dtype=float64)
    """

    name: ClassVar[str] = "quadratic-stiffness"
    family: ClassVar[str] = "stiffness"
    ports: ClassVar[tuple[str, ...]] = ("force",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (Amplitude("k2", "{acts_on}/{position}^2"),)
    whole: ClassVar[bool] = False

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """−q²."""
        del shape, memory
        return jnp.stack([-(signals.position**2)])


class OddQuadraticStiffness(AbstractShapelessLaw):
    """A spring that hardens alike both ways from the start, τ = −k2 q |q|.

    Seen as: resonance shifted in proportion to the amplitude. Confused with cubic stiffness (∝
    amplitude²), backlash.

    Source: Nayfeh and Mook, Nonlinear Oscillations (Wiley 1979), section 2.2.

    Example:
        >>> OddQuadraticStiffness().regressors(at(position=-2.0), jnp.zeros(0), jnp.zeros(2))
        Array([4.], dtype=float64)
    """

    name: ClassVar[str] = "odd-quadratic-stiffness"
    family: ClassVar[str] = "stiffness"
    ports: ClassVar[tuple[str, ...]] = ("force",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (Amplitude("k2", "{acts_on}/{position}^2"),)
    whole: ClassVar[bool] = False

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """−q |q|."""
        del shape, memory
        return jnp.stack([-signals.position * magnitude(signals.position)])
