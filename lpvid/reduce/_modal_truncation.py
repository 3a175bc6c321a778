"""Models of fewer modes."""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from lpvid._results import Status
from lpvid.data import IOData
from lpvid.models import StateSpace
from lpvid.reduce._modal_table import ModalTable, modal_table
from lpvid.reduce._mode_ranks import AbstractModeRank, ModalResponseMagnitude

Unstable = Literal["refuse", "keep", "move"]


class ModalReduction(eqx.Module):
    """A model of fewer modes; `str` gives the table of all of them with those kept.

    Attributes:
        model: the reduced model, in real block-diagonal form, D as the original's.
        x0: first state of each record, (record, order).
        table: of the modes of the original (after unstable ones were moved).
        kept: which modes are in the model, (mode,).
        bound: largest possible H-infinity norm of the error: twice the sum of the Hankel singular
            values of each mode left out; infinite where an unstable one is.
        status: the table's.
    """

    model: StateSpace
    x0: Float[Array, "record order"]
    table: ModalTable
    kept: Bool[Array, " mode"]
    bound: Float[Array, ""]
    status: Status

    def __str__(self) -> str:
        return self.table.table(self.kept)


def modal_truncation(
    model: StateSpace,
    order: int,
    *,
    data: IOData | None = None,
    rank: AbstractModeRank | None = None,
    unstable: Unstable = "refuse",
    radius: float = 0.9999,
    x0: ArrayLike | None = None,
) -> ModalReduction:
    """Reduce a model to its most important modes, complex pairs kept together.

    The modes are taken in the order of `rank` as long as their states fit: where a pair comes next
    and one state is left, the next real mode is taken; without one, the model has a state less
    than `order`. The frequency response changes by that of what is left out; `update_model`
    afterwards makes up for much of that on a record.

    Runs eagerly, as `modal_table` does. Beside it: `balanced_truncation`.

    Args:
        model: as for `modal_table`.
        order: most states kept.
        data: record of the input that the model is for; some ranks need it.
        rank: `ModalResponseMagnitude()` (the default), `ModeSingularValue()`,
            `KnownFrequencies((...))` (MRMC), `ModalHankelValue()` (balanced modal truncation), or
            one of your own.
        unstable: modes on or beyond the stability boundary are an error ("refuse"), ranked like
            the others as they are ("keep"), or first moved onto `radius` along their angle
            ("move", discrete time).
        radius: for "move", inside the unit circle.
        x0: as for `modal_table`.

    Returns:
        The reduced model, its initial state, and the table of modes.

    Raises:
        ValueError: an order outside 1 … nx or below the size of every mode, unstable modes that
            are refused, "move" in continuous time or onto a radius outside (0, 1), a rank without
            the record it needs; else as for `modal_table`.

    Source: 002, section 3.1 (and 3.2 for moving unstable modes).

    Example:
        >>> import numpy as np
        >>> from lpvid.models import StateSpace
        >>> from lpvid.reduce import ModalHankelValue, modal_truncation
        >>> model = StateSpace(np.diag([0.9, 0.5]), [[1.0], [0.1]], [[1.0, 0.1]], dt=0.1)
        >>> reduced = modal_truncation(model, 1, rank=ModalHankelValue())
        >>> reduced.model.A, round(reduced.bound.item(), 4)
        (Array([[0.9]], dtype=float64), 0.0267)
    """
    if not 1 <= order <= model.nx:
        raise ValueError(f"order is {order}; keep between 1 and the model's {model.nx} states.")
    if unstable not in ("refuse", "keep", "move"):
        raise ValueError(f'unstable={unstable!r} is unknown: give "refuse", "keep" or "move".')
    rank = ModalResponseMagnitude() if rank is None else rank
    table = modal_table(model, data, x0=x0)
    beyond = np.asarray(table.unstable)
    if beyond.any() and unstable == "refuse":
        poles = ", ".join(f"{pole:.6g}" for pole in np.asarray(table.poles)[beyond])
        raise ValueError(
            f"unstable: the model has poles on or beyond the stability boundary ({poles}). Keep "
            'them with unstable="keep", or bring them inside with unstable="move".'
        )
    if beyond.any() and unstable == "move":
        moved = _moved(table, beyond, radius)
        table = modal_table(moved, data, x0=table.x0)
    kept = _chosen(np.asarray(rank.scores(table), float), table.sizes, order)
    states = np.repeat(kept, table.sizes)
    A, B, C, D = (np.asarray(getattr(table.model, name)) for name in "ABCD")
    lost = np.asarray(table.hankel_values)[~kept]
    return ModalReduction(
        model=StateSpace(A[np.ix_(states, states)], B[states], C[:, states], D, dt=model.dt),
        x0=jnp.asarray(np.asarray(table.x0)[:, states]),
        table=table,
        kept=jnp.asarray(kept),
        bound=jnp.asarray(2.0 * float(np.sum(lost))),
        status=table.status,
    )


def _moved(table: ModalTable, beyond: np.ndarray, radius: float) -> StateSpace:
    model = table.model
    if not model.is_discrete:
        raise ValueError(
            'unstable="move" puts poles at a radius in the z-plane: discretise the model first.'
        )
    if not 0.0 < radius < 1.0:
        raise ValueError(f"radius={radius}: give one inside the unit circle, such as 0.9999.")
    # A block times a positive number keeps its angle.
    factors = np.ones(beyond.size)
    factors[beyond] = radius / np.abs(np.asarray(table.poles)[beyond])
    scale = np.repeat(factors, table.sizes)
    return StateSpace(np.asarray(model.A) * scale[:, None], model.B, model.C, model.D, dt=model.dt)


def _chosen(scores: np.ndarray, sizes: tuple[int, ...], order: int) -> np.ndarray:
    if np.any(np.isnan(scores)):
        raise ValueError("rank: its scores are not numbers; look for an unstable mode that grew.")
    kept = np.zeros(len(sizes), bool)
    left = order
    for i in np.argsort(-scores, kind="stable"):
        if sizes[i] <= left:
            kept[i] = True
            left -= sizes[i]
    if not kept.any():
        raise ValueError(
            f"order is {order}, but every mode is a complex pair: ask for two or more."
        )
    return kept
