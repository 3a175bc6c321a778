"""Drag of a fluid."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from lpvid.effects._law import AbstractShapelessLaw, Amplitude, Signals
from lpvid.effects._smooth import magnitude


class QuadraticDrag(AbstractShapelessLaw):
    """Drag of turbulent flow, τ = −c v |v|.

    Seen as: odd in the velocity, damping that grows with the speed. Confused with Stribeck friction
    and a wrong viscous friction: go fast.

    Source: Rayleigh, Phil. Mag. 2 (1876) 430–441; as in Morison's equation.

    Example:
        >>> QuadraticDrag().regressors(at(velocity=-2.0), jnp.zeros(0), jnp.zeros(2))
        Array([4.], dtype=float64)
    """

    name: ClassVar[str] = "quadratic-drag"
    family: ClassVar[str] = "drag"
    ports: ClassVar[tuple[str, ...]] = ("force",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (
        Amplitude("c", "{acts_on}·s^2/{position}^2", positive=True),
    )
    whole: ClassVar[bool] = False

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """−v |v|."""
        del shape, memory
        return jnp.stack([-signals.velocity * magnitude(signals.velocity)])
