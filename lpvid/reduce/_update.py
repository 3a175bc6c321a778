"""B or C of a model again, by linear least squares on records."""

import abc
import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float

from lpvid._results import Status
from lpvid.analysis import relative_error
from lpvid.data import IOData
from lpvid.models import StateSpace
from lpvid.reduce._modal_table import initial_states


class Solved(eqx.Module):
    """What an update found: the model, its initial states, the condition and rank of the problem.

    Attributes:
        model: the updated model.
        x0: first state of every record.
        error: of the updated model's simulation.
        condition: of the regressors, each column of unit length.
        full_rank: whether they were linearly independent to rounding.
    """

    model: StateSpace
    x0: Float[Array, "record nx"]
    error: Float[Array, "time ny"]
    condition: Float[Array, ""]
    full_rank: Bool[Array, ""]


class AbstractUpdate(eqx.Module):
    """What of a model is estimated again, linear in the simulation error; gives `solve`.

    Example:
        >>> from lpvid.reduce import AbstractUpdate, InputUpdate
        >>> isinstance(InputUpdate(), AbstractUpdate)
        True
    """

    @abc.abstractmethod
    def solve(self, model: StateSpace, data: IOData, x0: Float[Array, "record nx"]) -> Solved:
        """Least squares over all records.

        Args:
            model: discrete-time, at the records' rate.
            data: the records.
            x0: first states, for what does not estimate them.
        """


class InputUpdate(AbstractUpdate):
    """B for the given A and C, outputs weighted by their RMS (002, equations 3-11 to 3-18).

    002 does not weight; all its outputs are in volts.

    Attributes:
        feedthrough: estimate D too; else it stays as it is.
        initial_state: estimate the first state of every record too; else it is the given one.

    Example:
        >>> from lpvid.reduce import InputUpdate
        >>> InputUpdate(initial_state=True).feedthrough
        False
    """

    feedthrough: bool = eqx.field(static=True, default=False)
    initial_state: bool = eqx.field(static=True, default=False)

    def solve(self, model: StateSpace, data: IOData, x0: Float[Array, "record nx"]) -> Solved:
        """Least squares for B, and D and the first states where asked."""
        (nx, nu), ny, time = model.B.shape, model.ny, data.n_samples
        power = jnp.sqrt(jnp.mean(data.y**2, axis=0))
        scale = jnp.where(power > 0.0, power, 1.0)
        forced, free = _regressors(model, data)
        # Columns: B input by input, then D row by row, then the records' first states.
        columns, right = [forced.reshape(time, ny, nu * nx)], data.y
        if self.feedthrough:
            direct = jnp.einsum("kl,tj->tklj", jnp.eye(ny), data.u)
            columns.append(direct.reshape(time, ny, ny * nu))
        else:
            right = right - data.u @ model.D.T
        own = jnp.asarray(np.repeat(np.eye(len(data.lengths)), data.lengths, axis=0))
        if self.initial_state:
            starts = jnp.einsum("tr,tkx->tkrx", own, free)
            columns.append(starts.reshape(time, ny, -1))
        else:
            right = right - jnp.einsum("tkx,tx->tk", free, own @ x0)
        rows = jnp.concatenate(columns, axis=2)
        found, condition, full = _least_squares(
            (rows / scale[None, :, None]).reshape(time * ny, -1),
            (right / scale[None]).reshape(time * ny, 1),
        )
        found, n_b = found[:, 0], nu * nx
        n_d = ny * nu if self.feedthrough else 0
        B = found[:n_b].reshape(nu, nx).T
        D = found[n_b : n_b + n_d].reshape(ny, nu) if n_d else model.D
        x0 = found[n_b + n_d :].reshape(-1, nx) if self.initial_state else x0
        updated = StateSpace(model.A, B, model.C, D, dt=model.dt)
        return Solved(updated, x0, right - rows @ found, condition, full)


class OutputUpdate(AbstractUpdate):
    """C for the given A and B and first states (002, equations 3-19 to 3-21).

    With one input, poles apart and every mode excited, this frees all residues: B could add
    nothing.

    Attributes:
        feedthrough: estimate D too; else it stays as it is.

    Example:
        >>> from lpvid.reduce import OutputUpdate
        >>> OutputUpdate().feedthrough
        False
    """

    feedthrough: bool = eqx.field(static=True, default=False)

    def solve(self, model: StateSpace, data: IOData, x0: Float[Array, "record nx"]) -> Solved:
        """Least squares for C, and D where asked."""
        rows, right = _states(model, data, x0), data.y
        if self.feedthrough:
            rows = jnp.concatenate([rows, data.u], axis=1)
        else:
            right = right - data.u @ model.D.T
        found, condition, full = _least_squares(rows, right)
        C = found[: model.nx].T
        D = found[model.nx :].T if self.feedthrough else model.D
        updated = StateSpace(model.A, model.B, C, D, dt=model.dt)
        return Solved(updated, x0, right - rows @ found, condition, full)


class UpdatedModel(eqx.Module):
    """A model whose B or C was estimated again.

    Attributes:
        model: the updated model.
        x0: first state of every record, (record, nx).
        relative_error: RMS of the simulation error over that of the output, on the records it was
            updated with, (ny,).
        condition: of the least-squares problem, each regressor of unit length.
        status: `ill_conditioned` where the records do not tell all unknowns apart (the solution of
            least norm is given), `nonfinite`, else `successful`.
    """

    model: StateSpace
    x0: Float[Array, "record nx"]
    relative_error: Float[Array, " ny"]
    condition: Float[Array, ""]
    status: Status


def update_model(
    model: StateSpace,
    data: IOData,
    method: AbstractUpdate | None = None,
    *,
    x0: ArrayLike | None = None,
) -> UpdatedModel:
    """Estimate B or C of a model again, all else given: what a truncation did is made up for.

    The simulation error is linear in B (with D and x0) for given A and C, and in C (with D) for
    given A, B and x0: one linear least-squares problem, no iteration. Memory is that of the
    regressors, (ny · time, unknowns).

    Composes with `jit`, `vmap` and `grad` in the model's matrices, the records and x0; derivatives
    are exact where the regressors have full rank.

    Args:
        model: discrete-time, one model, at the records' rate.
        data: one or several records.
        method: `InputUpdate()` (the default), `OutputUpdate()`, or one of your own.
        x0: first state, (nx,) for every record or (record, nx), where the method does not estimate
            it; zero when left out.

    Returns:
        The updated model with its initial states and errors.

    Raises:
        ValueError: a batch of models, another rate or number of channels than the records', fewer
            samples than unknowns, x0 of another shape.

    Source: 002, equations 3-11 to 3-21.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.models import StateSpace
        >>> from lpvid.reduce import update_model
        >>> u = np.random.default_rng(0).standard_normal(50)
        >>> true = StateSpace([[0.9]], [[2.0]], [[1.0]], dt=0.1)
        >>> model = StateSpace([[0.9]], [[1.5]], [[1.0]], dt=0.1)
        >>> round(update_model(model, IOData(u=u, y=true.simulate(u=u), dt=0.1)).model.B.item(), 6)
        2.0
    """
    method = InputUpdate() if method is None else method
    if model.batch_shape:
        raise ValueError("model: one model is needed, without batch axes; use jax.vmap over them.")
    if (model.nu, model.ny) != (data.nu, data.ny):
        raise ValueError(
            f"data: {data.nu} inputs and {data.ny} outputs, the model has {model.nu} and "
            f"{model.ny}; choose channels with data.select."
        )
    if not math.isclose(model.dt, data.dt, rel_tol=1e-9):
        raise ValueError(
            f"model has dt={model.dt}, the records dt={data.dt}: discretise it at their rate."
        )
    return _updated(model, data, method, initial_states(model, data, x0))


@eqx.filter_jit
def _updated(model: StateSpace, data: IOData, method: AbstractUpdate, x0: Array) -> UpdatedModel:
    solved = method.solve(model, data, x0)
    errors = relative_error(data.y, data.y - solved.error)
    status = Status.where(solved.full_rank, Status.successful, Status.ill_conditioned)
    finite = jnp.all(jnp.isfinite(errors))
    return UpdatedModel(
        model=solved.model,
        x0=solved.x0,
        relative_error=errors,
        condition=solved.condition,
        status=Status.where(finite, status, Status.nonfinite),
    )


def _firsts(data: IOData) -> np.ndarray:
    """Which samples begin a record, (time,)."""
    firsts = np.zeros(data.n_samples, bool)
    firsts[np.cumsum([0, *data.lengths[:-1]])] = True
    return firsts


def _regressors(
    model: StateSpace, data: IOData
) -> tuple[Float[Array, "time ny nu nx"], Float[Array, "time ny nx"]]:
    """Of B, r_kj(t+1) = r_kj(t) A + C_k u_j(t), and of x0, C_k Aᵗ, anew in every record."""
    shape = (model.ny, model.nu, model.nx)

    def step(carry, now):
        u, first = now
        forced = jnp.where(first, 0.0, carry[0])
        free = jnp.where(first, model.C, carry[1])
        driven = model.C[:, None, :] * u[None, :, None]
        return (forced @ model.A + driven, free @ model.A), (forced, free)

    carry = (jnp.zeros(shape), jnp.zeros_like(model.C))
    return lax.scan(step, carry, (data.u, jnp.asarray(_firsts(data))), unroll=4)[1]


def _states(
    model: StateSpace, data: IOData, x0: Float[Array, "record nx"]
) -> Float[Array, "time nx"]:
    starts = jnp.repeat(x0, np.array(data.lengths), axis=0, total_repeat_length=data.n_samples)

    def step(x, now):
        u, first, start = now
        x = jnp.where(first, start, x)
        return model.A @ x + model.B @ u, x

    signals = (data.u, jnp.asarray(_firsts(data)), starts)
    return lax.scan(step, jnp.zeros(model.nx), signals, unroll=4)[1]


def _least_squares(rows: Array, right: Array) -> tuple[Array, Array, Array]:
    """Solution of least norm, condition of the scaled columns, and whether they are independent.

    With columns P fixed, θ = P (PᵀΦᵀΦP)⁻¹ PᵀΦᵀ y is the solution for every Φ of full rank, so its
    derivatives pass no decomposition; P makes Φ P orthonormal, so nothing is squared.
    """
    samples, unknowns = rows.shape
    if samples < unknowns:
        raise ValueError(
            f"data: {samples} measured values for {unknowns} unknowns; give longer records, or "
            "estimate less."
        )
    fixed = lax.stop_gradient(rows)
    length = jnp.linalg.norm(fixed, axis=0)
    scale = jnp.where(length > 0.0, 1.0 / jnp.where(length > 0.0, length, 1.0), 0.0)
    triangle = jnp.linalg.qr(fixed * scale[None], mode="r")
    _, values, vectors = jnp.linalg.svd(triangle)
    kept = values > values[0] * samples * jnp.finfo(float).eps
    inverse = jnp.where(kept, 1.0 / jnp.where(kept, values, 1.0), 0.0)
    columns = scale[:, None] * vectors.T * inverse[None]
    flat = rows @ columns
    gram = flat.T @ flat + jnp.diag(jnp.where(kept, 0.0, 1.0))
    solution = columns @ jnp.linalg.solve(gram, flat.T @ right)
    return solution, values[0] / values[-1], jnp.all(kept)
