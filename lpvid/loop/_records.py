"""Records as the predictor takes them: joined, with nodes of the scheduling, and padded."""

import jax.numpy as jnp
import numpy as np

from lpvid.data import IOData
from lpvid.effects import MEMORY
from lpvid.loop._program import SLOTS, Records, history_of

_NODES = 7
"""Scheduling nodes of a varying model; between them the matrices are interpolated linearly."""


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
            f"The records have {kappa.shape[1]} scheduling signals: close_the_loop takes one. "
            "Choose it with data.select, or give each operating point its own call."
        )
    low, high = kappa.min(), kappa.max()
    if high - low < 1e-9 * max(abs(low), abs(high), 1.0):
        return kappa[:1]
    return np.linspace(low, high, _NODES)[:, None]


def _weights(kappa: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    # Linear interpolation over equally spaced nodes; outside of them the end segment is extended.
    if nodes.shape[0] == 1:
        return np.ones((kappa.shape[0], 1))
    place = (kappa[:, 0] - nodes[0, 0]) / (nodes[1, 0] - nodes[0, 0])
    left = np.clip(np.floor(place).astype(int), 0, nodes.shape[0] - 2)
    share = place - left
    weights = np.zeros((kappa.shape[0], nodes.shape[0]))
    rows = np.arange(kappa.shape[0])
    weights[rows, left], weights[rows, left + 1] = 1.0 - share, share
    return weights


def schedule_names(data: IOData) -> tuple[str, ...]:
    """What a varying parameter may follow: the scheduling signal, if any, and time.

    Args:
        data: records.
    """
    return (*data.scheduling_names, "time")


def records_of(
    data: IOData, nodes: np.ndarray, duration: float, start_time: float, length: int | None = None
) -> Records:
    """Records for the predictor.

    Args:
        data: one or several records.
        nodes: of the scheduling (node, nk).
        duration: s that the schedule "time" goes from −1 to 1 in.
        start_time: s at which every record starts.
        length: samples to pad to, so that several records share one compiled program.
    """
    u, y = np.asarray(data.u), np.asarray(data.y)
    lengths = np.asarray(data.lengths)
    record = np.repeat(np.arange(lengths.size), lengths)
    first = np.zeros(u.shape[0])
    first[np.concatenate([[0], np.cumsum(lengths)[:-1]])] = 1.0
    time = start_time + data.dt * np.concatenate([np.arange(n) for n in lengths])
    kappa = np.zeros((u.shape[0], 0)) if data.kappa is None else np.asarray(data.kappa)
    weights = _weights(kappa, nodes)
    follow = 2.0 * time[:, None] / duration - 1.0
    if kappa.shape[1]:
        middle = 0.5 * (nodes[0] + nodes[-1])
        half = max(float(0.5 * (nodes[-1] - nodes[0])[0]), 1e-12)
        follow = np.concatenate([(kappa - middle) / half, follow], axis=1)
    counts = np.ones(u.shape[0])
    spare = 0 if length is None else length - u.shape[0]

    def padded(array):
        # Repeats of the last sample keep the padding finite; it counts for nothing.
        return np.concatenate([array, np.repeat(array[-1:], spare, axis=0)]) if spare else array

    u, y, time, weights, follow, record = map(padded, (u, y, time, weights, follow, record))
    first = np.concatenate([first, np.zeros(spare)])
    counts = np.concatenate([counts, np.zeros(spare)])
    return Records(
        u=jnp.asarray(u),
        y=jnp.asarray(y),
        history=history_of(jnp.asarray(u), jnp.asarray(first)),
        time=jnp.asarray(time),
        kappa_nodes=jnp.asarray(nodes),
        weights=jnp.asarray(weights),
        schedules=jnp.asarray(follow),
        record=jnp.asarray(record),
        first=jnp.asarray(first),
        counts=jnp.asarray(counts),
        memory=jnp.zeros((lengths.size, SLOTS, MEMORY)),
    )
