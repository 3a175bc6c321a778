"""Statistics over the runs of a study."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import ArrayLike

# Half width of a 95 % interval of a normal variable, in standard deviations.
_NORMAL_95 = 1.959963984540054


class Summary(eqx.Module):
    """Statistics over the runs that succeeded; arrays of shape (*point, *quantity).

    `str` gives a plain table; `rows` the same as dictionaries, which is what a data frame or a
    JSON file is made of.

    Attributes:
        success: share of the runs that succeeded, from 0 to 1, shape (*point,).
        mean: mean over the runs, NaN where none succeeded (all others alike).
        std: standard deviation over the runs.
        median: median over the runs.
        low: 5 % quantile.
        high: 95 % quantile.
        names: of the quantity's entries, in C order.
        rms: root mean square of the error, where the truth is given.
        ratio: `rms` over the bound, where that is given too: 1 is an efficient estimator.
        coverage: share of the runs whose 95 % interval (1.96 standard deviations) holds the truth,
            where the estimated deviations are given.
    """

    success: np.ndarray
    mean: np.ndarray
    std: np.ndarray
    median: np.ndarray
    low: np.ndarray
    high: np.ndarray
    names: tuple[str, ...] = eqx.field(static=True)
    rms: np.ndarray | None = None
    ratio: np.ndarray | None = None
    coverage: np.ndarray | None = None

    def rows(self) -> list[dict[str, Any]]:
        """One dictionary for each point and entry: point (an index), name and statistics.

        `pandas.DataFrame(summary.rows())` makes a table of them.

        Example:
            >>> summarise(np.array([1.0, 2.0, 3.0])).rows()[0]["median"]
            2.0
        """
        columns = {
            name: np.asarray(values).reshape(self.success.size, -1)
            for name in _STATISTICS
            if (values := getattr(self, name)) is not None
        }
        shares = self.success.reshape(-1)
        rows = []
        for point, share in enumerate(shares):
            place = {"point": point} if self.success.ndim else {}
            for k, name in enumerate(self.names):
                figures = {label: float(values[point, k]) for label, values in columns.items()}
                rows.append({**place, "name": name, "success": float(share), **figures})
        return rows

    def __str__(self) -> str:
        rows = self.rows()
        cells = [list(rows[0])] + [
            [v if isinstance(v, str) else f"{v:.4g}" for v in row.values()] for row in rows
        ]
        widths = [max(len(line[k]) for line in cells) for k in range(len(cells[0]))]
        return "\n".join(
            "  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True))
            for line in cells
        )


_STATISTICS = ("mean", "std", "median", "low", "high", "rms", "ratio", "coverage")


def summarise(
    samples: ArrayLike | Sequence,
    *,
    kept: ArrayLike | Sequence | None = None,
    deviation: ArrayLike | Sequence | None = None,
    truth: ArrayLike | Sequence | None = None,
    bound: ArrayLike | Sequence | None = None,
    names: Sequence[str] | None = None,
) -> Summary:
    """Statistics over the runs of one quantity.

    Args:
        samples: shape (run, *quantity), or (point, run, *quantity) as `kept` says.
        kept: which runs count, shape (run,) or (point, run); all finite ones of a single point by
            default.
        deviation: estimated standard deviation of each sample, of the samples' shape.
        truth: shape (*quantity,) or (point, *quantity).
        bound: smallest possible standard deviation, such as the Cramér–Rao bound's; same shape.
        names: of the quantity's entries, in C order.

    Returns:
        Statistics over the runs, the quantity's entries and the points kept apart.

    Raises:
        ValueError: shapes do not fit, or a bound or deviations are given without the truth.

    Example:
        >>> estimates = np.array([0.9, 1.1, np.nan])
        >>> summary = summarise(estimates, truth=1.0, bound=0.1)
        >>> round(float(summary.ratio), 6), round(float(summary.success), 2)
        (1.0, 0.67)
    """
    if np.iscomplexobj(samples):
        raise ValueError("samples: complex; summarise real and imaginary parts, or size and angle.")
    values = np.asarray(samples, float)
    if values.ndim == 0:
        raise ValueError("samples: an axis of runs is needed, got a single number.")
    if kept is None:
        kept = np.all(np.isfinite(values).reshape(values.shape[0], -1), axis=1)
    mask = np.asarray(kept, bool)
    if mask.ndim not in (1, 2) or values.shape[: mask.ndim] != mask.shape:
        raise ValueError(
            f"samples: their leading axes must be those of kept, (run,) or (point, run); got "
            f"{values.shape} and {mask.shape}."
        )
    if truth is None and (bound is not None or deviation is not None):
        raise ValueError("truth: a bound or deviations say nothing without it; give it too.")
    place, quantity = mask.shape[:-1], values.shape[mask.ndim :]
    if 0 in quantity:
        raise ValueError(f"samples: a quantity of no entries, shape {quantity}, has no summary.")
    labels = _names(names, quantity)
    shape = (*place, *quantity)
    true = None if truth is None else _fitting("truth", truth, shape)
    smallest = None if bound is None else _fitting("bound", bound, shape)
    spread = None if deviation is None else _fitting("deviation", deviation, values.shape)

    found = []
    for point in np.ndindex(place):
        of_point = [None if each is None else each[point] for each in (true, smallest, spread)]
        found.append(_statistics(values[point], mask[point], *of_point))
    columns = {name: np.stack([each[name] for each in found]).reshape(shape) for name in found[0]}
    return Summary(success=np.asarray(np.mean(mask, axis=-1)), names=labels, **columns)


def _statistics(samples, mask, truth, bound, deviation) -> dict[str, ArrayLike]:
    """Statistics by name of the samples of one point, shape (run, *quantity)."""
    chosen = samples[mask]
    if not len(chosen):
        # No run succeeded: NaN, as from one run of NaN.
        chosen = np.full((1, *samples.shape[1:]), np.nan)
    low, median, high = np.quantile(chosen, (0.05, 0.5, 0.95), axis=0)
    figures = {
        "mean": np.mean(chosen, axis=0),
        "std": np.std(chosen, axis=0),
        "median": median,
        "low": low,
        "high": high,
    }
    if truth is not None:
        figures["rms"] = np.sqrt(np.mean((chosen - truth) ** 2, axis=0))
        if bound is not None:
            figures["ratio"] = figures["rms"] / bound
        if deviation is not None:
            held = np.abs(samples - truth) <= _NORMAL_95 * deviation
            figures["coverage"] = np.mean(held[mask], axis=0) if mask.any() else figures["mean"]
    return figures


def _fitting(name: str, numbers: ArrayLike | Sequence, shape: tuple[int, ...]) -> np.ndarray:
    array = np.asarray(numbers, float)
    try:
        return np.broadcast_to(array, shape)
    except ValueError:
        raise ValueError(
            f"{name}: numbers of shape {shape} (leading axes may be left out) are needed, got "
            f"{array.shape}."
        ) from None


def _names(names: Sequence[str] | None, quantity: tuple[int, ...]) -> tuple[str, ...]:
    count = int(np.prod(quantity))
    if names is None:
        labels = [",".join(str(k) for k in index) for index in np.ndindex(quantity)]
        return tuple(f"[{label}]" if label else "value" for label in labels)
    if len(names) != count:
        raise ValueError(f"names: {count} are needed, one for each entry, got {len(names)}.")
    return tuple(names)
