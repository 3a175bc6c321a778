"""Faults of data and settings, named with their remedy."""

from collections.abc import Callable, Sequence

import numpy as np

from lpvid.data import IOData
from lpvid.identify._engine import STILL
from lpvid.identify._factor import RANK_TOLERANCE, Layout, Route
from lpvid.identify._gram import hankel_factor
from lpvid.identify._methods import AbstractSubspaceMethod

_LARGEST_DEFAULT = 15
# Output samples for each parameter of a model below which a fit is little more than a guess.
_SAMPLES_A_PARAMETER = 10
# From an input and the layout of its rows to their triangular factor.
InputFactor = Callable[[int, Layout], np.ndarray]
# Samples by which most channels have moved.
_FIRST_LOOK = 64


def make_layout(method: AbstractSubspaceMethod, data: IOData, lengths: tuple[int, ...]) -> Layout:
    """Rows of the data matrix: the method's, or a default that the records can carry.

    Args:
        method: its instruments, order and block rows.
        data: its channels.
        lengths: samples in each record.

    Raises:
        ValueError: too few samples, naming how many are needed; an order that the block rows cannot
            carry.
    """
    nu, ny = data.nu, data.ny
    order = method.order if isinstance(method.order, int) else None
    least = 2 if order is None else -(-order // ny) + 1

    def layout(block_rows: int) -> Layout:
        return Layout(block_rows, nu, ny, method.past_inputs, method.past_outputs)

    if method.block_rows is not None:
        if method.block_rows < least:
            raise ValueError(
                f"block_rows={method.block_rows} carries at most "
                f"{(method.block_rows - 1) * ny} states with {ny} outputs, fewer than order="
                f"{order}: raise block_rows to {least} or more, or lower the order."
            )
        require_samples(layout(method.block_rows), lengths)
        return layout(method.block_rows)
    wanted = _LARGEST_DEFAULT if order is None else max(10, 2 * order)
    chosen = max(least, 2)
    require_samples(layout(chosen), lengths)
    # Twice as many columns as rows, so that the projection averages over something.
    while chosen < wanted and _is_wide(layout(chosen + 1), lengths):
        chosen += 1
    return layout(chosen)


def _is_wide(layout: Layout, lengths: tuple[int, ...]) -> bool:
    return layout.columns(lengths) >= 4 * layout.block_rows * (layout.nu + layout.ny)


def require_samples(layout: Layout, lengths: tuple[int, ...]) -> None:
    """Look whether the records are long enough.

    Raises:
        ValueError: naming the record, and how many samples are needed.
    """
    shortest = min(lengths)
    block_rows, nu, ny = layout[:3]
    if shortest < layout.n_lags:
        raise ValueError(
            f"Record {lengths.index(shortest)} has {shortest} samples, but block_rows={block_rows} "
            f"needs at least {layout.n_lags} in every record: drop the record or lower block_rows."
        )
    needed = layout.n_lags * (nu + ny) + len(lengths) * (layout.n_lags - 1)
    if sum(lengths) < needed:
        raise ValueError(
            f"The data have {sum(lengths)} samples, but block_rows={block_rows} with {nu} inputs, "
            f"{ny} outputs and {len(lengths)} records needs at least {needed} (and ten times as "
            f"many to average noise): take more samples or lower block_rows."
        )


def few_samples(order: int, nu: int, ny: int, samples: int) -> str | None:
    """A warning where there are too few samples for the parameters of a model, else `None`."""
    parameters = order * (nu + ny) + nu * ny
    needed = -(-_SAMPLES_A_PARAMETER * parameters // ny)
    if samples >= needed:
        return None
    return (
        f"{samples} samples are few for order={order} with {nu} inputs and {ny} outputs "
        f"({parameters} parameters): expect a poor model. Take {needed} samples or more, or lower "
        f"the order."
    )


def check_varying(data: IOData, still: np.ndarray | None = None) -> None:
    """Look for a channel that never moves.

    Args:
        data: channels, and their samples.
        still: which channels do not move, inputs then outputs, where it is known.

    Raises:
        ValueError: naming the first one found.
    """
    if still is None:
        still = _still(np.asarray(data.u), np.asarray(data.y))
    names = [*data.input_names, *data.output_names]
    for channel in np.flatnonzero(still):
        kind, remedy = (
            ("Input", "excite it, or leave it out with data.select(inputs=...)")
            if channel < data.nu
            else ("Output", "check the sensor, or leave it out with data.select(outputs=...)")
        )
        raise ValueError(
            f"{kind} {names[channel]!r} is constant, so nothing can be learned from it: {remedy}."
        )


def _still(*signals: np.ndarray) -> np.ndarray:
    """Which channels do not move. Most do within their first samples: the rest is not looked at."""
    short = constant_channels(*_ends([signal[:_FIRST_LOOK] for signal in signals]), 2 * STILL)
    # At twice the tolerance: should the level beyond double, the channel has moved by that much.
    if not np.any(short):
        return short
    return constant_channels(*_ends(signals))


def _ends(signals: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    low = np.concatenate([signal.min(axis=0) for signal in signals])
    return low, np.concatenate([signal.max(axis=0) for signal in signals])


def constant_channels(low: np.ndarray, high: np.ndarray, tolerance: float = STILL) -> np.ndarray:
    """Which channels do not move, from their least and largest samples."""
    return high - low <= tolerance * np.maximum(np.abs(high), np.abs(low))


def above_rank(order: int, singular_values: np.ndarray, rounding: float) -> str | None:
    """A warning where an order reaches singular values that are rounding, else `None`."""
    if not singular_values[order - 1] <= rounding * singular_values[0]:
        return None
    rank = int(np.sum(singular_values > rounding * singular_values[0]))
    return (
        f"order={order} is above the numerical rank of the data ({rank}): the states beyond it are "
        f"rounding noise. Use order={rank}, or data that excite more modes."
    )


def describe_excitation(names: Sequence[str], layout: Layout, factor: InputFactor) -> str:
    """Which input excites too little for these block rows, and what to do.

    Args:
        names: of the inputs.
        layout: of the data matrix.
        factor: of the rows of some of the inputs.
    """
    wanted = layout.input_rows // layout.nu
    block_rows = layout.block_rows
    for channel, name in enumerate(names):
        rank = int(np.sum(_pivots(factor, channel, layout) > RANK_TOLERANCE["qr"]))
        if rank < wanted:
            return (
                f"Input {name!r} excites {rank} of the {wanted} directions that block_rows="
                f"{block_rows} asks for ({wanted // block_rows} a row): use a richer input (PRBS, "
                f"noise, more sine lines), or block_rows={max(rank * block_rows // wanted, 2)} or "
                f"fewer."
            )
    return (
        f"The inputs {', '.join(names)} each move enough but not independently of one "
        f"another (rank below {wanted * layout.nu}): excite them by independent signals, or leave "
        f"one out with data.select(inputs=...)."
    )


def weak_excitation(names: Sequence[str], layout: Layout, factor: InputFactor, pivot: float) -> str:
    """Which input only just excites enough, and what to do: as for `describe_excitation`."""
    alone = [float(np.min(_pivots(factor, k, layout))) for k in range(len(names))]
    worst = int(np.argmin(alone))
    advice = "widen its spectrum (PRBS, noise, faster steps), sample more slowly, or lower "
    start = f"Input {names[worst]!r} hardly excites"
    if alone[worst] > 1e3 * pivot:
        start = f"The inputs {', '.join(names)} hardly move independently"
        advice = "excite them by independent signals, or lower "
    return (
        f"{start}: the weakest of the directions that block_rows={layout.block_rows} asks for has "
        f"a share of {pivot:.1e} of the power (reciprocal condition of the inputs). The model is "
        f"sensitive to noise: {advice}block_rows."
    )


def input_factor(data: IOData, channel: int, layout: Layout, constant: bool) -> np.ndarray:
    """Lower triangle of the rows of `layout`, which are those of one input."""
    signal = data.u[:, channel : channel + 1]
    if constant:
        signal = signal - signal.mean(axis=0, keepdims=True)
    return np.asarray(hankel_factor(signal, data.lengths, layout.rows(), constant=constant))


def _pivots(factor: InputFactor, channel: int, layout: Layout) -> np.ndarray:
    """Share of every row of an input that the rows before it leave."""
    # In the order of the data matrix: a sample between known ones is foretold best.
    found = factor(channel, layout._replace(nu=1, ny=0, past_outputs=False))
    power = np.maximum(np.sum(found**2, axis=1), np.finfo(float).tiny)
    return np.diagonal(found) ** 2 / power


def largest_order(block_rows: int, ny: int) -> int:
    """Largest order that a rule considers: half the rows, so that a noise floor is seen."""
    return max(min((block_rows - 1) * ny, block_rows * ny // 2), 1)


def negligible(route: Route) -> float:
    """Share of the largest singular value below which one is rounding."""
    return 1e-6 if route == "gram" else 1e-11
