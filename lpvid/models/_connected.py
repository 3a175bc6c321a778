"""Structures made of structures: connected, discretised, fixed or read in discrete time."""

import abc

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from lpvid.models._hold import AbstractConversion
from lpvid.models._state_space import StateSpace
from lpvid.models._structures import AbstractStructure, Parameters


class FixedStructure(AbstractStructure):
    """A model without parameters: an LTI part of a connection.

    Attributes:
        model: always this one.

    Example:
        >>> from lpvid.models import StateSpace
        >>> FixedStructure(StateSpace([[-1.0]], [[1.0]], [[1.0]])).n_parameters
        0
    """

    model: StateSpace

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """None."""
        return ()

    def matrices(self, parameters: Parameters) -> StateSpace:
        """The model."""
        del parameters
        return self.model


class SampledStructure(AbstractStructure):
    """A continuous-time structure, its model discretised.

    Attributes:
        structure: in continuous time.
        method: how.
        dt: sample time, s.

    Example:
        >>> from lpvid.models import FreeStructure, ZeroOrderHold
        >>> sampled = SampledStructure(FreeStructure(1, 1, 1), ZeroOrderHold(), 0.1)
        >>> sampled.matrices(jnp.array([-1.0, 1.0, 1.0, 0.0])).A.round(3).item()
        0.905
    """

    structure: AbstractStructure
    method: AbstractConversion
    dt: float = eqx.field(static=True)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Those of the structure."""
        return self.structure.parameter_names

    def matrices(self, parameters: Parameters) -> StateSpace:
        """The discretised model."""
        return self.structure.matrices(parameters).discretise(self.dt, self.method)

    def bounds(self) -> tuple[Parameters, Parameters]:
        """Those of the structure."""
        return self.structure.bounds()


class DiscreteTimeStructure(AbstractStructure):
    """A structure whose matrices are those of a discrete-time model.

    Attributes:
        structure: ϑ → (A, B, C, D).
        dt: sample time, s.

    Example:
        >>> from lpvid.models import FreeStructure
        >>> structure = DiscreteTimeStructure(FreeStructure(1, 1, 1), 0.1)
        >>> structure.matrices(jnp.array([0.5, 1.0, 1.0, 0.0])).dt
        0.1
    """

    structure: AbstractStructure
    dt: float = eqx.field(static=True)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Those of the structure."""
        return self.structure.parameter_names

    def matrices(self, parameters: Parameters) -> StateSpace:
        """The structure's matrices, with the sample time."""
        model = self.structure.matrices(parameters)
        return StateSpace(model.A, model.B, model.C, model.D, self.dt)

    def bounds(self) -> tuple[Parameters, Parameters]:
        """Those of the structure."""
        return self.structure.bounds()


class AbstractConnection(eqx.Module):
    """How two models are made one."""

    @abc.abstractmethod
    def connect(self, first: StateSpace, second: StateSpace) -> StateSpace:
        """The connected model; states of both."""


class Series(AbstractConnection):
    """The second model driven by the first.

    Example:
        >>> from lpvid.models import StateSpace
        >>> lag = StateSpace([[-1.0]], [[1.0]], [[3.0]])
        >>> Series().connect(lag, lag).dc_gain().item()
        9.0
    """

    def connect(self, first: StateSpace, second: StateSpace) -> StateSpace:
        """`second @ first`."""
        return second @ first


class Parallel(AbstractConnection):
    """One input, the outputs added or subtracted.

    Attributes:
        sign: of the second model's output.

    Raises:
        ValueError: the sign is neither −1 nor 1.

    Example:
        >>> from lpvid.models import StateSpace
        >>> lag = StateSpace([[-1.0]], [[1.0]], [[3.0]])
        >>> Parallel().connect(lag, lag).dc_gain().item()
        6.0
    """

    sign: int = eqx.field(static=True, default=1)

    def __check_init__(self):
        _check_sign(self.sign)

    def connect(self, first: StateSpace, second: StateSpace) -> StateSpace:
        """`first + second` or `first - second`."""
        return first + second if self.sign > 0 else first - second


def _check_sign(sign: int) -> None:
    if sign not in (-1, 1):
        raise ValueError(f"sign: -1 or 1 is needed, got {sign}.")


class Feedback(AbstractConnection):
    """The first model's output returns through the second, its sign times, to its input.

    Attributes:
        sign: −1 for negative feedback.

    Raises:
        ValueError: the sign is neither −1 nor 1.

    Example:
        >>> from lpvid.models import StateSpace
        >>> lag = StateSpace([[-1.0]], [[1.0]], [[3.0]])
        >>> Feedback(sign=1).connect(lag, StateSpace([[-6.0]], [[1.0]], [[1.0]])).dc_gain().item()
        6.0
    """

    sign: int = eqx.field(static=True, default=-1)

    def __check_init__(self):
        _check_sign(self.sign)

    def connect(self, first: StateSpace, second: StateSpace) -> StateSpace:
        """The closed loop from the first model's input to its output.

        Raises:
            ValueError: channels or sample times do not fit, or the feedthroughs close an algebraic
                loop without solution (not checked under `jit`, where the result is not finite).
        """
        first._check_partner(second, "connect")
        if (first.nu, first.ny) != (second.ny, second.nu):
            raise ValueError(
                f"Cannot close the loop: {first.ny} outputs and {first.nu} inputs forward need "
                f"{first.ny} inputs and {first.nu} outputs back, got {second.nu} and {second.ny}."
            )
        if first.batch_shape != second.batch_shape:
            raise ValueError(
                f"Cannot close the loop of models with batch axes {first.batch_shape} and "
                f"{second.batch_shape}; use jax.vmap."
            )
        sign = float(self.sign)
        around = first.D @ second.D
        loop = jnp.broadcast_to(jnp.eye(first.ny), around.shape) - sign * around
        if not isinstance(loop, Tracer) and np.any(np.linalg.cond(np.asarray(loop)) > 1e12):
            raise ValueError(
                "Cannot close the loop: I - sign D1 D2 of the feedthroughs is singular, so the "
                "loop has no solution. Add a delay, or take the feedthrough out of one model."
            )
        right = jnp.concatenate([first.C, sign * (first.D @ second.C), first.D], axis=-1)
        solved = jnp.linalg.solve(loop, right)
        nx = first.nx + second.nx
        C, D = solved[..., :nx], solved[..., nx:]
        # e = r + sign (C2 x2 + D2 y) enters the first model, y the second.
        returned = sign * (second.D @ C)
        returned = returned.at[..., first.nx :].add(sign * second.C)
        entering = sign * (second.D @ D)
        entering = jnp.broadcast_to(jnp.eye(first.nu), entering.shape) + entering
        A = jnp.concatenate([first.B @ returned, second.B @ C], axis=-2)
        A = A.at[..., : first.nx, : first.nx].add(first.A)
        A = A.at[..., first.nx :, first.nx :].add(second.A)
        B = jnp.concatenate([first.B @ entering, second.B @ D], axis=-2)
        return StateSpace(A, B, C, D, first.dt)


class ConnectedStructure(AbstractStructure):
    """Two structures connected; the parameters of the first, then those of the second.

    Attributes:
        connection: how.
        first: ϑ₁ → first model.
        second: ϑ₂ → second model.

    Example:
        >>> from lpvid.models import FreeStructure
        >>> both = ConnectedStructure(Series(), FreeStructure(1, 1, 1), FreeStructure(1, 1, 1))
        >>> both.parameter_names[0], both.n_parameters
        ('first A[0,0]', 8)
    """

    connection: AbstractConnection
    first: AbstractStructure
    second: AbstractStructure

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Both structures' names, told apart by `first` and `second` where both have some."""
        names = self.first.parameter_names, self.second.parameter_names
        if not all(names):
            return names[0] + names[1]
        return tuple(
            f"{which} {name}"
            for which, each in zip(("first", "second"), names, strict=True)
            for name in each
        )

    def matrices(self, parameters: Parameters) -> StateSpace:
        """The connected model; its states are the first's, then the second's."""
        count = self.first.n_parameters
        return self.connection.connect(
            self.first.matrices(parameters[:count]), self.second.matrices(parameters[count:])
        )

    def bounds(self) -> tuple[Parameters, Parameters]:
        """Those of both."""
        pairs = zip(self.first.bounds(), self.second.bounds(), strict=True)
        lower, upper = (jnp.concatenate(pair) for pair in pairs)
        return lower, upper
