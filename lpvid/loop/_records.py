"""Records as the predictor takes them: joined, with nodes of the scheduling, and padded."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from lpvid.data import IOData
from lpvid.effects import HISTORY, MEMORY
from lpvid.loop._program import SLOTS, Records

HOLDS = ("zero", "linear")
"""What inputs may do between samples: stay, or run straight to the next one."""

_NODES = 7
"""Scheduling nodes of a varying model: Chebyshev's, through which the matrices' polynomial goes."""


def scheduling_nodes(data: IOData) -> np.ndarray:
    """Nodes (node, nk) that the records' scheduling is spread over; one empty node without any.

    Args:
        data: records.
    """
    if data.kappa is None:
        return np.zeros((1, 0))
    kappa = np.asarray(data.kappa)
    if kappa.shape[1] != 1:
        raise ValueError(
            f"The records have {kappa.shape[1]} scheduling signals: close_the_loop takes one. Give "
            "one (data.select, or one column for --schedule), or each operating point its own call."
        )
    low, high = kappa.min(), kappa.max()
    if high - low < 1e-9 * max(abs(low), abs(high), 1.0):
        return kappa[:1]
    places = -np.cos(_angles(_NODES))
    return (0.5 * (low + high) + 0.5 * (high - low) * places)[:, None]


def _angles(count: int) -> np.ndarray:
    return np.pi * (np.arange(count) + 0.5) / count


def _range(nodes: np.ndarray) -> tuple[float, float]:
    """Middle and half width of the scheduling that the nodes were laid over."""
    middle = 0.5 * float(nodes[0, 0] + nodes[-1, 0])
    return middle, 0.5 * float(nodes[-1, 0] - nodes[0, 0]) / np.cos(_angles(len(nodes))[0])


def _weights(kappa: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Weights of the nodes (time, node) by barycentric interpolation; the ends are held."""
    if nodes.shape[0] == 1:
        return np.ones((kappa.shape[0], 1))
    middle, half = _range(nodes)
    at = np.clip((kappa[:, 0] - middle) / half, -1.0, 1.0)
    angles = _angles(len(nodes))
    away = at[:, None] + np.cos(angles)[None]
    on_node = np.abs(away) < 1e-13
    weights = (-1.0) ** np.arange(len(nodes)) * np.sin(angles) / np.where(on_node, 1.0, away)
    hit = np.any(on_node, axis=1, keepdims=True)
    weights = np.where(hit, on_node.astype(float), weights)
    return weights / weights.sum(axis=1, keepdims=True)


def schedule_names(data: IOData) -> tuple[str, ...]:
    """What a varying parameter may follow: the scheduling signal, if any, and time.

    Args:
        data: records.
    """
    return (*data.scheduling_names, "time")


def records_of(
    data: IOData,
    nodes: np.ndarray,
    duration: float,
    start_times: Sequence[float] | None = None,
    length: int | None = None,
    *,
    hold: str = "zero",
) -> Records:
    """Records for the predictor.

    Args:
        data: one or several records.
        nodes: of the scheduling (node, nk).
        duration: s that the schedule "time" goes from −1 to 1 in.
        start_times: s at which each record starts; zero if `None`.
        length: samples to pad to, so that several records share one compiled program.
        hold: what the inputs do between samples, "zero" or "linear".
    """
    u, y = np.asarray(data.u), np.asarray(data.y)
    lengths = np.asarray(data.lengths)
    record = np.repeat(np.arange(lengths.size), lengths)
    first = np.zeros(u.shape[0])
    first[np.concatenate([[0], np.cumsum(lengths)[:-1]])] = 1.0
    begins = np.zeros(lengths.size) if start_times is None else np.asarray(start_times, float)
    steps = [data.dt * np.arange(n) for n in lengths]
    time = np.concatenate([begin + step for begin, step in zip(begins, steps, strict=True)])
    kappa = np.zeros((u.shape[0], 0)) if data.kappa is None else np.asarray(data.kappa)
    weights = _weights(kappa, nodes)
    follow = 2.0 * time[:, None] / duration - 1.0
    if kappa.shape[1]:
        middle, half = _range(nodes) if len(nodes) > 1 else (float(nodes[0, 0]), 1e-12)
        follow = np.concatenate([(kappa - middle) / max(half, 1e-12), follow], axis=1)
    # Beyond what it was laid over, a schedule is held at its end.
    follow = np.clip(follow, -1.0, 1.0)
    counts = np.ones(u.shape[0])
    change = np.zeros_like(u)
    if hold == "linear":
        # A record's last sample has no next one, and is held.
        change[:-1] = np.where(first[1:, None] > 0.0, 0.0, np.diff(u, axis=0))
    spare = 0 if length is None else length - u.shape[0]

    def padded(array):
        # Repeats of the last sample keep the padding finite; it counts for nothing.
        return np.concatenate([array, np.repeat(array[-1:], spare, axis=0)]) if spare else array

    u, y, time, weights, follow, record = map(padded, (u, y, time, weights, follow, record))
    first = np.concatenate([first, np.zeros(spare)])
    counts = np.concatenate([counts, np.zeros(spare)])
    change = np.concatenate([change, np.zeros((spare, change.shape[1]))])
    return Records(
        u=jnp.asarray(u),
        change=jnp.asarray(change),
        y=jnp.asarray(y),
        history=_history(jnp.asarray(u), jnp.asarray(first)),
        time=jnp.asarray(time),
        kappa_nodes=jnp.asarray(nodes),
        weights=jnp.asarray(weights),
        schedules=jnp.asarray(follow),
        record=jnp.asarray(record),
        first=jnp.asarray(first),
        counts=jnp.asarray(counts),
        memory=jnp.zeros((lengths.size, SLOTS, MEMORY)),
    )


def _history(u: Float[Array, "time nu"], first: Float[Array, " time"]) -> Float[Array, "..."]:
    """The inputs' last samples, the present one first, the first sample held before a start."""
    place = jnp.arange(u.shape[0])
    begin = lax.cummax(jnp.where(first > 0.0, place, 0))
    lags = jnp.arange(HISTORY)
    return u[jnp.maximum(place[:, None] - lags[None, :], begin[:, None])]
