"""LPV and nonlinear models: any module that simulates, its arrays the parameters."""

import inspect
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.models import GrayBoxLPV, LPVStateSpace
from lpvid.refinement._parameterisation import AbstractParameterisation, Record, Values

# The one leaf of an LPV model that is estimated.
_ESTIMATED = {LPVStateSpace: "coefficients", GrayBoxLPV: "parameters"}


class ModuleParameterisation(AbstractParameterisation):
    """A module with `simulate(u=, dt=, x0=)`: its inexact arrays are the values, leaf by leaf.

    Of an `LPVStateSpace` the coefficients alone are, of a `GrayBoxLPV` its parameters.

    Attributes:
        model: the module, at any values.
        dt: sample time of the records.
        states: length of the initial state; 0 where the module names none.
        schedules: "still" where κ is known to be constant within every record of an LPV model,
            which is then frozen; "mixed" where it is in some; "moving" otherwise.
    """

    model: Any
    dt: float = eqx.field(static=True)
    states: int = eqx.field(static=True)
    schedules: str = eqx.field(static=True, default="moving")

    def _leaves(self) -> list[tuple[str, Array, int]]:
        """Name, array and place (among all leaves) of what is estimated."""
        paths = jax.tree_util.tree_leaves_with_path(self.model)
        only = _ESTIMATED.get(type(self.model))
        found = []
        for place, (path, leaf) in enumerate(paths):
            name = jax.tree_util.keystr(path).lstrip(".")
            if eqx.is_inexact_array(leaf) and only in (None, name):
                found.append((name, leaf, place))
        return found

    @property
    def names(self) -> tuple[str, ...]:
        """A leaf's path, with indices for arrays: `mass`, `coefficients[0,2]`; or its own names."""
        if isinstance(self.model, GrayBoxLPV):
            return self.model.parameter_names
        return tuple(
            name + (f"[{','.join(map(str, index))}]" if index else "")
            for name, leaf, _ in self._leaves()
            for index in np.ndindex(leaf.shape)
        )

    @property
    def n_states(self) -> int:
        """Length of the initial state."""
        return self.states

    @property
    def scale(self) -> Values:
        """Ones: there is no gauge."""
        return jnp.ones(len(self.names))

    def start(self) -> Values:
        """The values of the module itself."""
        return jnp.concatenate([leaf.astype(float).reshape(-1) for _, leaf, _ in self._leaves()])

    def bounds(self) -> tuple[Values, Values]:
        """None."""
        infinite = jnp.full((len(self.names),), jnp.inf)
        return -infinite, infinite

    def gauge(self, values: Values) -> None:
        """None is known."""
        del values

    def innovation_gain(self, values: Values) -> None:
        """None: the output error alone."""
        del values

    def build(self, values: Values) -> Any:
        """The module with other values."""
        replaced: dict[int, Any] = {}
        offset = 0
        for _, leaf, place in self._leaves():
            part = values[offset : offset + leaf.size]
            replaced[place] = part.reshape(leaf.shape).astype(leaf.dtype)
            offset += leaf.size
        kept = enumerate(jax.tree.leaves(self.model))
        leaves = [replaced.get(place, leaf) for place, leaf in kept]
        return jax.tree.unflatten(jax.tree.structure(self.model), leaves)

    def prepare(self, values: Values) -> Float[Array, " value"]:
        """The values: each record builds its module from them."""
        return values

    def respond(
        self, prepared: Float[Array, " value"], record: Record, x0: Array
    ) -> Float[Array, "time ny"]:
        """Simulation by the module, frozen where κ rests: one matrix exponential for the record."""
        model = self.build(prepared)
        if type(self.model) not in _ESTIMATED:
            options: dict[str, Any] = {"x0": x0} if self.states else {}
            if takes_schedule(self.model) and record.kappa is not None:
                options["kappa"] = record.kappa
            return model.simulate(u=record.u, dt=self.dt, **options)
        kappa = record.kappa
        assert kappa is not None

        def moving():
            return model.simulate(u=record.u, kappa=kappa, dt=self.dt, x0=x0)

        def still():
            frozen = model.at(kappa[0])
            frozen = frozen if frozen.is_discrete else frozen.discretise(self.dt)
            return frozen.simulate(u=record.u, x0=x0)

        if self.schedules == "still":
            return still()
        if self.schedules == "moving":
            return moving()
        return jax.lax.cond(jnp.all(kappa == kappa[:1]), still, moving)

    @property
    def overlap(self) -> int:
        """Twice the order: states are met through the outputs that follow from them."""
        return 2 * self.states

    def shoot(
        self, prepared: Float[Array, " value"], record: Record, x0: Array, size: int
    ) -> tuple[Float[Array, "time ny"], Float[Array, " row"], Float[Array, " row"]]:
        """Simulated output, and its first and its overlapping samples."""
        y = self.respond(prepared, record, x0)
        return y[:size], y[: self.overlap].reshape(-1), y[size:].reshape(-1)


def takes_schedule(model: Any) -> bool:
    """Whether a module's `simulate` can use κ."""
    return "kappa" in inspect.signature(model.simulate).parameters


def needs_schedule(model: Any) -> bool:
    """Whether it cannot do without."""
    parameter = inspect.signature(model.simulate).parameters.get("kappa")
    return parameter is not None and parameter.default is inspect.Parameter.empty
