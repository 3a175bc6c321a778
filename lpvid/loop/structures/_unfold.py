"""Outputs of sensors that cannot tell the sign: the signal behind them, up to a sign."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from lpvid.data import IOData

_LAGS = 4
_PASSES = 20
_PRICE = 3.0
"""Of a change of sign, in variances of the prediction error."""

_BELOW = 0.15
"""Share of the root mean square that noise may take a folded signal below zero by."""

_CLEAR = 50.0
"""Gain in log-likelihood, less the logarithm of the samples for each change of sign, from which a
signal counts as folded: noise about zero gains by signs of its own choice, too, but little by
each."""


def unfolded(data: IOData) -> tuple[IOData, tuple[int, ...]]:
    """Records with folded outputs, y = |z|, straightened to z, and the indices of these outputs.

    An output counts as folded where it comes down to zero, hardly goes below, and a linear model
    predicts it far better with signs given to its samples than as it is. The signs start from
    straight extrapolation; then those that a linear model predicts best, of all there are, and the
    model are taken in turns.

    Source: the search over signs is that of A. Viterbi (IEEE Trans. Inf. Theory 13 (1967) 260–269).

    Args:
        data: records; returned as they are where nothing is folded.
    """
    y = np.asarray(data.y)
    outputs = []
    for number in range(data.ny):
        straight = _straight(np.asarray(data.u), y[:, number], data.lengths)
        if straight is not None:
            if not outputs:
                y = y.copy()
            y[:, number] = straight
            outputs.append(number)
    if not outputs:
        return data, ()
    return eqx.tree_at(lambda tree: tree.y, data, jnp.asarray(y)), tuple(outputs)


def _straight(u: np.ndarray, y: np.ndarray, lengths: tuple[int, ...]) -> np.ndarray | None:
    size = np.sqrt(np.mean(y**2))
    if size == 0.0 or np.quantile(y, 0.002) < -_BELOW * size or np.quantile(y, 0.05) > 0.5 * size:
        return None
    if min(lengths) < 10 * _LAGS:
        return None
    ends = np.cumsum(lengths)[:-1]
    pieces = list(zip(np.split(u, ends), np.split(y, ends), strict=True))
    _, as_it_is = _model(y, pieces)
    z = np.concatenate([_extrapolated(own) for _, own in pieces])
    coefficients, least = _model(z, pieces)
    for _ in range(_PASSES):
        price = _PRICE * least
        other = np.concatenate([_best_signs(own, u, coefficients, price) for u, own in pieces])
        fresh, error = _model(other, pieces)
        if error >= least:
            break
        z, coefficients, least = other, fresh, error
    gain = 0.5 * y.size * np.log(as_it_is / max(least, 1e-300))
    turned = np.where(z == y, 1.0, -1.0)
    gain -= np.log(y.size) * np.sum(np.diff(turned) != 0.0)
    return z if gain > _CLEAR else None


Pieces = list[tuple[np.ndarray, np.ndarray]]
"""Inputs (time, nu) and folded output (time,) of each record."""


def _split(z: np.ndarray, pieces: Pieces) -> list[np.ndarray]:
    return np.split(z, np.cumsum([len(y) for _, y in pieces])[:-1])


def _model(z: np.ndarray, pieces: Pieces) -> tuple[np.ndarray, float]:
    """Coefficients of z on its past, the inputs and one, and the mean squared error."""
    own = _split(z, pieces)
    design = np.concatenate(
        [
            np.concatenate([_lagged(part[:, None], 1), _driving(u)], axis=1)
            for part, (u, _) in zip(own, pieces, strict=True)
        ]
    )
    target = np.concatenate([part[_LAGS:] for part in own])
    coefficients = np.linalg.lstsq(design, target, rcond=None)[0]
    return coefficients, float(np.mean((target - design @ coefficients) ** 2))


def _best_signs(y: np.ndarray, u: np.ndarray, coefficients: np.ndarray, price: float) -> np.ndarray:
    """The samples with the signs of the least squared error, and a price for each change."""
    # A state is the signs of the last samples, the latest in the lowest bit.
    states = np.arange(2**_LAGS)
    past = 1.0 - 2.0 * ((states[:, None] >> np.arange(_LAGS)[None]) & 1)
    driven = _driving(u) @ coefficients[_LAGS:]
    earlier = np.stack([states >> 1, (states >> 1) | 2 ** (_LAGS - 1)])
    sign = past[:, 0]
    change = price * (past[:, 0] != past[:, 1])
    cost = np.zeros(states.size)
    came = np.empty((len(y) - _LAGS, states.size), int)
    for k in range(_LAGS, len(y)):
        # Most recent first, as the coefficients are.
        ahead = past @ (coefficients[:_LAGS] * y[k - _LAGS : k][::-1]) + driven[k - _LAGS]
        total = cost[earlier] + change[None] + (sign[None] * y[k] - ahead[earlier]) ** 2
        better = np.argmin(total, axis=0)
        came[k - _LAGS] = earlier[better, states]
        cost = total[better, states]
    state = int(np.argmin(cost))
    signs = np.empty(len(y))
    for k in range(len(y) - 1, _LAGS - 1, -1):
        signs[k] = sign[state]
        state = came[k - _LAGS, state]
    signs[:_LAGS] = past[state, ::-1]
    return signs * y


def _driving(u: np.ndarray) -> np.ndarray:
    return np.concatenate([_lagged(u, 0), np.ones((len(u) - _LAGS, 1))], axis=1)


def _lagged(signal: np.ndarray, first: int) -> np.ndarray:
    """Samples from `first` to `_LAGS` back (time, lag · channel)."""
    count = len(signal)
    return np.concatenate(
        [signal[_LAGS - lag : count - lag] for lag in range(first, _LAGS + 1)], axis=1
    )


def _extrapolated(y: np.ndarray) -> np.ndarray:
    """Signs by which each sample lies next to the straight line through the last two."""
    z = y.copy()
    for k in range(2, len(y)):
        ahead = 2.0 * z[k - 1] - z[k - 2]
        z[k] = np.copysign(y[k], ahead) if abs(ahead) > 0.0 else y[k]
    return z
