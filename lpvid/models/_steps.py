"""Models one sample at a time: the predictor, whose state every measured output corrects."""

import abc
import inspect
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lpvid.models._gray_box_lpv import GrayBoxLPV
from lpvid.models._lpv import LPVStateSpace
from lpvid.models._simulate import simulate_time_varying
from lpvid.models._state_space import StateSpace


class AbstractSteps(eqx.Module):
    """A model along one record's input (and schedule): x⁺ = f(x, t), y = h(x, t)."""

    @property
    @abc.abstractmethod
    def signals(self) -> Any:
        """What differs from sample to sample: arrays (time, …) in any pytree."""

    @abc.abstractmethod
    def step(self, x: Array, now: Any) -> tuple[Array, Array]:
        """State one sample later, and the output; `now` is one sample of the signals."""

    @abc.abstractmethod
    def predict(
        self, y: Float[Array, "time ny"], gain: Float[Array, "nx ny"], x0: Float[Array, " nx"]
    ) -> tuple[Float[Array, "time ny"], Float[Array, "time nx"]]:
        """One-step predictions ŷ, and the states x̂ that they come from.

        x̂⁺ = f(x̂, t) + K (y − ŷ), ŷ = h(x̂, t).

        Args:
            y: measured output.
            gain: K.
            x0: first state.
        """

    def simulate(self, x0: Float[Array, " nx"]) -> Float[Array, "time ny"]:
        """Output without corrections."""
        # A method of a module that holds tracers cannot be hashed; a function can.
        return jax.lax.scan(lambda x, now: self.step(x, now), x0, self.signals)[1]


class MatrixSteps(AbstractSteps):
    """Matrices of every sample.

    Attributes:
        system: in discrete time, its batch axis the time.
        u: input.
    """

    system: StateSpace
    u: Float[Array, "time nu"]

    @property
    def signals(self) -> Any:
        """Matrices and input."""
        return self.system, self.u

    def step(self, x: Array, now: Any) -> tuple[Array, Array]:
        """One product."""
        system, u = now
        return system.A @ x + system.B @ u, system.C @ x + system.D @ u

    def predict(
        self, y: Float[Array, "time ny"], gain: Float[Array, "nx ny"], x0: Float[Array, " nx"]
    ) -> tuple[Float[Array, "time ny"], Float[Array, "time nx"]]:
        """The recursion of the states alone is a loop."""
        system, both = one_step_predictor(self.system, gain), jnp.concatenate([self.u, y], axis=1)
        time, nx = self.u.shape[0], x0.shape[0]
        whole = jnp.broadcast_to(jnp.eye(nx), (time, nx, nx))
        none = jnp.zeros((time, nx, both.shape[1]))
        states = simulate_time_varying(system.A, system.B, whole, none, u=both, x0=x0)
        predicted = jnp.einsum("tyx,tx->ty", self.system.C, states)
        return predicted + jnp.einsum("tyu,tu->ty", self.system.D, self.u), states


class ModuleSteps(AbstractSteps):
    """A module with `step(x, u, dt=)`, and `kappa=` where it takes one.

    Attributes:
        model: the module.
        u: input.
        kappa: scheduling, None where the module takes none.
        dt: sample time, s.
    """

    model: Any
    u: Float[Array, "time nu"]
    kappa: Float[Array, "time nk"] | None
    dt: Float[Array, ""]

    @property
    def signals(self) -> Any:
        """Input and scheduling."""
        return self.u, self.kappa

    def step(self, x: Array, now: Any) -> tuple[Array, Array]:
        """The module's."""
        u, kappa = now
        options = {} if kappa is None else {"kappa": kappa}
        return self.model.step(x, u, dt=self.dt, **options)

    def predict(
        self, y: Float[Array, "time ny"], gain: Float[Array, "nx ny"], x0: Float[Array, " nx"]
    ) -> tuple[Float[Array, "time ny"], Float[Array, "time nx"]]:
        """A loop over all samples."""

        def one(x, each):
            now, measured = each
            following, predicted = self.step(x, now)
            return following + gain @ (measured - predicted), (predicted, x)

        return jax.lax.scan(one, x0, (self.signals, y))[1]


def steps_of(
    model: Any, *, u: Float[Array, "time nu"], kappa: Array | None = None, dt: float | None = None
) -> AbstractSteps:
    """A model along an input and a schedule, one sample at a time.

    Args:
        model: `LPVStateSpace`, `GrayBoxLPV`, `NonlinearModel`, or any module with
            `step(x, u, dt=)` → (state one sample later, output now), and `kappa=` where it takes
            one.
        u: input.
        kappa: schedule (time, nk), or (time,) for one scheduling variable.
        dt: sample time, s; of a discrete-time LPV model its own.

    Returns:
        Something with `step`, `simulate` and `predict`.

    Raises:
        ValueError: the model has no `step`, or schedule or sample time are missing.

    Example:
        >>> from lpvid.models import NonlinearModel, steps_of
        >>> lag = NonlinearModel(
        ...     {"rate": 2.0}, lambda p, x, u: u - p["rate"] * x, lambda p, x, u: x, rest=[0.0]
        ... )
        >>> along = steps_of(lag, u=jnp.ones((3, 1)), dt=0.1)
        >>> y, states = along.predict(jnp.zeros((3, 1)), jnp.eye(1), jnp.zeros(1))
        >>> y[:, 0].round(4).tolist()
        [0.0, 0.0906, 0.0742]
    """
    if isinstance(model, LPVStateSpace | GrayBoxLPV):
        if kappa is None:
            raise ValueError("kappa: an LPV model needs the scheduling, one value for each sample.")
        frozen = model.at(kappa)
        if not frozen.is_discrete:
            frozen = frozen.discretise(_known(dt))
        return MatrixSteps(frozen, u)
    if not can_step(model):
        raise ValueError(
            f"model: {type(model).__name__} has no step(x, u, dt=) -> (state one sample later, "
            "output now), so its state cannot be corrected sample by sample. Give it one, or "
            "describe it by its dynamics in a NonlinearModel."
        )
    taken = kappa if takes_schedule(model.step) else None
    return ModuleSteps(model, u, taken, jnp.asarray(_known(dt), float))


def can_step(model: Any) -> bool:
    """Whether a model has `step(x, u, dt=)`.

    Example:
        >>> from lpvid.models import StateSpace, can_step
        >>> can_step(StateSpace([[0.5]], [[1.0]], [[1.0]], dt=0.1))
        False
    """
    step = getattr(model, "step", None)
    return callable(step) and "dt" in inspect.signature(step).parameters


def takes_schedule(method: Any) -> bool:
    """Whether a model's `simulate` or `step` can use κ.

    Example:
        >>> from lpvid.models import LPVStateSpace, StateSpace, takes_schedule
        >>> takes_schedule(LPVStateSpace.simulate), takes_schedule(StateSpace.simulate)
        (True, False)
    """
    return "kappa" in inspect.signature(method).parameters


def one_step_predictor(model: StateSpace, gain: Float[Array, "nx ny"]) -> StateSpace:
    """The predictor x̂⁺ = A x̂ + B u + K (y − ŷ), ŷ = C x̂ + D u, with inputs (u, y).

    A − K C, [B − K D, K], C, [D, 0].

    Args:
        model: in discrete time; leading axes are a batch.
        gain: K.

    Example:
        >>> from lpvid.models import StateSpace, one_step_predictor
        >>> one_step_predictor(StateSpace([[0.9]], [[1.0]], [[1.0]], dt=0.1), jnp.ones((1, 1))).B
        Array([[1., 1.]], dtype=float64)
    """
    each = jnp.broadcast_to(gain, (*model.batch_shape, *gain.shape))
    none = jnp.zeros((*model.batch_shape, model.ny, model.ny))
    return StateSpace(
        model.A - each @ model.C,
        jnp.concatenate([model.B - each @ model.D, each], axis=-1),
        model.C,
        jnp.concatenate([model.D, none], axis=-1),
        dt=model.dt,
    )


def _known(dt: float | None) -> float:
    if dt is None:
        raise ValueError("dt: the model is in continuous time; give the sample time of u.")
    return dt
