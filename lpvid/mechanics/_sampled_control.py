"""Controllers that a computer runs: they see sampled outputs and hold their command."""

import abc
from typing import Any, TypeAlias

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

ControllerState: TypeAlias = Any


def _floats(value: ArrayLike) -> Array:
    return jnp.asarray(value, float)


class SampledController(eqx.Module):
    """A discrete-time controller: a pytree with an initial state and one step.

    The simulator calls `step` once a sample, with what the sensors read at that sample; the command
    acts until the next one. Any state that is a pytree of arrays will do.

    Example:
        >>> class Integrator(SampledController):
        ...     gain: float
        ...     def initial(self):
        ...         return jnp.zeros(1)
        ...     def step(self, state, reference, y):
        ...         state = state + self.gain * (reference - y[:1])
        ...         return state, state
        >>> Integrator(0.5).step(jnp.zeros(1), jnp.ones(1), jnp.zeros(4))[1]
        Array([0.5], dtype=float64)
    """

    @abc.abstractmethod
    def initial(self) -> ControllerState:
        """State before the first sample."""

    @abc.abstractmethod
    def step(
        self,
        state: ControllerState,
        reference: Float[Array, " nr"],
        y: Float[Array, " ny"],
    ) -> tuple[ControllerState, Float[Array, " nu"]]:
        """Next state, and the command for this sample.

        Args:
            state: from the last step.
            reference: at this sample.
            y: outputs as the computer reads them at this sample.
        """


class OpenLoop(SampledController):
    """No control: the reference is the command.

    Example:
        >>> OpenLoop().step(None, jnp.ones(1), jnp.zeros(4))
        (None, Array([1.], dtype=float64))
    """

    def initial(self) -> ControllerState:
        """Nothing to remember."""
        return None

    def step(
        self, state: ControllerState, reference: Float[Array, " nr"], y: Float[Array, " ny"]
    ) -> tuple[ControllerState, Float[Array, " nu"]]:
        """The reference."""
        del y
        return state, reference


class BoundedPosition(SampledController):
    """Drives to and fro: the reference is the command's size, its sign turns at the bounds.

    Positive at the start; reversed at the first sample whose first output is beyond a bound.

    Attributes:
        bound: of the first output, V (002: 3 V, 35°).

    Source: 002, section 2.4.2.

    Example:
        >>> BoundedPosition(3.0).step(jnp.ones(()), jnp.array([2.0]), jnp.array([3.1]))[1]
        Array([-2.], dtype=float64)
    """

    bound: Float[Array, ""] = eqx.field(converter=_floats)

    def initial(self) -> ControllerState:
        """Positive."""
        return jnp.ones(())

    def step(
        self, state: ControllerState, reference: Float[Array, " nr"], y: Float[Array, " ny"]
    ) -> tuple[ControllerState, Float[Array, " nu"]]:
        """The reference with the sign that leads back."""
        sign = jnp.where(y[0] > self.bound, -1.0, jnp.where(y[0] < -self.bound, 1.0, state))
        return sign, sign * reference


class ProportionalDerivative(SampledController):
    """u = kp (R − y1) − kd y4, plus Coulomb compensation c sign(u).

    y1 is the first output (hub angle), y4 the last one (tachometer).

    Attributes:
        proportional: kp, V/V.
        derivative: kd, V/V.
        compensation: c, V, zero for none (002: 0.7 to 1.0, 0.8 V for 0.4 A).

    Source: 002, section 2.4.3.

    Example:
        >>> pd = ProportionalDerivative(1.0, 2.8, compensation=0.8)
        >>> pd.step(None, jnp.array([3.0]), jnp.zeros(4))[1]
        Array([3.8], dtype=float64)
    """

    proportional: Float[Array, ""] = eqx.field(converter=_floats)
    derivative: Float[Array, ""] = eqx.field(converter=_floats)
    compensation: Float[Array, ""] = eqx.field(converter=_floats, default=0.0)

    def initial(self) -> ControllerState:
        """Nothing to remember."""
        return None

    def step(
        self, state: ControllerState, reference: Float[Array, " nr"], y: Float[Array, " ny"]
    ) -> tuple[ControllerState, Float[Array, " nu"]]:
        """Control effort and compensation."""
        effort = self.proportional * (reference - y[:1]) - self.derivative * y[-1:]
        return state, effort + self.compensation * jnp.sign(effort)
