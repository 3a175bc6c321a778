"""Forces that depend on the way that a displacement took, not on its speed."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.effects._hysteron import bouc_wen_step, play_step
from lpvid.effects._law import AbstractLaw, Amplitude, Scales, Shape, Signals
from lpvid.effects._ranges import LEAST, inside, span, travel


class BoucWen(AbstractLaw):
    """Hysteresis of a joint, τ = −α z, ż = [v − |z| (ρ |v| sgn z + (1 − ρ) v)]/ℓ, |z| ≤ 1.

    ℓ is as long as the motion, ρ = β/(β + γ) between ½ (unloads along a straight line) and 1
    (Dahl's). Exponent 1, with an exact step.

    Seen as: a loop whose area per cycle does not depend on the frequency. Confused with viscous
    damping (change the frequency), Coulomb and Dahl friction (whose ℓ is short), cubic stiffness.

    Source: Wen, J. Engineering Mechanics 102 (1976) 249–263; Ismail, Ikhouane and Rodellar,
    Arch. Comput. Methods Eng. 16 (2009) 161–188.

    Example:
        >>> BoucWen().regressors(at(), jnp.array([0.1, 0.5]), jnp.array([0.25, 0.0]))
        Array([-0.25], dtype=float64)
    """

    name: ClassVar[str] = "bouc-wen"
    family: ClassVar[str] = "hysteresis"
    ports: ClassVar[tuple[str, ...]] = ("force",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (Amplitude("alpha", "{acts_on}", positive=True),)
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("length", "{position}"), Shape("ratio", "1"))
    whole: ClassVar[bool] = False
    memory: ClassVar[int] = 1

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """−z."""
        del signals, shape
        return -memory[:1]

    def advance(
        self,
        signals: Signals,
        shape: Float[Array, " shape"],
        memory: Float[Array, " memory"],
        dt: Float[Array, ""],
    ) -> Float[Array, " memory"]:
        """z one step later, exactly for a held velocity."""
        way = signals.velocity * dt
        return memory.at[0].set(bouc_wen_step(memory[0], way, shape[0], shape[1]))

    def grid(self, scales: Scales) -> np.ndarray:
        """Two lengths ℓ by two ratios ρ."""
        lower, upper = self.bounds(scales)
        lengths = inside(lower[0], upper[0], 2)
        return np.array([(length, ratio) for length in lengths for ratio in (0.55, 0.95)])

    def bounds(self, scales: Scales) -> tuple[np.ndarray, np.ndarray]:
        """ℓ from where Dahl's ends, 0.3 of the position's rms, to ten times that; ρ from ½ to 1."""
        length = travel(scales)
        return np.array([length, 0.5]), np.array([10.0 * length, 1.0])


class Play(AbstractLaw):
    """A spring in series with a slider, τ = −k (q − p), p the play operator of half width r.

    Elastic within ±r, slips beyond at the force k r (Jenkins, Prandtl, Masing): a loop with sharp
    corners that keeps its shape at any frequency.

    Seen as: stiffness at small motion, constant loss per cycle beyond. Confused with Bouc–Wen
    hysteresis (rounded corners), Dahl and Coulomb friction, backlash (no loss).

    Source: Visintin, Differential Models of Hysteresis (Springer 1994), chapter III; Al-Bender,
    Lampaert and Swevers, IEEE Trans. Automatic Control 50 (2005) 1883–1887.

    Example:
        >>> Play().regressors(at(position=3.0), jnp.array([1.0]), jnp.zeros(2))
        Array([-1.], dtype=float64)
    """

    name: ClassVar[str] = "play"
    family: ClassVar[str] = "hysteresis"
    ports: ClassVar[tuple[str, ...]] = ("force",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (
        Amplitude("k", "{acts_on}/{position}", positive=True),
    )
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("radius", "{position}"),)
    whole: ClassVar[bool] = False
    memory: ClassVar[int] = 1

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """−(q − p), p brought to where q has pushed it by now."""
        p = play_step(memory[0], signals.position, shape[0])
        return jnp.stack([p - signals.position])

    def advance(
        self,
        signals: Signals,
        shape: Float[Array, " shape"],
        memory: Float[Array, " memory"],
        dt: Float[Array, ""],
    ) -> Float[Array, " memory"]:
        """p where q has pushed it."""
        del dt
        return memory.at[0].set(play_step(memory[0], signals.position, shape[0]))

    def grid(self, scales: Scales) -> np.ndarray:
        """Three radii r."""
        lower, upper = self.bounds(scales)
        return inside(lower[0], upper[0], 3)[:, None]

    def bounds(self, scales: Scales) -> tuple[np.ndarray, np.ndarray]:
        """From the position's noise, or 0.05 of its rms, to 0.8 of its peak."""
        q = scales.position
        low = min(max(q.noise, 0.05 * q.rms, LEAST), 0.2 * max(q.peak, 5.0 * LEAST))
        low, high = span(low, 0.8 * q.peak)
        return np.array([low]), np.array([high])
