"""Which kind of model was given, and where its values start."""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from lpvid.data import IOData
from lpvid.identify import ContinuousTimeFit, Fit, MechanicalFit, StepResponseFit
from lpvid.models import (
    FreeStructure,
    StateSpace,
    StructuredModel,
    balancing,
    can_step,
    takes_schedule,
)
from lpvid.refinement._modules import (
    ModuleParameterisation,
    can_be_corrected,
    is_module,
    needs_schedule,
    simulates,
)
from lpvid.refinement._parameterisation import (
    AbstractParameterisation,
    LinearParameterisation,
    Record,
    channel_sizes,
    free_units,
)
from lpvid.refinement._predictors import AbstractPredictor, Innovation
from lpvid.refinement._refined import Refined


class Start(NamedTuple):
    """A kind of model, and its values at the start."""

    parameterisation: AbstractParameterisation
    values: Float[Array, " value"]


def recognise(model: Any, data: IOData, predictor: AbstractPredictor) -> Start:
    """Read a model.

    Raises:
        ValueError: it is of no known kind, or does not fit the data.
    """
    gain = predictor.gain if isinstance(predictor, Innovation) else None
    estimates_gain = isinstance(predictor, Innovation)
    feedthrough = None
    if isinstance(model, Fit | Refined):
        if gain is None and estimates_gain:
            gain = model.innovation_gain
        # Said by the fit, so that it is known under jit too.
        moments = model.moments if isinstance(model, Fit) else None
        feedthrough = None if moments is None else moments.feedthrough
        model = model.model
    if isinstance(model, MechanicalFit):
        model = StructuredModel(model.structure, model.parameters)
    if isinstance(model, ContinuousTimeFit | StepResponseFit):
        model = model.model
    if isinstance(model, StateSpace):
        return _black_box(model, data, estimates_gain, gain, feedthrough)
    if isinstance(model, StructuredModel):
        return _structured(model, data, estimates_gain, gain)
    if is_module(model):
        return _module(model, data, estimates_gain, gain)
    raise ValueError(
        f"model: {type(model).__name__} cannot be refined; give a StateSpace, a Fit, a "
        "StructuredModel, an LPVStateSpace, a GrayBoxLPV, a NonlinearModel (of any plant with "
        "ẋ = f(x, u)), or an eqx.Module with simulate(u=, dt=, x0=) or step(x, u, dt=)."
    )


def _check(model: StateSpace, data: IOData) -> None:
    if model.A.ndim != 2:
        raise ValueError("model: one model is needed, without batch axes; use jax.lax.map.")
    if (model.nu, model.ny) != (data.nu, data.ny):
        raise ValueError(
            f"model has {model.nu} inputs and {model.ny} outputs, the data {data.nu} and "
            f"{data.ny}: choose channels with data.select."
        )
    if model.is_discrete and not np.isclose(model.dt, data.dt, rtol=1e-9):
        raise ValueError(
            f"model has dt={model.dt}, the data dt={data.dt}: convert it with to_continuous() (and "
            "discretise at the data's), or check the data's sample time."
        )


def _gain(gain: Array | None, nx: int, ny: int) -> Array:
    if gain is None:
        return jnp.zeros((nx, ny))
    if gain.shape != (nx, ny):
        raise ValueError(f"predictor: its gain has shape {gain.shape}; ({nx}, {ny}) is needed.")
    return gain


def _black_box(
    model: StateSpace, data: IOData, estimates_gain: bool, gain, feedthrough: bool | None
) -> Start:
    _check(model, data)
    nx, ny = model.nx, model.ny
    if feedthrough is None:
        feedthrough = isinstance(model.D, Tracer) or bool(np.any(np.asarray(model.D)))
    values, units = _balanced(
        model, data.u, data.y, _gain(gain, nx, ny), feedthrough, estimates_gain
    )
    kind = LinearParameterisation(
        structure=FreeStructure(nx, model.nu, ny, feedthrough=feedthrough),
        dt=data.dt,
        discrete=model.is_discrete,
        black_box=True,
        gain=estimates_gain,
        sizes=(nx, model.nu, ny),
        units=units,
    )
    return Start(kind, values)


@partial(jax.jit, static_argnums=(4, 5))
def _balanced(
    model: StateSpace, u: Array, y: Array, gain: Array, feedthrough: bool, estimates_gain: bool
) -> tuple[Array, Array]:
    """Entries balanced for channels of one size, so that all matter about equally; their units.

    As they were, where there is no balanced form (unstable, not minimal).
    """
    u_size, y_size = channel_sizes(u), channel_sizes(y)
    scaled = StateSpace(model.A, model.B * u_size[None, :], model.C / y_size[:, None], dt=model.dt)
    forward, backward, _ = balancing(scaled)
    given = (model.A, model.B, model.C, gain)
    moved = (forward @ model.A @ backward, forward @ model.B, model.C @ backward, forward @ gain)
    size = jnp.linalg.norm(forward) * jnp.linalg.norm(backward)
    good = jnp.isfinite(size) & (jnp.max(jnp.abs(forward @ backward - jnp.eye(model.nx))) < 1e-6)
    A, B, C, K = (jnp.where(good, new, old) for new, old in zip(moved, given, strict=True))
    blocks = [A, B, C, *((model.D,) if feedthrough else ()), *((K,) if estimates_gain else ())]
    values = jnp.concatenate([block.reshape(-1) for block in blocks])
    return values, free_units(A, u, y, feedthrough=feedthrough, gain=estimates_gain)


def _structured(model: StructuredModel, data: IOData, estimates_gain: bool, gain) -> Start:
    frozen = model.state_space
    _check(frozen, data)
    values = model.parameters
    if estimates_gain:
        values = jnp.concatenate([values, _gain(gain, frozen.nx, frozen.ny).reshape(-1)])
    kind = LinearParameterisation(
        structure=model.structure,
        dt=data.dt,
        discrete=False,
        black_box=False,
        gain=estimates_gain,
        sizes=(frozen.nx, frozen.nu, frozen.ny),
        units=jnp.ones_like(values),
    )
    return Start(kind, values)


def _schedules(data: IOData) -> str:
    """Whether κ rests in all records, in some, or in none; "moving" where that is not known."""
    if data.kappa is None or isinstance(data.kappa, Tracer):
        return "moving"
    rests = [bool(np.all(kappa == kappa[:1])) for kappa in _per_record(data)]
    if all(rests):
        return "still"
    return "mixed" if any(rests) else "moving"


def _per_record(data: IOData) -> list[np.ndarray]:
    return np.split(np.asarray(data.kappa), np.cumsum(data.lengths)[:-1])


def _module(model: Any, data: IOData, estimates_gain: bool, gain: Array | None) -> Start:
    name = type(model).__name__
    if estimates_gain and not can_be_corrected(model):
        raise ValueError(
            f"predictor: Innovation() corrects the state after every sample, and {name} offers "
            "simulate alone. Give it step(x, u, dt=) -> (state one sample later, output now), "
            "describe it as a NonlinearModel, or use OutputError()."
        )
    if data.kappa is None and needs_schedule(model, estimates_gain):
        raise ValueError(f"data: {name} needs the scheduling; give kappa= to IOData.")
    dt = getattr(model, "dt", 0.0)
    if isinstance(dt, float) and dt > 0.0 and not np.isclose(dt, data.dt, rtol=1e-9):
        raise ValueError(
            f"model has dt={dt}, the data dt={data.dt}: give the model in continuous time, or "
            "check the data's sample time."
        )
    states = int(getattr(model, "n_states", getattr(model, "nx", 0)))
    # A module that simulates starts where it likes; one that steps is given its first state.
    if not states and (estimates_gain or not simulates(model)):
        raise ValueError(
            f"model: {name} has a step, but n_states does not say how many states it has; name "
            "their number."
        )
    kind = ModuleParameterisation(model, data.dt, states, _schedules(data))
    if not kind.names:
        raise ValueError("model: it holds no inexact arrays, so there is nothing to estimate.")
    values = kind.start()
    _check_module(kind, values, data, estimates_gain)
    if estimates_gain:
        kind = replace(kind, outputs=data.ny)
        values = jnp.concatenate([values, _gain(gain, states, data.ny).reshape(-1)])
    return Start(kind, values)


def _check_module(
    kind: ModuleParameterisation, values: Array, data: IOData, estimates_gain: bool
) -> None:
    """Raise where shapes do not fit, seen on two samples."""
    states = kind.states
    kappa = None if data.kappa is None else data.kappa[:2]
    record = Record(data.u[:2], data.y[:2], kappa, jnp.asarray(0))
    if can_step(kind.model) and (estimates_gain or not simulates(kind.model)):
        _check_step(kind, record)
    shape = jax.eval_shape(kind.respond, values, record, jnp.zeros(states))
    if shape.shape != (2, data.ny):
        raise ValueError(
            f"model: its output has shape {shape.shape} for two samples; this data needs "
            f"(2, {data.ny})."
        )


def _check_step(kind: ModuleParameterisation, record: Record) -> None:
    """Raise where a step does not lead from a state to the next one and an output."""
    model, states = kind.model, kind.states
    options: dict[str, Any] = {"dt": jnp.asarray(kind.dt)}
    if record.kappa is not None and takes_schedule(model.step):
        options["kappa"] = record.kappa[0]
    found = jax.eval_shape(lambda x, u: model.step(x, u, **options), jnp.zeros(states), record.u[0])
    if not isinstance(found, tuple) or len(found) != 2:
        what = f"{len(found)} values" if isinstance(found, tuple) else f"a {type(found).__name__}"
        raise ValueError(
            f"model: the step of {type(model).__name__} returns {what}; a tuple of two is needed, "
            "(state one sample later, output at this one)."
        )
    if found[0].shape != (states,):
        raise ValueError(
            f"model: its step leads from {states} states to shape {found[0].shape}; ({states},) is "
            "needed, n_states (or nx) long."
        )
    if found[1].shape != record.y.shape[1:]:
        raise ValueError(
            f"model: its step gives an output of shape {found[1].shape}; this data needs "
            f"{record.y.shape[1:]}, a single output as x[:1]."
        )
