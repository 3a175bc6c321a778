"""A mode of vibration that the model lacks."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.effects._law import AbstractLaw, Amplitude, Scales, Shape, Signals
from lpvid.effects._ranges import inside, span


class MissingMode(AbstractLaw):
    """A mass on a spring attached to the coordinate, τ = m [ω² r + 2ζω ṙ], r = z − q.

    z̈ = −ω² r − 2ζω ṙ. The memory holds r and ż; over a step q̇ + q̈ t is followed exactly, in closed
    form. It starts at rest: r = 0, whatever q.

    Seen as: a pair of resonance and antiresonance, locked to the input. Confused with a periodic
    disturbance (locked to the clock), a lag or delay where ω is high.

    Source: Den Hartog, Mechanical Vibrations (McGraw-Hill 1956), section 3.2, attached oscillator.

    Example:
        >>> memory = jnp.array([0.5, 0.0])
        >>> MissingMode().regressors(at(velocity=1.0), jnp.array([10.0, 0.05]), memory)
        Array([49.], dtype=float64)
    """

    name: ClassVar[str] = "missing-mode"
    family: ClassVar[str] = "mode"
    ports: ClassVar[tuple[str, ...]] = ("force",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (
        Amplitude("m", "{acts_on}·s^2/{position}", positive=True),
    )
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("omega", "rad/s"), Shape("zeta", "1"))
    whole: ClassVar[bool] = False
    memory: ClassVar[int] = 2

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """ω² r + 2ζω ṙ."""
        omega, zeta = shape[0], shape[1]
        rate = memory[1] - signals.velocity
        return jnp.stack([omega**2 * memory[0] + 2.0 * zeta * omega * rate])

    def advance(
        self,
        signals: Signals,
        shape: Float[Array, " shape"],
        memory: Float[Array, " memory"],
        dt: Float[Array, ""],
    ) -> Float[Array, " memory"]:
        """r and ż after dt, exactly for a held acceleration; signals are the step's middle's."""
        omega, zeta = jnp.maximum(shape[0], 1e-6), shape[1]
        damped = omega * jnp.sqrt(jnp.maximum(1.0 - zeta**2, 1e-6))
        decay = jnp.exp(-zeta * omega * dt)
        cosine, sine = decay * jnp.cos(damped * dt), decay * jnp.sin(damped * dt) * omega / damped
        # About the place where the spring carries the acceleration, it swings freely.
        sag = signals.acceleration / omega**2
        velocity = signals.velocity - 0.5 * signals.acceleration * signals.step
        r, rate = memory[0] + sag, memory[1] - velocity
        r_next = r * (cosine + zeta * sine) + rate / omega * sine - sag
        rate_next = rate * (cosine - zeta * sine) - r * omega * sine
        velocity_next = velocity + signals.acceleration * dt
        return memory.at[:2].set(jnp.stack([r_next, rate_next + velocity_next]))

    def grid(self, scales: Scales) -> np.ndarray:
        """Ten frequencies, damped more than most modes so that neighbours are heard too."""
        lower, upper = self.bounds(scales)
        return np.array([(omega, 0.08) for omega in inside(lower[0], upper[0], 10)])

    def bounds(self, scales: Scales) -> tuple[np.ndarray, np.ndarray]:
        """ω from a third of the record's own, velocity over position, to half of Nyquist's; ζ from
        0.002 to 0.5."""
        high = 0.5 * np.pi / scales.dt
        own = scales.velocity.rms / max(scales.position.rms, 1e-300)
        low = min(max(0.3 * own, 6.0 * np.pi / scales.duration), high / 8.0)
        low, high = span(low, high)
        return np.array([low, 0.002]), np.array([high, 0.5])
