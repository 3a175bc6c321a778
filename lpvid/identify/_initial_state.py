"""Initial states for a given model, and the fit they allow on data not seen."""

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.data import IOData
from lpvid.identify._linear_fit import solve_positive
from lpvid.identify._simulation_error import record_equations
from lpvid.models import LPVStateSpace, StateSpace


@jax.jit
def _least_squares_start(A, B, C, D, equations):
    (nx, nu), ny = B.shape, C.shape[0]
    known = jnp.concatenate([jnp.broadcast_to(B.T[None], (ny, nu, nx)), D[:, :, None]], axis=2)
    known = known.reshape(ny, nu * (nx + 1))
    start = slice(nu * (nx + 1), -1)

    def one(equation):
        rest = equation.right[:, start]
        rest -= jnp.einsum("kab,kb->ka", equation.matrix[:, start, : known.shape[1]], known)
        square = jnp.sum(equation.matrix[:, start, start], axis=0)
        return solve_positive(square, jnp.sum(rest, axis=0)[:, None])[:, 0]

    return jax.lax.map(one, equations)


_equations = jax.jit(record_equations, static_argnames="lengths")


def estimate_initial_state(model: Any, data: IOData) -> Float[Array, "record nx"]:
    r"""Initial state of every record that minimises the model's simulation error.

    Least squares on $y(t) - \hat y(t; x_0 = 0) = C A^t x_0$, outputs weighted by their RMS; the
    least-norm solution where the model is not observable. Memory beside the data is independent of
    the record's length. Composes with `jit`, `vmap` and `grad`.

    Args:
        model: a `StateSpace` in discrete time with the data's sample time, or in continuous time
            (inputs held); an LPV model, for data with `kappa`; or what a fit returns (`Fit`,
            `Refined`, `StructuredModel`, ...), its output offset taken into account.
        data: one or several records.

    Returns:
        One state for each record, (record, nx).

    Raises:
        ValueError: sample times or channel counts differ, or an LPV model meets data without
            scheduling.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.identify import estimate_initial_state
        >>> from lpvid.models import StateSpace
        >>> data = IOData(u=np.zeros(4), y=[3.0, 1.5, 0.75, 0.375], dt=0.1)
        >>> model = StateSpace([[0.5]], [[1.0]], [[1.0]], dt=0.1)
        >>> round(estimate_initial_state(model, data).item(), 6)
        3.0
    """
    model, data = _resolved(model, data)
    if isinstance(model, LPVStateSpace):
        return jnp.stack([_lpv_start(model, record) for record in data.records])
    _check_match(model, data)
    power = jnp.sqrt(jnp.mean(data.y * data.y, axis=0))
    scale = jnp.where(power > 0.0, power, 1.0)
    C = model.C / scale[:, None]
    equations = _equations(model.A, C, data.u, data.y / scale[None, :], lengths=data.lengths)
    return _least_squares_start(model.A, model.B, C, model.D / scale[:, None], equations)


def simulation_fit(model: Any, data: IOData) -> Float[Array, " ny"]:
    """Best fit (BFT) of each output, with every record's initial state estimated.

    100 max(1 - |y - ŷ| / |y - mean y|, 0) over all records together, the mean taken in each. This
    is how a model is scored on records it has not seen: simulated, not predicted one step ahead,
    and not blamed for a state that nobody measured.

    Args:
        model: as for `estimate_initial_state`.
        data: as for `estimate_initial_state`.

    Returns:
        Percentages (ny,).

    Raises:
        ValueError: as `estimate_initial_state` does.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.identify import simulation_fit
        >>> from lpvid.models import StateSpace
        >>> data = IOData(u=np.zeros(4), y=[3.0, 1.5, 0.75, 0.375], dt=0.1)
        >>> simulation_fit(StateSpace([[0.5]], [[1.0]], [[1.0]], dt=0.1), data).round(3).tolist()
        [100.0]
    """
    model, data = _resolved(model, data)
    starts = estimate_initial_state(model, data)
    missed = jnp.zeros(data.ny)
    moved = jnp.zeros(data.ny)
    for x0, record in zip(starts, data.records, strict=True):
        y = record.y
        if isinstance(model, LPVStateSpace):
            simulated = _lpv_response(model, record, record.u, x0)
        else:
            simulated = jnp.asarray(model.simulate(u=record.u, x0=x0))
        missed += jnp.sum((y - simulated) ** 2, axis=0)
        moved += jnp.sum((y - jnp.mean(y, axis=0, keepdims=True)) ** 2, axis=0)
    return 100.0 * jnp.maximum(1.0 - jnp.sqrt(missed / moved), 0.0)


def offset_level(offset: Float[Array, "*record ny"], data: IOData) -> Float[Array, "time ny"]:
    """A fit's output offset over time, one for all records or one for each.

    Args:
        offset: (ny,) or (record, ny).
        data: the records.

    Raises:
        ValueError: offsets of another number of records.
    """
    if offset.ndim == 1:
        return jnp.broadcast_to(offset, (data.n_samples, offset.shape[0]))
    if offset.shape[0] != len(data.lengths):
        raise ValueError(
            f"data: the fit has offsets of {offset.shape[0]} records, one each, and there are "
            f"{len(data.lengths)}: give the records it was made from, or a fit with one offset for "
            "all."
        )
    return jnp.repeat(offset, jnp.asarray(data.lengths), axis=0, total_repeat_length=data.n_samples)


def _resolved(item: Any, data: IOData) -> tuple[StateSpace | LPVStateSpace, IOData]:
    """The model itself at the data's sample time, and the data it is for."""
    offset = getattr(item, "output_offset", None)
    if offset is not None:
        data = data.replace(y=data.y - offset_level(jnp.asarray(offset), data))
    model = item
    for name in ("model", "state_space"):
        model = getattr(model, name, model)
    if isinstance(model, StateSpace) and not model.is_discrete:
        model = model.discretise(data.dt)
    if not isinstance(model, StateSpace | LPVStateSpace):
        raise ValueError(
            f"model: a {type(item).__name__} has no state-space model; give a StateSpace, an "
            "LPVStateSpace, or the result of a fit to one."
        )
    return model, data


def _lpv_start(model: LPVStateSpace, record: IOData) -> Float[Array, " nx"]:
    """Least squares on the response to each unit state along the record's scheduling."""
    frozen = model.structure.matrices(model.parameters(_scheduling(record)[0]))
    if (frozen.nu, frozen.ny) != (record.nu, record.ny):
        raise ValueError(
            f"model has {frozen.nu} inputs and {frozen.ny} outputs, the data {record.nu} and "
            f"{record.ny}: choose channels with data.select."
        )
    power = jnp.sqrt(jnp.mean(record.y**2, axis=0))
    scale = jnp.where(power > 0.0, power, 1.0)[None]
    forced = _lpv_response(model, record, record.u, jnp.zeros(frozen.nx))
    silent = jnp.zeros_like(record.u)
    with warnings.catch_warnings():
        # What the schedule does was said with the forced response.
        warnings.simplefilter("ignore")
        free = jax.vmap(lambda x0: _lpv_response(model, record, silent, x0) / scale)(
            jnp.eye(frozen.nx)
        )
    left = ((record.y - forced) / scale).reshape(-1)
    return jnp.linalg.lstsq(free.reshape(frozen.nx, -1).T, left)[0]


def _lpv_response(model: LPVStateSpace, record: IOData, u: Array, x0: Array) -> Array:
    return model.simulate(u=u, kappa=_scheduling(record), dt=record.dt, x0=x0)


def _scheduling(record: IOData) -> Float[Array, "time nk"]:
    if record.kappa is None:
        raise ValueError(
            "data: an LPV model needs the scheduling along the record; give kappa= to IOData."
        )
    return record.kappa


def _check_match(model: StateSpace, data: IOData) -> None:
    if model.A.ndim != 2:
        raise ValueError("model: one model is needed, without batch axes; use jax.vmap over them.")
    if (model.nu, model.ny) != (data.nu, data.ny):
        raise ValueError(
            f"model has {model.nu} inputs and {model.ny} outputs, the data {data.nu} and "
            f"{data.ny}: choose channels with data.select."
        )
    if not np.isclose(model.dt, data.dt, rtol=1e-9):
        raise ValueError(
            f"model has dt={model.dt}, the data dt={data.dt}: discretise the model at the data's "
            f"sample time."
        )
