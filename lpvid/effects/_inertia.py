"""Inertia that depends on the position, and what comes with it."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from lpvid.effects._law import AbstractShapelessLaw, Amplitude, Signals


class PositionInertia(AbstractShapelessLaw):
    """Inertia m1 cos q + m2 sin q: τ = −m1 (cos q q̈ − ½ sin q q̇²) − m2 (sin q q̈ + ½ cos q q̇²).

    What Lagrange's equation makes of ½ M(q) q̇², so that no energy comes from nowhere. It reads the
    model's acceleration as it stands.

    Seen as: acceleration × position. Confused with gravity (there at rest), scheduling over the
    position.

    Source: Spong, Hutchinson and Vidyasagar, Robot Modeling and Control (Wiley 2006), section 7.3.

    Example:
        >>> signals = at(position=0.5 * np.pi, velocity=2.0, acceleration=3.0)
        >>> PositionInertia().regressors(signals, jnp.zeros(0), jnp.zeros(2)).round(9)
        Array([ 2., -3.], dtype=float64)
    """

    name: ClassVar[str] = "position-dependent-inertia"
    family: ClassVar[str] = "inertia"
    ports: ClassVar[tuple[str, ...]] = ("force",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (
        Amplitude("m1", "{acts_on}·s^2/{position}"),
        Amplitude("m2", "{acts_on}·s^2/{position}"),
    )
    whole: ClassVar[bool] = False
    angular: ClassVar[bool] = True

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """−cos q q̈ + ½ sin q q̇², −sin q q̈ − ½ cos q q̇²."""
        del shape, memory
        sine, cosine = jnp.sin(signals.position), jnp.cos(signals.position)
        half = 0.5 * signals.velocity**2
        return -jnp.stack(
            [
                cosine * signals.acceleration - half * sine,
                sine * signals.acceleration + half * cosine,
            ]
        )


class Centrifugal(AbstractShapelessLaw):
    """What a turning link throws back, τ = −c q̇² sin q.

    Seen as: velocity² × position, nothing at rest. Confused with position-dependent inertia (more
    where it accelerates), quadratic drag, asymmetric viscous friction.

    Source: Spong, Hutchinson and Vidyasagar, Robot Modeling and Control (Wiley 2006), section 7.3.

    Example:
        >>> signals = at(position=0.5 * np.pi, velocity=2.0)
        >>> Centrifugal().regressors(signals, jnp.zeros(0), jnp.zeros(2))
        Array([-4.], dtype=float64)
    """

    name: ClassVar[str] = "centrifugal"
    family: ClassVar[str] = "inertia"
    ports: ClassVar[tuple[str, ...]] = ("force",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (Amplitude("c", "{acts_on}·s^2/{position}^2"),)
    whole: ClassVar[bool] = False
    angular: ClassVar[bool] = True

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """−q̇² sin q."""
        del shape, memory
        return jnp.stack([-(signals.velocity**2) * jnp.sin(signals.position)])
