"""Friction: dry, at low speed, one-sided, under load, before sliding."""

from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.effects._hysteron import dahl_step
from lpvid.effects._law import (
    AbstractLaw,
    AbstractShapelessLaw,
    AbstractStaticLaw,
    Amplitude,
    Scales,
    Shape,
    Signals,
)
from lpvid.effects._ranges import inside, sign_width, span, travel
from lpvid.effects._smooth import LEAST_WIDTH, magnitude, sign

_WIDTH = Shape("vs", "{position}/s")


class Coulomb(AbstractStaticLaw):
    """Dry friction, τ = −Fc sg(v), sg(v) = tanh(v/vs).

    Seen as: odd in the velocity, a step where it changes sign; the equivalent damping falls as
    1/amplitude. Confused with viscous friction and quadratic drag (two amplitudes tell them apart),
    with Stribeck friction, with backlash.

    Source: Armstrong-Hélouvry, Dupont and Canudas de Wit, Automatica 30 (1994) 1083–1138.

    Example:
        >>> Coulomb().regressors(at(velocity=2.0), jnp.array([0.01]), jnp.zeros(2))
        Array([-1.], dtype=float64)
    """

    name: ClassVar[str] = "coulomb"
    family: ClassVar[str] = "friction"
    ports: ClassVar[tuple[str, ...]] = ("force",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (Amplitude("Fc", "{acts_on}", positive=True),)
    shapes: ClassVar[tuple[Shape, ...]] = (_WIDTH,)
    whole: ClassVar[bool] = False

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """−sg(v)."""
        del memory
        return jnp.stack([-sign(signals.velocity, shape[0])])

    def grid(self, scales: Scales) -> np.ndarray:
        """Three widths vs."""
        return inside(*sign_width(scales), 3)[:, None]

    def bounds(self, scales: Scales) -> tuple[np.ndarray, np.ndarray]:
        """From the velocity's noise to half of its root mean square."""
        low, high = sign_width(scales)
        return np.array([low]), np.array([high])


class Stribeck(AbstractStaticLaw):
    """What dry friction has more of at low speed, τ = −Fs sg(v) e^{−(v/vst)²}, Fs the excess.

    Seen as: odd, at low speed only; stick-slip. Confused with Coulomb friction of a wrong vs: both
    widths are fitted.

    Source: Armstrong-Hélouvry, Dupont and Canudas de Wit, Automatica 30 (1994) 1083–1138, eq. (7).

    Example:
        >>> Stribeck().regressors(at(velocity=0.1), jnp.array([0.001, 0.1]), jnp.zeros(2))
        Array([-0.36787944], dtype=float64)
    """

    name: ClassVar[str] = "stribeck"
    family: ClassVar[str] = "friction"
    ports: ClassVar[tuple[str, ...]] = ("force",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (Amplitude("Fs", "{acts_on}", positive=True),)
    shapes: ClassVar[tuple[Shape, ...]] = (_WIDTH, Shape("vst", "{position}/s"))
    whole: ClassVar[bool] = False

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """−sg(v) e^{−(v/vst)²}."""
        del memory
        v = signals.velocity
        share = jnp.exp(-((v / jnp.maximum(shape[1], LEAST_WIDTH)) ** 2))
        return jnp.stack([-sign(v, shape[0]) * share])

    def grid(self, scales: Scales) -> np.ndarray:
        """Four speeds vst, the sign's width small beside each."""
        low, high = sign_width(scales)
        speeds = inside(2.0 * low, 2.0 * high, 4)
        return np.stack([np.maximum(1.2 * low, 0.1 * speeds), speeds], axis=1)

    def bounds(self, scales: Scales) -> tuple[np.ndarray, np.ndarray]:
        """vs as for Coulomb friction; vst from twice its least to the velocity's rms."""
        low, high = sign_width(scales)
        return np.array([low, 2.0 * low]), np.array([high, 2.0 * high])


class AsymmetricViscous(AbstractShapelessLaw):
    """Viscous friction that depends on the direction, τ = −c |v|.

    Seen as: even in the velocity. With viscous friction F, F + c one way and F − c the other.
    Confused with a bias, a gain asymmetry, asymmetric Coulomb friction: vary the speed at
    constant torque.

    Source: Janot, Gautier and Brunot, EMPS benchmark (2019), friction that differs by direction.

    Example:
        >>> AsymmetricViscous().regressors(at(velocity=-2.0), jnp.zeros(0), jnp.zeros(2))
        Array([-2.], dtype=float64)
    """

    name: ClassVar[str] = "asymmetric-viscous"
    family: ClassVar[str] = "friction"
    ports: ClassVar[tuple[str, ...]] = ("force",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (Amplitude("c", "{acts_on}·s/{position}"),)
    whole: ClassVar[bool] = False

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """−|v|."""
        del shape, memory
        return jnp.stack([-magnitude(signals.velocity)])


class AsymmetricCoulomb(AbstractStaticLaw):
    """Dry friction that depends on the direction, τ = −F sg(v)².

    Seen as: even in the velocity, a constant while it moves, zero at rest. With Coulomb friction
    Fc, Fc + F one way and Fc − F the other. Confused with a bias (which is there at rest) and with
    asymmetric viscous friction.

    Source: Armstrong-Hélouvry, Dupont and Canudas de Wit, Automatica 30 (1994) 1083–1138.

    Example:
        >>> AsymmetricCoulomb().regressors(at(velocity=-2.0), jnp.array([0.01]), jnp.zeros(2))
        Array([-1.], dtype=float64)
    """

    name: ClassVar[str] = "asymmetric-coulomb"
    family: ClassVar[str] = "friction"
    ports: ClassVar[tuple[str, ...]] = ("force",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (Amplitude("Fa", "{acts_on}"),)
    shapes: ClassVar[tuple[Shape, ...]] = (_WIDTH,)
    whole: ClassVar[bool] = False

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """−sg(v)²."""
        del memory
        return jnp.stack([-(sign(signals.velocity, shape[0]) ** 2)])

    def grid(self, scales: Scales) -> np.ndarray:
        """Two widths vs."""
        return inside(*sign_width(scales), 2)[:, None]

    def bounds(self, scales: Scales) -> tuple[np.ndarray, np.ndarray]:
        """From the velocity's noise to half of its root mean square."""
        low, high = sign_width(scales)
        return np.array([low]), np.array([high])


class LoadDependentFriction(AbstractStaticLaw):
    """Dry friction in proportion to the transmitted force, τ = −μ |τ_load| sg(v).

    Seen as: a step at v = 0 whose height follows the load. Confused with Coulomb friction: change
    the payload.

    Source: Hamon, Gautier, Garrec and Janot, IROS (2010), load-dependent joint friction.

    Example:
        >>> law = LoadDependentFriction()
        >>> law.regressors(at(velocity=2.0, load=-3.0), jnp.array([0.01]), jnp.zeros(2))
        Array([-3.], dtype=float64)
    """

    name: ClassVar[str] = "load-dependent"
    family: ClassVar[str] = "friction"
    ports: ClassVar[tuple[str, ...]] = ("force",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (Amplitude("mu", "1", positive=True),)
    shapes: ClassVar[tuple[Shape, ...]] = (_WIDTH,)
    whole: ClassVar[bool] = False

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """−|τ| sg(v)."""
        del memory
        return jnp.stack([-magnitude(signals.load) * sign(signals.velocity, shape[0])])

    def grid(self, scales: Scales) -> np.ndarray:
        """Two widths vs."""
        return inside(*sign_width(scales), 2)[:, None]

    def bounds(self, scales: Scales) -> tuple[np.ndarray, np.ndarray]:
        """From the velocity's noise to half of its root mean square."""
        low, high = sign_width(scales)
        return np.array([low]), np.array([high])


class Dahl(AbstractLaw):
    """Dry friction that first yields elastically, τ = −Fc z, ż = (v − |v| z)/ℓ.

    The presliding length ℓ is small beside the travel; initial stiffness Fc/ℓ. Held v gives
    z⁺ = sgn v + (z − sgn v) e^{−|v| h/ℓ} exactly. LuGre friction adds bristle damping, which this
    one lacks.

    Seen as: stiffness at tiny motion, Coulomb friction at large. Confused with Coulomb friction
    (make small reversals) and with Bouc–Wen hysteresis, whose ℓ is as long as the motion.

    Source: Dahl, Aerospace Corp. TOR-0158 (1968); Canudas de Wit, Olsson, Åström and Lischinsky,
    IEEE Trans. Automatic Control 40 (1995) 419–425.

    Example:
        >>> Dahl().regressors(at(), jnp.array([0.01]), jnp.array([0.5, 0.0]))
        Array([-0.5], dtype=float64)
    """

    name: ClassVar[str] = "dahl"
    family: ClassVar[str] = "friction"
    ports: ClassVar[tuple[str, ...]] = ("force",)
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (Amplitude("Fc", "{acts_on}", positive=True),)
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("length", "{position}"),)
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
        return memory.at[0].set(dahl_step(memory[0], signals.velocity * dt, shape[0]))

    def grid(self, scales: Scales) -> np.ndarray:
        """Three lengths ℓ."""
        lower, upper = self.bounds(scales)
        return inside(lower[0], upper[0], 3)[:, None]

    def bounds(self, scales: Scales) -> tuple[np.ndarray, np.ndarray]:
        """From the position's noise, or a tenth of a sample's motion, to 0.3 of its rms."""
        high = travel(scales)
        step = 0.1 * scales.velocity.rms * scales.dt
        low = min(max(scales.position.noise, step, 0.003 * high), 0.25 * high)
        low, high = span(low, high)
        return np.array([low]), np.array([high])
