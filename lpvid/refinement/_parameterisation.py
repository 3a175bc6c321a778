"""Models as functions of a parameter vector: one interface for all kinds that can be refined."""

import abc
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from lpvid.data import IOData
from lpvid.models import AbstractStructure, StateSpace, StructuredModel, one_step_predictor

# Over 1024 samples: an integrator, or two, may stay in a predictor without a gain.
_GROWTH = 4.0

Values = Float[Array, " value"]


class Record(eqx.Module):
    """One record, or several padded to one length along a leading axis.

    Attributes:
        u: input.
        y: output.
        kappa: scheduling, or None.
        place: which of the data's records it is (or a piece of).
    """

    u: Float[Array, "*record time nu"]
    y: Float[Array, "*record time ny"]
    kappa: Float[Array, "*record time nk"] | None
    place: Int[Array, "*record"]


class AbstractParameterisation(eqx.Module):
    """A kind of model by its values: names, bounds, and how a record's output follows.

    `prepare` does what all records share, `respond` what is each record's own; both are
    differentiated in forward mode.
    """

    @property
    @abc.abstractmethod
    def names(self) -> tuple[str, ...]:
        """One for each value."""

    @property
    @abc.abstractmethod
    def n_states(self) -> int:
        """Length of a record's initial state."""

    @abc.abstractmethod
    def bounds(self) -> tuple[Values, Values]:
        """Lower and upper bounds of the values."""

    @abc.abstractmethod
    def prepare(self, values: Values) -> Any:
        """What is common to all records: arrays in any pytree."""

    @abc.abstractmethod
    def respond(self, prepared: Any, record: Record, x0: Array) -> Float[Array, "time ny"]:
        """Predicted output of one record."""

    @abc.abstractmethod
    def forgets(self, prepared: Any) -> Bool[Array, ""]:
        """Whether predictions do not hold on to the first state: no search leaves such models.

        With the first state free, a predictor pole outside the unit circle makes the likelihood
        look better than it is. True where it cannot be told cheaply.
        """

    @property
    @abc.abstractmethod
    def overlap(self) -> int:
        """Samples of the next piece that `shoot` simulates to meet it."""

    @abc.abstractmethod
    def shoot(
        self, prepared: Any, record: Record, x0: Array, size: int
    ) -> tuple[Float[Array, "time ny"], Float[Array, " row"], Float[Array, " row"]]:
        """Output of a piece, and the rows by which it meets the piece before it and the next.

        Args:
            prepared: what all records share.
            record: the piece, and `overlap` samples of the next one.
            x0: its first state.
            size: samples of the piece.
        """

    @abc.abstractmethod
    def build(self, values: Values) -> Any:
        """The model, of the kind that was given."""

    @abc.abstractmethod
    def gauge(self, values: Values) -> Float[Array, "value direction"] | None:
        """Directions of the values that no output shows, in the values over `scale`."""

    @abc.abstractmethod
    def innovation_gain(self, values: Values) -> Float[Array, "nx ny"] | None:
        """K, or None where it is not estimated."""

    @property
    @abc.abstractmethod
    def scale(self) -> Values:
        """Sizes of the values: in these units the gauge is orthogonal to what is estimated."""


class LinearParameterisation(AbstractParameterisation):
    """A linear time-invariant model: a structure's parameters, then the entries of K.

    Attributes:
        structure: ϑ → matrices.
        dt: sample time of the records.
        discrete: whether the matrices are in discrete time already.
        black_box: whether ϑ are the matrices' entries, in any basis of the state.
        gain: whether K is estimated: (nx, ny) values after ϑ.
        sizes: nx, nu, ny.
        units: sizes of the values.
    """

    structure: AbstractStructure
    dt: float = eqx.field(static=True)
    discrete: bool = eqx.field(static=True)
    black_box: bool = eqx.field(static=True)
    gain: bool = eqx.field(static=True)
    sizes: tuple[int, int, int] = eqx.field(static=True)
    units: Values

    @property
    def names(self) -> tuple[str, ...]:
        """The structure's names, then `K[i,j]`."""
        nx, _, ny = self.sizes
        return (*self.structure.parameter_names, *(gain_names(nx, ny) if self.gain else ()))

    @property
    def n_states(self) -> int:
        """Order of the model."""
        return self.sizes[0]

    @property
    def scale(self) -> Values:
        """Sizes of the values."""
        return self.units

    def bounds(self) -> tuple[Values, Values]:
        """The structure's bounds; K is free."""
        infinite = jnp.full((len(self.names) - self.structure.n_parameters,), jnp.inf)
        lower, upper = self.structure.bounds()
        return jnp.concatenate([lower, -infinite]), jnp.concatenate([upper, infinite])

    def matrices(self, values: Values) -> StateSpace:
        """The discrete-time model."""
        model = self.structure.matrices(values[: self.structure.n_parameters])
        return model if self.discrete else model.discretise(self.dt)

    def innovation_gain(self, values: Values) -> Float[Array, "nx ny"] | None:
        """K, or None where it is not estimated."""
        nx, _, ny = self.sizes
        if not self.gain:
            return None
        return values[self.structure.n_parameters :].reshape(nx, ny)

    def prepare(self, values: Values) -> StateSpace:
        """The predictor: A − K C, [B − K D, K], C, [D, 0] where K is estimated."""
        model = self.matrices(values)
        gain = self.innovation_gain(values)
        return model if gain is None else one_step_predictor(model, gain)

    def respond(self, prepared: StateSpace, record: Record, x0: Array) -> Float[Array, "time ny"]:
        """Blocked simulation of the predictor."""
        u = jnp.concatenate([record.u, record.y], axis=1) if self.gain else record.u
        predictor = StateSpace(prepared.A, prepared.B, prepared.C, prepared.D, dt=1.0)
        return predictor.simulate(u=u, x0=x0)

    def forgets(self, prepared: StateSpace) -> Bool[Array, ""]:
        """Whether (A − K C)^2048 has not grown beyond (A − K C)^1024: poles within 1.001."""
        if not self.gain:
            return jnp.asarray(True)
        power = prepared.A
        for _ in range(10):
            power = power @ power
        sooner, later = (jnp.linalg.norm(each) for each in (power, power @ power))
        return jnp.isfinite(later) & (later <= _GROWTH * sooner)

    @property
    def overlap(self) -> int:
        """None: pieces meet in their states."""
        return 0

    def shoot(
        self, prepared: StateSpace, record: Record, x0: Array, size: int
    ) -> tuple[Float[Array, "time ny"], Float[Array, " nx"], Float[Array, " nx"]]:
        """Simulated output, first state, and the state after the last sample."""
        del size
        system = StateSpace(prepared.A, prepared.B, prepared.C, prepared.D, dt=1.0)
        states = system.simulate_states(u=record.u, x0=x0)
        y = states @ system.C.T + record.u @ system.D.T
        return y, x0, system.A @ states[-1] + system.B @ record.u[-1]

    def build(self, values: Values) -> StateSpace | StructuredModel:
        """A `StateSpace` in the time it was given in, or a `StructuredModel`."""
        parameters = values[: self.structure.n_parameters]
        if not self.black_box:
            return StructuredModel(self.structure, parameters)
        model = self.structure.matrices(parameters)
        dt = self.dt if self.discrete else 0.0
        return StateSpace(model.A, model.B, model.C, model.D, dt=dt)

    def gauge(self, values: Values) -> Float[Array, "value direction"] | None:
        """Changes of the state's basis: (Z A − A Z, Z B, −C Z, 0, Z K) for every unit matrix Z."""
        if not self.black_box:
            return None
        nx = self.n_states
        model = self.structure.matrices(values[: self.structure.n_parameters])
        units = jnp.eye(nx * nx).reshape(nx * nx, nx, nx)
        blocks = [
            units @ model.A[None] - model.A[None] @ units,
            units @ model.B[None],
            -model.C[None] @ units,
        ]
        if self.structure.n_parameters > nx * nx + model.B.size + model.C.size:
            blocks.append(jnp.zeros((nx * nx, *model.D.shape)))
        gain = self.innovation_gain(values)
        if gain is not None:
            blocks.append(units @ gain[None])
        columns = jnp.concatenate([block.reshape(nx * nx, -1) for block in blocks], axis=1).T
        return columns / self.units[:, None]


def gain_names(nx: int, ny: int) -> tuple[str, ...]:
    """`K[i,j]` for every entry of K."""
    return tuple(f"K[{i},{j}]" for i in range(nx) for j in range(ny))


def free_units(
    A: Array, u: Array, y: Array, *, feedthrough: bool, gain: bool
) -> Float[Array, " value"]:
    """Sizes of a black box's entries from the channels' sizes and A's."""
    u_size, y_size = channel_sizes(u), channel_sizes(y)
    nx, nu, ny = A.shape[0], u_size.shape[0], y_size.shape[0]
    rate = jnp.sqrt(jnp.mean(A**2))
    rate = jnp.where(rate > 0.0, rate, 1.0)
    blocks = [
        jnp.broadcast_to(rate, (nx, nx)),
        jnp.broadcast_to(rate / u_size[None, :], (nx, nu)),
        jnp.broadcast_to(y_size[:, None], (ny, nx)),
    ]
    if feedthrough:
        blocks.append(y_size[:, None] / u_size[None, :])
    if gain:
        blocks.append(jnp.broadcast_to(1.0 / y_size[None, :], (nx, ny)))
    return jnp.concatenate([block.reshape(-1) for block in blocks])


def channel_sizes(signal: Float[Array, "time channel"]) -> Float[Array, " channel"]:
    """Root mean square of every channel, one for a channel that is zero."""
    power = jnp.mean(signal**2, axis=0)
    return jnp.sqrt(jnp.where(power > 0.0, power, 1.0))


def padded_records(data: IOData) -> tuple[Record, Array]:
    """All records along a leading axis, padded to the longest, and where they count.

    Signals are padded with zeros, the schedule with its last value: it may rest.
    """
    longest = max(data.lengths)
    starts = np.cumsum([0, *data.lengths])

    def stack(signal: Array, mode: str = "constant") -> Array:
        if len(set(data.lengths)) == 1:
            return signal.reshape(len(data.lengths), longest, signal.shape[1])
        parts = [
            jnp.pad(signal[start : start + length], ((0, longest - length), (0, 0)), mode=mode)
            for start, length in zip(starts, data.lengths, strict=False)
        ]
        return jnp.stack(parts)

    mask = np.arange(longest)[None, :] < np.asarray(data.lengths)[:, None]
    kappa = None if data.kappa is None else stack(data.kappa, "edge")
    places = jnp.arange(len(data.lengths))
    return Record(stack(data.u), stack(data.y), kappa, places), jnp.asarray(mask)
