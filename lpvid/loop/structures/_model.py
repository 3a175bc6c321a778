"""Any linear model that is there already, with ports at its inputs and outputs."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.data import IOData
from lpvid.loop._ported import AbstractPortedStructure, Labels, Ports
from lpvid.loop.structures._channels import require_channels
from lpvid.loop.structures._companion import companion_form, gauge_of, in_gauge, split_entries
from lpvid.loop.structures._free import free_ports
from lpvid.loop.structures._search import best_start, window_error
from lpvid.loop.structures._units import per
from lpvid.loop.structures._windows import windows_of
from lpvid.models import GrayBoxLPV, LPVStateSpace, StateSpace, StructuredModel


class PortedModel(AbstractPortedStructure):
    """A given model as a structure: its own parameters, ports as a black box has them.

    A gray-box model keeps its parameters, an LPV model its coefficients; a state-space model, or
    what a fit returns, gets those of a modal companion form, which fixes the states.

    Args:
        model: a `StateSpace`, `StructuredModel`, `GrayBoxLPV`, an `LPVStateSpace` in continuous
            time, or the result of a fit to one of them.
        data: records, for the names and units of the channels.

    Raises:
        ValueError: something else, an LPV model in discrete time, channels or scheduling that do
            not fit, or a state-space model with states that nothing moves.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.loop.structures import PortedModel
        >>> from lpvid.models import StateSpace
        >>> model = StateSpace([[0.0, 1.0], [-4.0, -0.5]], [[0.0], [2.0]], [[1.0, 0.0]])
        >>> PortedModel(model, IOData(u=np.zeros(9), y=np.zeros(9), dt=0.1)).nominal[:2].tolist()
        [4.0, 0.5]
    """

    labels: Labels = eqx.field(static=True)
    model: Any
    nominal: Float[Array, " parameter"]
    name: str = eqx.field(default="model", static=True)

    def __init__(self, model: Any, data: IOData):
        for part in ("model", "state_space"):
            if not isinstance(model, StateSpace | LPVStateSpace | StructuredModel | GrayBoxLPV):
                model = getattr(model, part, model)
        scheduled = isinstance(model, GrayBoxLPV | LPVStateSpace)
        if isinstance(model, GrayBoxLPV):
            names, self.nominal, count = (
                model.parameter_names,
                model.parameters,
                len(model.kappa_low),
            )
        elif isinstance(model, LPVStateSpace):
            names, self.nominal, count = _coefficients(model)
        elif isinstance(model, StructuredModel):
            names, self.nominal, count = model.structure.parameter_names, model.parameters, 0
        elif isinstance(model, StateSpace):
            names, self.nominal, model = _companion(model, data)
            count = 0
        else:
            raise ValueError(
                f"model: a {type(model).__name__} is no linear model; give a StateSpace, a "
                f"StructuredModel, a GrayBoxLPV or an LPVStateSpace, or a structure by its name."
            )
        if scheduled and data.nk != count:
            raise ValueError(
                f"data: the model has {count} scheduling variables, the data {data.nk}; give "
                f"kappa= to IOData (on the command line --schedule COL)."
            )
        self.model = model
        self.labels = Labels(
            inputs=data.input_names,
            input_units=data.input_units,
            outputs=data.output_names,
            output_units=data.output_units,
            parameters=tuple(names),
            parameter_units=("",) * len(names),
            coordinates=data.output_names,
            coordinate_units=data.output_units,
            force_units=tuple(per(unit, "s") for unit in data.output_units),
        )
        made = jax.eval_shape(self._at, jnp.zeros(len(names)), jnp.zeros(data.nk))
        nu, ny = made[1].shape[1], made[2].shape[0]
        require_channels(data, self.name, inputs=nu, outputs=(ny,))

    def ports(self, theta: Float[Array, " parameter"], kappa: Float[Array, " nk"]) -> Ports:
        """The matrices at θ and κ."""
        return free_ports(*self._at(theta, kappa))

    def _at(self, theta: Array, kappa: Array) -> tuple[Array, ...]:
        model = self.model
        if isinstance(model, GrayBoxLPV):
            frozen = model.function(theta, kappa)
        elif isinstance(model, LPVStateSpace):
            table = theta.reshape(model.coefficients.shape)
            frozen = eqx.tree_at(lambda lpv: lpv.coefficients, model, table).at(kappa)
        elif isinstance(model, StructuredModel):
            frozen = model.structure.matrices(theta)
        else:
            return model(theta)
        return frozen.A, frozen.B, frozen.C, frozen.D

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """None."""
        return np.full(len(self.nominal), -np.inf), np.full(len(self.nominal), np.inf)

    def start(self, data: IOData) -> np.ndarray:
        """θ by a search from the model's own parameters."""
        states = self.ports(self.nominal, jnp.zeros(data.nk)).A.shape[0]
        problem = window_error(self, windows_of(data, states))
        return best_start(problem, np.asarray(self.nominal)[None], tries=1)[0]


class _Entries(eqx.Module):
    """θ → A, B, C, D in modal companion form."""

    order: int = eqx.field(static=True)
    nu: int = eqx.field(static=True)
    ny: int = eqx.field(static=True)
    offset: Float[Array, " entry"]
    linear: Float[Array, "entry parameter"]

    def __call__(self, theta: Array) -> tuple[Array, ...]:
        entries = self.offset + self.linear @ theta
        return split_entries(entries, self.order, self.nu, self.ny)


def _companion(model: StateSpace, data: IOData):
    if model.is_discrete:
        model = model.to_continuous()
    require_channels(data, "model", inputs=model.nu, outputs=(model.ny,))
    A, B, C, D = (np.asarray(matrix) for matrix in (model.A, model.B, model.C, model.D))
    gauge = gauge_of(A, B, C)
    theta = None if gauge is None else in_gauge(A, B, C, gauge)
    if gauge is None or theta is None:
        raise ValueError(
            "model: some of its states are not moved by any input, or several modes coincide; take "
            "them out with balanced_truncation, or leave the model out and give its order."
        )
    form = companion_form(gauge, model.nx, model.nu, model.ny)
    if np.any(D):
        form, theta = form.with_feedthrough(), np.concatenate([theta, D.ravel()])
    entries = _Entries(
        model.nx, model.nu, model.ny, jnp.asarray(form.offset), jnp.asarray(form.linear)
    )
    names = form.names(data.input_names, data.output_names)
    return names, jnp.asarray(theta), entries


def _coefficients(model: LPVStateSpace):
    if model.dt > 0.0:
        raise ValueError(
            "model: an LPV model in discrete time has no ports for forces; give the one in "
            "continuous time that it was made from."
        )
    rows = range(model.coefficients.shape[0])
    names = [f"{name}, basis {row + 1}" for row in rows for name in model.structure.parameter_names]
    return tuple(names), model.coefficients.ravel(), model.n_scheduling
