"""What an effect may read, where it may act, and what a law of the library has to say."""

import abc
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

if TYPE_CHECKING:
    # Type checkers take equinox's for an instance variable.
    from typing import ClassVar as AbstractClassVar
else:
    from equinox import AbstractClassVar

MEMORY = 2
"""Internal states that a law may have at most."""

HISTORY = 13
"""Samples of the input that a law may read: the present one and twelve before it."""

PORTS = ("input", "force", "output", "parameter")
"""Where an effect may act: on what enters, as a generalised force, on what a sensor says, or on a
parameter of the model."""


class Signals(eqx.Module):
    """What a law reads at its port, at one instant: scalars but for the history.

    At a force port position, velocity and acceleration are the coordinate's, and `load` is the
    force that the model transmits there. At an input port `input` is the commanded signal, at an
    output port `output` is what an ideal sensor would say; at a parameter port `input` is the
    schedule, within ±1. The rest is zero where it has no meaning.

    Attributes:
        position: q of the coordinate.
        velocity: its rate.
        acceleration: its second derivative by the model as it stands.
        load: transmitted force.
        input: u at the port.
        output: y at the port.
        time: s since the record's start.
        history: u at the port, the present sample first (13,).
        sample: time from one sample of the history to the next, s.
        step_start: s from the sample's start to that of the step a law is read along.
        step: length of that step, s.
    """

    position: Float[Array, "*path"]
    velocity: Float[Array, "*path"]
    acceleration: Float[Array, "*path"]
    load: Float[Array, "*path"]
    input: Float[Array, "*path"]
    output: Float[Array, "*path"]
    time: Float[Array, "*path"]
    history: Float[Array, "*path lag"]
    sample: Float[Array, "*path"]
    step_start: Float[Array, "*path"]
    step: Float[Array, "*path"]


class Size(NamedTuple):
    """Size of one signal over a record: its root mean square, its peak, and its noise (std)."""

    rms: float
    peak: float
    noise: float = 0.0


class Scales(NamedTuple):
    """Sizes of what a law reads at its port, from which it takes its grid of shapes."""

    position: Size
    velocity: Size
    acceleration: Size
    load: Size
    input: Size
    output: Size
    dt: float
    duration: float


class Units(NamedTuple):
    """Units at a port, for what is printed: of the signal it acts on and of what the law reads."""

    acts_on: str
    position: str = ""
    time: str = "s"


class Shape(NamedTuple):
    """A number that a law depends on nonlinearly: its name and its unit.

    `unit` may hold `{acts_on}` and `{position}`, filled in with the port's units.
    """

    name: str
    unit: str


class Amplitude(NamedTuple):
    """A number that a law is proportional to: its name, its unit, and whether only one sign is
    physical (a friction level cannot be negative)."""

    name: str
    unit: str
    positive: bool = False


class AbstractLaw(eqx.Module):
    """One effect of the library: amplitudes times regressors of what happens at its port.

    Added to the port's signal is Σ_i a_i g_i(signals; shape), so zero amplitudes recover the model
    exactly. Laws hold no numbers; those of a model's effects are kept beside them. A law is smooth
    in everything it reads, and its internal state is advanced by an exact step, never stiff.

    Attributes:
        name: in the report, lower case, words with hyphens.
        family: as in the report: friction, drag, hysteresis, ….
        ports: the kinds of port it makes sense at, of `PORTS`.
        amplitudes: a_i, one or two.
        shapes: s, none to two.
        whole: the law describes a replaced signal (a delay, a lag): once found, its amplitude is
            1 and only its shape is estimated.
        memory: number of internal states, at most `MEMORY`; zero at a record's start.
        angular: the law reads the position as an angle in rad; it means nothing for a length.
    """

    name: AbstractClassVar[str]
    family: AbstractClassVar[str]
    ports: AbstractClassVar[tuple[str, ...]]
    amplitudes: AbstractClassVar[tuple[Amplitude, ...]]
    shapes: AbstractClassVar[tuple[Shape, ...]]
    whole: AbstractClassVar[bool]
    memory: AbstractClassVar[int]
    angular: ClassVar[bool] = False

    @abc.abstractmethod
    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """g(signals; shape), one for each amplitude.

        Args:
            signals: what happens at the port.
            shape: s, in the order of `shapes`.
            memory: the internal state (`MEMORY`,); zeros beyond the law's own.
        """

    @abc.abstractmethod
    def advance(
        self,
        signals: Signals,
        shape: Float[Array, " shape"],
        memory: Float[Array, " memory"],
        dt: Float[Array, ""],
    ) -> Float[Array, " memory"]:
        """The internal state one step later, the signals held over the step.

        Args:
            signals: what happens at the port.
            shape: s, in the order of `shapes`.
            memory: the internal state (`MEMORY`,).
            dt: the step in s.
        """

    @abc.abstractmethod
    def grid(self, scales: Scales) -> np.ndarray:
        """Shapes to try, (candidate, shape); one row where there is no shape.

        Args:
            scales: sizes of the signals at the port.
        """

    @abc.abstractmethod
    def bounds(self, scales: Scales) -> tuple[np.ndarray, np.ndarray]:
        """Least and greatest shape, (shape,) each.

        Args:
            scales: sizes of the signals at the port.
        """


class AbstractStaticLaw(AbstractLaw):
    """A law without memory: what it adds depends on this instant alone."""

    memory: ClassVar[int] = 0

    def advance(
        self,
        signals: Signals,
        shape: Float[Array, " shape"],
        memory: Float[Array, " memory"],
        dt: Float[Array, ""],
    ) -> Float[Array, " memory"]:
        """Nothing to remember: the memory as it came.

        Args:
            signals: unused.
            shape: unused.
            memory: the internal state (`MEMORY`,).
            dt: unused.
        """
        del signals, shape, dt
        return memory


class AbstractShapelessLaw(AbstractStaticLaw):
    """A law without memory and without shapes: amplitudes times fixed functions.

    A new one takes ten lines.

    Example:
        >>> class QuinticStiffness(AbstractShapelessLaw):
        ...     name = "quintic-stiffness"
        ...     family = "stiffness"
        ...     ports = ("force",)
        ...     amplitudes = (Amplitude("k5", "{acts_on}/{position}^5"),)
        ...     whole = False
        ...
        ...     def regressors(self, signals, shape, memory):
        ...         return jnp.stack([-(signals.position**5)])
        >>> QuinticStiffness().regressors(at(position=2.0), jnp.zeros(0), jnp.zeros(2))
        Array([-32.], dtype=float64)
    """

    shapes: ClassVar[tuple[Shape, ...]] = ()

    def grid(self, scales: Scales) -> np.ndarray:
        """One row without entries (1, 0).

        Args:
            scales: unused.
        """
        del scales
        return np.zeros((1, 0))

    def bounds(self, scales: Scales) -> tuple[np.ndarray, np.ndarray]:
        """Nothing to bound (0,), (0,).

        Args:
            scales: unused.
        """
        del scales
        return np.zeros(0), np.zeros(0)


def at(
    *,
    position: ArrayLike = 0.0,
    velocity: ArrayLike = 0.0,
    acceleration: ArrayLike = 0.0,
    load: ArrayLike = 0.0,
    input: ArrayLike = 0.0,
    output: ArrayLike = 0.0,
    time: ArrayLike = 0.0,
    history: ArrayLike | None = None,
    sample: ArrayLike = 1.0,
    step_start: ArrayLike = 0.0,
    step: ArrayLike | None = None,
) -> Signals:
    """Signals at one instant, zero unless given: to try a law by hand.

    Args:
        position: q of the coordinate.
        velocity: its rate.
        acceleration: its second derivative.
        load: transmitted force.
        input: u at the port.
        output: y at the port.
        time: s.
        history: u at the port, the present sample first (13,); `input` all along by default.
        sample: s between samples.
        step_start: s since the sample's start.
        step: s; the whole sample by default.

    Example:
        >>> at(velocity=2.0).velocity
        Array(2., dtype=float64)
    """
    value = jnp.asarray(input, float)
    past = jnp.full(HISTORY, value) if history is None else jnp.asarray(history, float)
    return Signals(
        position=jnp.asarray(position, float),
        velocity=jnp.asarray(velocity, float),
        acceleration=jnp.asarray(acceleration, float),
        load=jnp.asarray(load, float),
        input=value,
        output=jnp.asarray(output, float),
        time=jnp.asarray(time, float),
        history=past,
        sample=jnp.asarray(sample, float),
        step_start=jnp.asarray(step_start, float),
        step=jnp.asarray(sample if step is None else step, float),
    )
