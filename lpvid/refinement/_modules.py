"""LPV and nonlinear models: any module that simulates or steps, its arrays the parameters."""

import inspect
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from lpvid.models import (
    GrayBoxLPV,
    LPVStateSpace,
    NonlinearModel,
    can_step,
    one_step_predictor,
    steps_of,
    takes_schedule,
)
from lpvid.refinement._parameterisation import (
    AbstractParameterisation,
    Record,
    Values,
    gain_names,
)

_LPV = (LPVStateSpace, GrayBoxLPV)
# The one part of a model that is estimated; of other modules all is.
_ESTIMATED = {LPVStateSpace: "coefficients", GrayBoxLPV: "parameters", NonlinearModel: "plant"}


class ModuleParameterisation(AbstractParameterisation):
    """A module: its inexact arrays are the values, leaf by leaf; then the entries of K.

    Of an `LPVStateSpace` the coefficients alone are, of a `GrayBoxLPV` its parameters, of a
    `NonlinearModel` what its plant holds. Without K
    the module's `simulate(u=, dt=, x0=)` gives the output, or where it has none its
    `step(x, u, dt=)`; with K its step.

    Attributes:
        model: the module, at any values.
        dt: sample time of the records.
        states: length of the initial state; 0 where the module names none.
        schedules: "still" where κ is known to be constant within every record of an LPV model,
            which is then frozen; "mixed" where it is in some; "moving" otherwise.
        outputs: of the records where K is estimated, 0 where it is not.
    """

    model: Any
    dt: float = eqx.field(static=True)
    states: int = eqx.field(static=True)
    schedules: str = eqx.field(static=True, default="moving")
    outputs: int = eqx.field(static=True, default=0)

    def _leaves(self) -> list[tuple[str, Array, int]]:
        """Name, array and place (among all leaves) of what is estimated."""
        paths = jax.tree_util.tree_leaves_with_path(self.model)
        only = next(
            (part for kind, part in _ESTIMATED.items() if isinstance(self.model, kind)), None
        )
        found = []
        for place, (path, leaf) in enumerate(paths):
            name = jax.tree_util.keystr(path).lstrip(".")
            part = jax.tree_util.keystr(path[:1]).lstrip(".")
            if eqx.is_inexact_array(leaf) and only in (None, part):
                found.append((name, leaf, place))
        return found

    @property
    def _own_names(self) -> tuple[str, ...]:
        if isinstance(self.model, GrayBoxLPV):
            return self.model.parameter_names
        return tuple(
            name + (f"[{','.join(map(str, index))}]" if index else "")
            for name, leaf, _ in self._leaves()
            for index in np.ndindex(leaf.shape)
        )

    @property
    def names(self) -> tuple[str, ...]:
        """A leaf's path, with indices for arrays: `mass`, `coefficients[0,2]`; or its own names.

        Then `K[i,j]`.
        """
        return (*self._own_names, *gain_names(self.states, self.outputs))

    @property
    def n_states(self) -> int:
        """Length of the initial state."""
        return self.states

    @property
    def scale(self) -> Values:
        """Ones: there is no gauge."""
        return jnp.ones(len(self.names))

    def start(self) -> Values:
        """The values of the module itself, without K."""
        return jnp.concatenate([leaf.astype(float).reshape(-1) for _, leaf, _ in self._leaves()])

    def bounds(self) -> tuple[Values, Values]:
        """None."""
        infinite = jnp.full((len(self.names),), jnp.inf)
        return -infinite, infinite

    def gauge(self, values: Values) -> None:
        """None is known."""
        del values

    def innovation_gain(self, values: Values) -> Float[Array, "nx ny"] | None:
        """K, or None where it is not estimated."""
        if not self.outputs:
            return None
        return values[-self.states * self.outputs :].reshape(self.states, self.outputs)

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
        """Simulation or prediction, frozen where κ rests: one matrix exponential for the record."""
        model, gain = self.build(prepared), self.innovation_gain(prepared)
        if type(self.model) in _LPV:
            return self._along_schedule(model, gain, record, x0)
        if gain is not None or not simulates(self.model):
            along = steps_of(model, u=record.u, kappa=record.kappa, dt=self.dt)
            return along.simulate(x0) if gain is None else along.predict(record.y, gain, x0)[0]
        options: dict[str, Any] = {"x0": x0} if self.states else {}
        if takes_schedule(self.model.simulate) and record.kappa is not None:
            options["kappa"] = record.kappa
        return model.simulate(u=record.u, dt=self.dt, **options)

    def _along_schedule(
        self, model: Any, gain: Array | None, record: Record, x0: Array
    ) -> Float[Array, "time ny"]:
        kappa = record.kappa
        assert kappa is not None

        def moving():
            if gain is None:
                return model.simulate(u=record.u, kappa=kappa, dt=self.dt, x0=x0)
            along = steps_of(model, u=record.u, kappa=kappa, dt=self.dt)
            return along.predict(record.y, gain, x0)[0]

        def still():
            frozen = model.at(kappa[0])
            frozen = frozen if frozen.is_discrete else frozen.discretise(self.dt)
            if gain is None:
                return frozen.simulate(u=record.u, x0=x0)
            both = jnp.concatenate([record.u, record.y], axis=1)
            return one_step_predictor(frozen, gain).simulate(u=both, x0=x0)

        if self.schedules == "still":
            return still()
        if self.schedules == "moving":
            return moving()
        return jax.lax.cond(jnp.all(kappa == kappa[:1]), still, moving)

    def forgets(self, prepared: Any) -> Bool[Array, ""]:
        """Not told: that would take a second simulation."""
        del prepared
        return jnp.asarray(True)

    @property
    def overlap(self) -> int:
        """Twice the order: states are met through the outputs that follow from them."""
        return 2 * self.states

    def shoot(
        self, prepared: Float[Array, " value"], record: Record, x0: Array, size: int
    ) -> tuple[Float[Array, "time ny"], Float[Array, " row"], Float[Array, " row"]]:
        """Output, and its first and its overlapping samples."""
        y = self.respond(prepared, record, x0)
        return y[:size], y[: self.overlap].reshape(-1), y[size:].reshape(-1)


def simulates(model: Any) -> bool:
    """Whether a module has `simulate(u=, dt=)`."""
    simulate = getattr(model, "simulate", None)
    return callable(simulate) and {"u", "dt"} <= set(inspect.signature(simulate).parameters)


def needs_schedule(model: Any, by_steps: bool) -> bool:
    """Whether it cannot do without κ, simulated or, where it can step, `by_steps`."""
    by_steps = by_steps and can_step(model)
    method = model.simulate if simulates(model) and not by_steps else model.step
    parameter = inspect.signature(method).parameters.get("kappa")
    return parameter is not None and parameter.default is inspect.Parameter.empty


def is_module(model: Any) -> bool:
    """Whether it is a module that can be simulated, one way or the other."""
    return isinstance(model, eqx.Module) and (simulates(model) or can_step(model))


def can_be_corrected(model: Any) -> bool:
    """Whether its state can be corrected from sample to sample."""
    return type(model) in _LPV or can_step(model)
