"""The modes of a model and what each contributes, measured in three ways."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Complex, Float

from lpvid._results import Status
from lpvid.data import IOData
from lpvid.models import StateSpace, modal_form
from lpvid.reduce._single_modes import SingleModes, single_modes

# Condition of the eigenvectors beyond which half the digits of single modes are lost.
_CLOSE_POLES = 1e8


class ModalTable(eqx.Module):
    """The modes of a model, a complex pair of poles being one mode; `str` gives a plain table.

    Modes are sorted by rising natural frequency. Continuous-time models with a record are measured
    as sampled by a zero-order hold at the record's rate.

    Attributes:
        model: the model in real block-diagonal form, the modes' states in the table's order.
        sizes: states of each mode: 2 for a complex pair, 1 for a real pole.
        poles: of each mode, z or s as the model has them, that of a pair with positive imaginary
            part, (mode,).
        frequency: natural frequency |s|, rad/s, (mode,).
        damping: damping ratio −Re s / |s|, (mode,); one or minus one for a real pole.
        response_magnitude: MRM of equation 3-8, output unit, (mode,); NaN without a record.
        singular_value: MSV of equation 3-4, square root of output unit over input unit, (mode,).
        hankel_values: Hankel singular values of the mode by itself, larger first, (mode, 2), zero
            second for a real pole; infinite for an unstable mode.
        x0: first state of each record in the modal states, (record, nx).
        condition: of the eigenvectors, each of unit length.
        status: `close_poles` where it is so large that single modes mean little, else `successful`.

    Source: 002, section 3.1.
    """

    model: StateSpace
    sizes: tuple[int, ...] = eqx.field(static=True)
    poles: Complex[Array, " mode"]
    frequency: Float[Array, " mode"]
    damping: Float[Array, " mode"]
    response_magnitude: Float[Array, " mode"]
    singular_value: Float[Array, " mode"]
    hankel_values: Float[Array, "mode 2"]
    x0: Float[Array, "record nx"]
    condition: Float[Array, ""]
    status: Status

    @property
    def unstable(self) -> Bool[Array, " mode"]:
        """Modes on or beyond the stability boundary."""
        if self.model.is_discrete:
            return jnp.abs(self.poles) >= 1.0
        return self.poles.real >= 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Numbers of each mode's states, as 002 writes them: `1/2` for a pair, `3` for one."""
        firsts = np.cumsum([1, *self.sizes[:-1]])
        return tuple(
            f"{first}/{first + 1}" if size == 2 else str(first)
            for first, size in zip(firsts, self.sizes, strict=True)
        )

    def rows(self, kept: ArrayLike | None = None) -> list[dict]:
        """One dictionary for each mode: its number, frequency in Hz, damping, measures and ranks.

        Args:
            kept: which modes a reduction kept, (mode,); adds that column.
        """
        kept = None if kept is None else np.asarray(kept)
        measures = {
            "MRM": np.asarray(self.response_magnitude),
            "MSV": np.asarray(self.singular_value),
            "Hankel": np.asarray(self.hankel_values)[:, 0],
        }
        places = {name: _places(values) for name, values in measures.items()}
        rows = []
        for i, name in enumerate(self.names):
            row = {
                "mode": name,
                "frequency": float(self.frequency[i]) / (2.0 * math.pi),
                "damping": float(self.damping[i]),
                "real": self.sizes[i] == 1,
                "unstable": bool(self.unstable[i]),
            }
            for label, values in measures.items():
                row |= {label: float(values[i]), f"{label} rank": places[label][i]}
            rows.append(row if kept is None else row | {"kept": bool(kept[i])})
        return rows

    def table(self, kept: ArrayLike | None = None) -> str:
        """The rows as text, with the ranks behind the measures.

        Args:
            kept: as for `rows`.
        """
        header = ["mode", "f (Hz)", "damping"]
        header += [text for name in ("MRM", "MSV", "Hankel") for text in (name, "rank")]
        lines = [header if kept is None else [*header, "kept"]]
        for row in self.rows(kept):
            damping = "real" if row["real"] else f"{row['damping']:.4f}"
            line = [row["mode"], f"{row['frequency']:.4g}", damping]
            for name in ("MRM", "MSV", "Hankel"):
                known = row[f"{name} rank"] is not None
                line += [f"{row[name]:.4g}", str(row[f"{name} rank"])] if known else ["-", "-"]
            line[2] += " unstable" if row["unstable"] else ""
            lines.append(line if kept is None else [*line, "yes" if row["kept"] else "no"])
        return aligned(lines)

    def __str__(self) -> str:
        return self.table()


def aligned(lines: Sequence[Sequence[str]]) -> str:
    """Lines of cells in columns, the first to the left and the others to the right."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if k else cell.ljust(width)
            for k, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def _places(values: np.ndarray) -> list[int | None]:
    if np.any(np.isnan(values)):
        return [None] * values.size
    places = np.empty(values.size, int)
    places[np.argsort(-values, kind="stable")] = np.arange(1, values.size + 1)
    return [int(place) for place in places]


def modal_table(
    model: StateSpace,
    data: IOData | None = None,
    *,
    x0: ArrayLike | None = None,
    samples: int | None = None,
) -> ModalTable:
    r"""The modes of a model with what each contributes.

    - MRM, modal response magnitude: the mode's response to the record's input, its mean size over
      all samples, of the output where that is largest.
    - MSV, mode singular value:
      $\sqrt{|\hat c_i|(1+|\lambda_i|+\dots+|\lambda_i|^{K-2})|\hat b_i|}$, that of a pulse.
    - Hankel singular values of the mode by itself, those by which balanced modal truncation goes
      (C. Gregory, J. Guid. Control Dyn. 7 (1984) 725-732; W. Gawronski and T. Williams, J. Guid.
      Control Dyn. 14 (1991) 68-76).

    The eigenvectors of a general matrix do not differentiate in JAX and which poles are pairs
    depends on the numbers: this, `modal_responses` and `modal_truncation` run eagerly, on one
    model, outside `jit`, `vmap` and `grad`. `update_model` composes with all three.

    Args:
        model: discrete-time, or continuous-time; poles apart from one another.
        data: record of the input that the model is for. Without it there is no MRM.
        x0: first state, (nx,) for every record or (record, nx); zero when left out.
        samples: K of the MSV; by default the length of the longest record, without a record
            infinitely many.

    Returns:
        A `ModalTable`.

    Raises:
        ValueError: traced matrices or a batch of models, a record of another rate or number of
            channels, x0 of another shape, repeated poles with too few eigenvectors.

    Source: 002, equations 3-1 to 3-8.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.models import StateSpace
        >>> from lpvid.reduce import modal_table
        >>> u = np.sign(np.sin(0.1 * np.arange(200)))
        >>> A = [[0.9, 0.3, 0.0], [-0.3, 0.9, 0.0], [0.0, 0.0, 0.5]]
        >>> model = StateSpace(A, [[0.1], [0.0], [1.0]], [[1.0, 0.0, 1.0]], dt=0.1)
        >>> print(modal_table(model, IOData(u=u, y=model.simulate(u=u), dt=0.1)))
        mode  f (Hz)  damping     MRM  rank    MSV  rank  Hankel  rank
        1/2   0.5189   0.1616  0.2423     2  0.9871     2  0.5325     2
        3      1.103     real    1.85     1   1.414     1   1.333     1
    """
    modal = _modal(model, data, x0)
    modes = modal.modes
    sampled = modes if data is None else modes.sampled(data.dt)
    magnitude = np.full(len(modal.sizes), np.nan)
    if data is not None:
        magnitude = np.mean(np.abs(sampled.responses(data)), axis=1).max(axis=1)
        samples = max(data.lengths) if samples is None else samples
    frequency, damping = _frequency_and_damping(modes.poles, model.dt)
    status = Status.successful if modal.condition < _CLOSE_POLES else Status.close_poles
    return ModalTable(
        model=modal.model,
        sizes=modal.sizes,
        poles=jnp.asarray(modes.poles),
        frequency=jnp.asarray(frequency),
        damping=jnp.asarray(damping),
        response_magnitude=jnp.asarray(magnitude),
        singular_value=jnp.asarray(sampled.pulse_values(samples)),
        hankel_values=jnp.asarray(modes.hankel_values()),
        x0=jnp.asarray(modal.x0),
        condition=jnp.asarray(modal.condition),
        status=status,
    )


def modal_responses(
    model: StateSpace, data: IOData, *, x0: ArrayLike | None = None
) -> Float[Array, "mode time ny"]:
    """Each mode's response to the record's input, both poles of a complex pair together.

    Their sum is the model's response, less D u. Runs eagerly, as `modal_table` does.

    Args:
        model: as for `modal_table`.
        data: one or several records; their outputs are not used.
        x0: as for `modal_table`.

    Returns:
        Responses in the order of `modal_table`, (mode, time, ny), the records one after another.

    Raises:
        ValueError: as for `modal_table`.

    Source: 002, equations 3-5 to 3-7.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.models import StateSpace
        >>> from lpvid.reduce import modal_responses
        >>> model = StateSpace([[0.9, 0.1], [0.0, 0.5]], [[1.0], [1.0]], [[1.0, 1.0]], dt=0.1)
        >>> u = np.ones(20)
        >>> responses = modal_responses(model, IOData(u=u, y=u, dt=0.1))
        >>> bool(np.allclose(responses.sum(axis=0), model.simulate(u=u)))
        True
    """
    return jnp.asarray(_modal(model, data, x0).modes.sampled(data.dt).responses(data))


class _Modal(NamedTuple):
    model: StateSpace
    sizes: tuple[int, ...]
    modes: SingleModes
    x0: np.ndarray
    condition: float


def _modal(model: StateSpace, data: IOData | None, x0: ArrayLike | None) -> _Modal:
    """The model in modal form, modes by rising frequency, and the modes one by one."""
    _check_model(model, data)
    starts = np.asarray(initial_states(model, data, x0))
    A, B, C, D = (np.asarray(m) for m in (model.A, model.B, model.C, model.D))
    # The identity's images under the transformation are the columns of its inverse.
    both = np.concatenate([C, np.eye(model.nx)])
    try:
        modal = modal_form(StateSpace(A, B, both, dt=model.dt))
    except ValueError as error:
        raise ValueError(
            "model: A has repeated poles with too few eigenvectors (two equal delays or a double "
            "integrator, say), so it has no single modes. Use balanced_truncation, or identify at "
            "a lower order."
        ) from error
    A, B, both = (np.asarray(m) for m in (modal.A, modal.B, modal.C))
    places, poles = _modes_of(A)
    order = np.argsort(_frequency_and_damping(poles, model.dt)[0], kind="stable")
    columns = np.concatenate([places[i] for i in order])
    A, B, C = A[np.ix_(columns, columns)], B[columns], both[: model.ny, columns]
    sizes = tuple(len(places[i]) for i in order)
    basis = both[model.ny :, columns]
    modal_x0 = np.linalg.solve(basis, starts.T).T
    return _Modal(
        StateSpace(A, B, C, D, dt=model.dt),
        sizes,
        single_modes(A, B, C, modal_x0, sizes, model.dt),
        modal_x0,
        _condition(basis, sizes),
    )


def _check_model(model: StateSpace, data: IOData | None) -> None:
    """One model of numbers, and a record that it can be for."""
    if isinstance(model.A, Tracer) or model.batch_shape:
        raise ValueError(
            "model: the modes of one model of numbers are needed: call this outside jit, vmap and "
            "grad, and on each model of a batch."
        )
    if data is None:
        return
    if (model.nu, model.ny) != (data.nu, data.ny):
        raise ValueError(
            f"data: {data.nu} inputs and {data.ny} outputs, the model has {model.nu} and "
            f"{model.ny}; choose channels with data.select."
        )
    if model.is_discrete and not math.isclose(model.dt, data.dt, rel_tol=1e-9):
        raise ValueError(
            f"data: sampled every {data.dt} s, the model every {model.dt} s; bring the model to "
            "the record's rate with to_continuous and discretise."
        )


def initial_states(
    model: StateSpace, data: IOData | None, x0: ArrayLike | None
) -> Float[Array, "record nx"]:
    """First state of every record, zero where none is given."""
    records = 1 if data is None else len(data.lengths)
    starts = jnp.zeros((records, model.nx)) if x0 is None else jnp.asarray(x0, float)
    if starts.ndim == 1 and starts.shape == (model.nx,):
        starts = jnp.broadcast_to(starts[None], (records, model.nx))
    if starts.shape != (records, model.nx):
        raise ValueError(
            f"x0 has shape {starts.shape}: give ({model.nx},), or ({records}, {model.nx}) with one "
            "state for each record."
        )
    return starts


def _modes_of(A: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
    """States and pole of each block of a real modal form."""
    places, poles, start = [], [], 0
    while start < A.shape[0]:
        pair = start + 1 < A.shape[0] and A[start, start + 1] != 0.0
        places.append(np.arange(start, start + (2 if pair else 1)))
        poles.append(complex(A[start, start], A[start, start + 1] if pair else 0.0))
        start += 2 if pair else 1
    return places, np.array(poles)


def _frequency_and_damping(poles: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    if dt:
        # A pure delay is infinitely fast.
        delay = poles == 0.0
        s = np.log(np.where(delay, 1.0, poles)) / dt
    else:
        delay, s = np.zeros(poles.size, bool), poles
    frequency = np.abs(s)
    moves = frequency > 0.0
    damping = np.where(moves, -np.real(s) / np.where(moves, frequency, 1.0), 1.0)
    return np.where(delay, np.inf, frequency), damping


def _condition(basis: np.ndarray, sizes: tuple[int, ...]) -> float:
    """Of the eigenvectors of unit length; a pair's two are those of a plane, as in A."""
    vectors, start = [], 0
    for size in sizes:
        block = basis[:, start : start + size]
        if size == 2:
            v = block[:, 0] + 1j * block[:, 1]
            vectors += [v, v.conj()]
        else:
            vectors.append(block[:, 0].astype(complex))
        start += size
    columns = np.stack(vectors, axis=1)
    return float(np.linalg.cond(columns / np.linalg.norm(columns, axis=0)))
