"""Faults of data and settings, named with their remedy."""

import numpy as np

from lpvid.data import IOData
from lpvid.identify._factor import Route, hankel_rows
from lpvid.identify._gram import hankel_factor
from lpvid.identify._methods import AbstractSubspaceMethod

_LARGEST_DEFAULT = 15


def resolve_block_rows(method: AbstractSubspaceMethod, data: IOData) -> int:
    """Block rows to use: the method's, or a default that the records can carry.

    Raises:
        ValueError: too few samples, naming how many are needed; an order that the block rows cannot
            carry.
    """
    nu, ny, lengths = data.nu, data.ny, data.lengths
    order = method.order
    least = 2 if order == "auto" else -(-order // ny) + 1
    if method.block_rows is not None:
        if method.block_rows < least:
            raise ValueError(
                f"block_rows={method.block_rows} carries at most "
                f"{(method.block_rows - 1) * ny} states with {ny} outputs, fewer than order="
                f"{order}: raise block_rows to {least} or more, or lower the order."
            )
        _require_samples(method.block_rows, nu, ny, lengths)
        return method.block_rows
    wanted = _LARGEST_DEFAULT if order == "auto" else max(10, 2 * order)
    chosen = max(least, 2)
    _require_samples(chosen, nu, ny, lengths)
    # Twice as many columns as rows, so that the projection averages over something.
    while chosen < wanted and _columns(chosen + 1, lengths) >= 4 * (chosen + 1) * (nu + ny):
        chosen += 1
    return chosen


def _columns(block_rows: int, lengths: tuple[int, ...]) -> int:
    if min(lengths) < 2 * block_rows:
        return 0
    return sum(n - 2 * block_rows + 1 for n in lengths)


def _require_samples(block_rows: int, nu: int, ny: int, lengths: tuple[int, ...]) -> None:
    shortest = min(lengths)
    if shortest < 2 * block_rows:
        raise ValueError(
            f"Record {lengths.index(shortest)} has {shortest} samples, but block_rows={block_rows} "
            f"needs at least {2 * block_rows} in every record: drop the record or lower block_rows."
        )
    rows = 2 * block_rows * (nu + ny)
    needed = rows + len(lengths) * (2 * block_rows - 1)
    if sum(lengths) < needed:
        raise ValueError(
            f"The data have {sum(lengths)} samples, but block_rows={block_rows} with {nu} inputs, "
            f"{ny} outputs and {len(lengths)} records needs at least {needed} (and ten times as "
            f"many to average noise): take more samples or lower block_rows."
        )


def check_varying(data: IOData) -> None:
    """Look for a channel that never moves.

    Raises:
        ValueError: naming the first one found.
    """
    for values, names, kind in (
        (data.u, data.input_names, "Input"),
        (data.y, data.output_names, "Output"),
    ):
        array = np.asarray(values)
        still = np.ptp(array, axis=0) <= 1e-12 * np.abs(array).max(axis=0)
        for channel in np.flatnonzero(still):
            remedy = (
                "excite it, or leave it out with data.select(inputs=...)"
                if kind == "Input"
                else "check the sensor, or leave it out with data.select(outputs=...)"
            )
            raise ValueError(
                f"{kind} {names[channel]!r} is constant, so nothing can be learned from it: "
                f"{remedy}."
            )


def describe_excitation(data: IOData, block_rows: int) -> str:
    """Which input excites too little for these block rows, and what to do."""
    wanted = 2 * block_rows
    for channel, name in enumerate(data.input_names):
        rank = _rank(data.u[:, channel : channel + 1], data.lengths, block_rows, 1)
        if rank < wanted:
            return (
                f"Input {name!r} excites {rank} of the {wanted} directions that block_rows="
                f"{block_rows} asks for (2 block_rows): use a richer input (PRBS, noise, more "
                f"sine lines), or block_rows={max(rank // 2, 2)} or fewer."
            )
    return (
        f"The inputs {', '.join(data.input_names)} each move enough but not independently of one "
        f"another (rank below {wanted * data.nu}): excite them by independent signals, or leave "
        f"one out with data.select(inputs=...)."
    )


def _rank(signal, lengths, block_rows, nu):
    rows = hankel_rows(block_rows, nu, 0, past_outputs=False)
    factor = np.asarray(hankel_factor(signal, lengths, rows))
    power = np.maximum(np.sum(factor**2, axis=1), np.finfo(float).tiny)
    return int(np.sum(np.diagonal(factor) ** 2 / power > 1e-20))


def largest_order(block_rows: int, ny: int) -> int:
    """Largest order that `"auto"` considers: half the rows, so that a noise floor is seen."""
    return max(min((block_rows - 1) * ny, block_rows * ny // 2), 1)


def negligible(route: Route) -> float:
    """Share of the largest singular value below which one is rounding."""
    return 1e-6 if route == "gram" else 1e-11
