"""Structures: functions from a parameter vector to state-space matrices."""

import abc
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, PRNGKeyArray

from lpvid.models._state_space import StateSpace

Parameters = Float[Array, " parameter"]
Starts = Float[Array, "start parameter"]


class AbstractStructure(eqx.Module):
    """A map ϑ → (A, B, C, D) in continuous time, with names, bounds and an optional start rule.

    A concrete structure defines `parameter_names` and `matrices`. The other methods have
    defaults: no bounds, no start rule, and no second parameterisation to search in.

    Source: 001, equations 1, 6 and 32.
    """

    @property
    @abc.abstractmethod
    def parameter_names(self) -> tuple[str, ...]:
        """One name for each entry of ϑ."""

    @abc.abstractmethod
    def matrices(self, parameters: Parameters) -> StateSpace:
        """The model at `parameters` (one value for each name)."""

    @property
    def n_parameters(self) -> int:
        """Length of ϑ."""
        return len(self.parameter_names)

    def bounds(self) -> tuple[Parameters, Parameters]:
        """Lower and upper bounds; infinite unless a structure says otherwise."""
        infinite = jnp.full((self.n_parameters,), jnp.inf)
        return -infinite, infinite

    def starts(self, key: PRNGKeyArray, count: int, black_box: StateSpace) -> Starts:
        """`count` starting points for a search, the first one the best guess.

        Args:
            key: random key.
            count: how many.
            black_box: continuous-time model that the structure is to match.

        Returns:
            Starting points (count, n_parameters) of `search_structure()`'s parameters, or of this
            structure's where that is None.

        Raises:
            ValueError: the structure has no start rule.
        """
        del key, count, black_box
        raise ValueError(
            f"{type(self).__name__} has no start rule: give `initial=` (one or several "
            "starting vectors) to restructure."
        )

    def closed_form(self, black_box: StateSpace) -> Parameters:
        """ϑ from a black box in closed form, exact where the structure holds the black box.

        Args:
            black_box: continuous-time model of the structure's order.

        Raises:
            ValueError: the structure has no closed form.
        """
        del black_box
        raise ValueError(
            f"{type(self).__name__} has no closed form: leave ClosedFormStart() out, and take "
            "SimilarityStarts() instead."
        )

    def search_structure(self) -> "AbstractStructure | None":
        """A better-behaved parameterisation to search in first (None: search in this one)."""
        return None

    def align(self, parameters: Parameters, neighbour: Parameters) -> Parameters:
        """The same model, listed as a neighbouring point's: for interchangeable parts (modes)."""
        del neighbour
        return parameters

    def from_search(self, parameters: Float[Array, " searched"]) -> Parameters:
        """Carry the parameters found in `search_structure()` over to this structure."""
        return parameters


class FreeStructure(AbstractStructure):
    """Every entry of A, B, C (and D) is a parameter, row by row: a black box as a structure.

    Attributes:
        n_states: order.
        n_inputs: number of inputs.
        n_outputs: number of outputs.
        feedthrough: whether D is free; zero otherwise.

    Example:
        >>> FreeStructure(n_states=1, n_inputs=1, n_outputs=1).parameter_names
        ('A[0,0]', 'B[0,0]', 'C[0,0]', 'D[0,0]')
    """

    n_states: int = eqx.field(static=True)
    n_inputs: int = eqx.field(static=True)
    n_outputs: int = eqx.field(static=True)
    feedthrough: bool = eqx.field(static=True, default=True)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names such as `A[0,1]`."""
        return tuple(
            f"{name}[{row},{column}]"
            for name, (rows, columns) in zip("ABCD", self._shapes(), strict=False)
            for row in range(rows)
            for column in range(columns)
        )

    def _shapes(self) -> list[tuple[int, int]]:
        nx, nu, ny = self.n_states, self.n_inputs, self.n_outputs
        return [(nx, nx), (nx, nu), (ny, nx)] + ([(ny, nu)] if self.feedthrough else [])

    def matrices(self, parameters: Parameters) -> StateSpace:
        """The model whose entries are `parameters`."""
        blocks, offset = [], 0
        for rows, columns in self._shapes():
            blocks.append(parameters[offset : offset + rows * columns].reshape(rows, columns))
            offset += rows * columns
        return StateSpace(*blocks)

    def parameters_of(self, model: StateSpace) -> Parameters:
        """The entries of a model of the same size, in the order of `parameter_names`.

        Raises:
            ValueError: the model is of another size, or in discrete time.
        """
        given, wanted = (
            (model.nx, model.nu, model.ny),
            (self.n_states, self.n_inputs, self.n_outputs),
        )
        if given != wanted or model.is_discrete:
            raise ValueError(
                f"model: a continuous-time model with (states, inputs, outputs) = {wanted} is "
                f"needed, got {given} and dt={model.dt}."
            )
        blocks = (model.A, model.B, model.C, model.D)[: len(self._shapes())]
        return jnp.concatenate([block.reshape(-1) for block in blocks])

    def starts(self, key: PRNGKeyArray, count: int, black_box: StateSpace) -> Starts:
        """The black box itself, `count` times: nothing has to be searched."""
        del key
        return jnp.tile(self.parameters_of(black_box)[None], (count, 1))


class FunctionStructure(AbstractStructure):
    """A structure from a user's own function ϑ → (A, B, C) or (A, B, C, D).

    Attributes:
        function: takes ϑ (a vector) and returns three or four matrices (JAX arrays).
        nominal: a rough guess of ϑ; starts are scattered about it.
        names: one for each parameter; `parameter 1`, … by default.
        lower: lower bounds (one number or one for each parameter), minus infinity by default.
        upper: upper bounds, infinity by default.
        spread: standard deviation of the starts' logarithms: signs stay, and so does a zero.

    Raises:
        ValueError: lengths disagree, or a bound excludes `nominal`.

    Example:
        >>> pendulum = FunctionStructure(
        ...     lambda p: (jnp.array([[0.0, 1.0], [-p[0], -p[1]]]), jnp.eye(2)[:, 1:], jnp.eye(2)),
        ...     nominal=[9.81, 0.1],
        ...     names=("stiffness", "damping"),
        ... )
        >>> pendulum.matrices(pendulum.nominal).A[1].tolist()
        [-9.81, -0.1]
    """

    function: Callable[[Parameters], Sequence[Array]] = eqx.field(static=True)
    nominal: Parameters
    names: tuple[str, ...] = eqx.field(static=True)
    lower: Parameters
    upper: Parameters
    spread: float = eqx.field(static=True)

    def __init__(self, function, *, nominal, names=None, lower=None, upper=None, spread=0.5):
        self.function = function
        self.nominal = jnp.atleast_1d(jnp.asarray(nominal, float))
        if self.nominal.ndim != 1:
            raise ValueError(f"nominal: a vector is needed, got shape {self.nominal.shape}.")
        count = self.nominal.shape[0]
        self.names = tuple(names) if names else tuple(f"parameter {i + 1}" for i in range(count))
        if len(self.names) != count:
            raise ValueError(f"names: {len(self.names)} given for {count} parameters in nominal.")
        self.lower = _bound("lower", lower, -jnp.inf, count)
        self.upper = _bound("upper", upper, jnp.inf, count)
        inside = (self.lower <= self.nominal) & (self.nominal <= self.upper)
        if not isinstance(inside, Tracer) and not np.all(inside):
            raise ValueError("nominal: lies outside the bounds; move it or widen lower and upper.")
        self.spread = float(spread)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """The names given."""
        return self.names

    def matrices(self, parameters: Parameters) -> StateSpace:
        """The model that `function` returns."""
        A, B, C, *direct = self.function(parameters)
        return StateSpace(A, B, C, direct[0] if direct else None)

    def bounds(self) -> tuple[Parameters, Parameters]:
        """The bounds given."""
        return self.lower, self.upper

    def starts(self, key: PRNGKeyArray, count: int, black_box: StateSpace) -> Starts:
        """The nominal vector, then log-normal scatter about it, kept within the bounds."""
        del black_box
        scatter = jnp.exp(self.spread * jax.random.normal(key, (count, self.n_parameters)))
        return jnp.clip(
            self.nominal[None] * scatter.at[0].set(1.0), self.lower[None], self.upper[None]
        )


def _bound(name: str, value, default: float, count: int) -> Parameters:
    bound = jnp.asarray(default if value is None else value, float)
    if bound.ndim > 1 or (bound.ndim == 1 and bound.shape[0] != count):
        raise ValueError(f"{name}: shape {bound.shape} given for {count} parameters in nominal.")
    return jnp.broadcast_to(bound, (count,))
