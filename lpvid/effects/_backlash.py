"""Play in a gear or a coupling, as a spring that is slack about zero."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.effects._law import AbstractStaticLaw, Amplitude, Scales, Shape, Signals
from lpvid.effects._ranges import LEAST, inside, span
from lpvid.effects._smooth import clip


class Backlash(AbstractStaticLaw):
    """A joint's spring with a gap, τ = k [q − dz(q, b)]: takes back k q within ±b.

    With the model's own spring of stiffness K ≥ k what is left is (K − k) q + k dz(q, b); k = K is
    a true gap of 2b.

    Seen as: soft at small displacement, as stiff as ever for amplitudes far above b. Confused with
    odd quadratic stiffness (never recovers), Coulomb friction (follows the velocity, not the
    displacement), play (loses energy).

    Source: Nordin and Gutman, Automatica 38 (2002) 1633–1649, dead-zone model.

    Example:
        >>> Backlash().regressors(at(position=3.0), jnp.array([1.0]), jnp.zeros(2)).round(3)
        Array([1.], dtype=float64)
    """

    name: ClassVar[str] = "backlash"
    family: ClassVar[str] = "backlash"
    ports: ClassVar[tuple[str, ...]] = ("force",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (
        Amplitude("k", "{acts_on}/{position}", positive=True),
    )
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("b", "{position}"),)
    whole: ClassVar[bool] = False

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """q − dz(q, b), which is q clipped to ±b."""
        del memory
        return jnp.stack([clip(signals.position, shape[0])])

    def grid(self, scales: Scales) -> np.ndarray:
        """Four half gaps b."""
        lower, upper = self.bounds(scales)
        return inside(lower[0], upper[0], 4)[:, None]

    def bounds(self, scales: Scales) -> tuple[np.ndarray, np.ndarray]:
        """From the position's noise, or 0.03 of its rms, to 0.95 of its peak."""
        q = scales.position
        low = min(max(q.noise, 0.03 * q.rms, LEAST), 0.2 * max(q.peak, 5.0 * LEAST))
        low, high = span(low, 0.95 * q.peak)
        return np.array([low]), np.array([high])
