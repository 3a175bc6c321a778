"""The score test of many candidates at once, the noise model profiled for each.

For a candidate with sensitivities S_c, the innovations e are regressed on [S_θ, S_c] under noise
that is autoregressive, its coefficients estimated together with the regression for each candidate
apart: whitening beforehand would delete what acts at low frequency. Everything comes from the
lagged products of [e, S_θ, S_c], so no candidate ever passes over the record again.
"""

from typing import NamedTuple

import numpy as np
import scipy.stats

from lpvid.loop._compare import whitener

_ORDER = 4
_ROUNDS = 4
_RANK = 1e-10


class Scored(NamedTuple):
    """One candidate's outcome.

    Attributes:
        gain: in log-likelihood over the model without it.
        amplitude: estimate (column,).
        p_value: of the likelihood ratio, for this test alone.
    """

    gain: float
    amplitude: np.ndarray
    p_value: float


def _least_squares(gram: np.ndarray, product: np.ndarray) -> np.ndarray:
    """Minimal solution of gram x = product, both scaled to a unit diagonal first; 0 on overflow."""
    if not np.all(np.isfinite(gram)):
        return np.zeros_like(product)
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    values, vectors = np.linalg.eigh(gram / scale[:, None] / scale[None, :])
    inverse = np.where(
        values > _RANK * max(values[-1], 1e-300), 1.0 / np.where(values > 0, values, 1), 0.0
    )
    return (vectors @ (inverse * (vectors.T @ (product / scale)))) / scale


class ScoreTest:
    """Lagged products of a round, from which each candidate's gain follows.

    Attributes:
        base_gain: log-likelihood of the model as it stands, parameters moved at first order.
    """

    def __init__(self, errors: np.ndarray, base: np.ndarray, order: int = _ORDER):
        """Prepare for innovations and the sensitivities of what is in the model already.

        Args:
            errors: innovations (time, ny).
            base: their derivatives by parameters, initial states and effects (time, ny, column).
            order: of the autoregression.
        """
        self.order = order
        self.samples, self.outputs, self.base_columns = base.shape
        # Outputs are decorrelated first, so that each has its own autoregression.
        self.white = whitener(errors)
        stacked = np.concatenate([errors[:, :, None], base], axis=2)
        self.known = self._lagged(np.einsum("nyc,yz->nzc", stacked, self.white))
        self.known_products = [known.T @ known for known in self.known]
        self.base_gain, _ = self._profile([(p, self.base_columns) for p in self.known_products])

    def _lagged(self, signals: np.ndarray) -> list[np.ndarray]:
        """For each output, (time, lag · column), the lags slowest."""
        p, n = self.order, self.samples
        return [
            np.concatenate([signals[p - lag : n - lag, z] for lag in range(p + 1)], axis=1)
            for z in range(self.outputs)
        ]

    def _profile(self, blocks: list[tuple[np.ndarray, int]]) -> tuple[float, np.ndarray]:
        """Likelihood and coefficients for [e, X], X shared by all outputs."""
        columns = blocks[0][1]
        products = [
            product.reshape(self.order + 1, columns + 1, self.order + 1, columns + 1)
            for product, _ in blocks
        ]
        filters = [np.eye(1, self.order + 1)[0] for _ in products]
        coefficients = np.zeros(columns)
        variances = np.ones(len(products))
        used = self.samples - self.order
        for _ in range(_ROUNDS):
            gram, target = np.zeros((columns, columns)), np.zeros(columns)
            for product, taps, variance in zip(products, filters, variances, strict=True):
                filtered = np.tensordot(taps, product, 1)
                filtered = np.tensordot(filtered, taps, axes=(1, 0)) / variance
                gram += filtered[1:, 1:]
                target += filtered[1:, 0]
            coefficients = -_least_squares(gram, target) if columns else coefficients
            residual = np.concatenate([[1.0], coefficients])
            for z, product in enumerate(products):
                lags = np.tensordot(residual, product @ residual, axes=(0, 1))
                size = lags[0, 0] / used
                ridge = 1e-9 * np.trace(lags) * np.eye(self.order)
                taps = np.concatenate([[1.0], -np.linalg.solve(lags[1:, 1:] + ridge, lags[1:, 0])])
                filters[z] = taps
                variances[z] = max(taps @ lags @ taps / used, 1e-14 * size, 1e-300)
        return float(-0.5 * used * np.sum(np.log(variances))), coefficients

    def score(self, columns: np.ndarray, positive: np.ndarray) -> Scored:
        """Gain of a candidate, zero where it is nothing new or has the wrong sign.

        Args:
            columns: derivatives of the innovations by its amplitudes (time, ny, column).
            positive: whether an amplitude can only be positive (column,).
        """
        wanted = columns.shape[2]
        nothing = Scored(0.0, np.zeros(wanted), 1.0)
        if not np.all(np.isfinite(columns)):
            return nothing
        blocks = []
        size = self.base_columns + 1
        whitened = np.einsum("nyc,yz->nzc", columns, self.white)
        norms = np.sqrt(np.sum(whitened**2, axis=(0, 1)))
        if np.any(norms <= 0.0):
            return nothing
        new = self._lagged(whitened / norms)
        total, lags = size + wanted, self.order + 1
        for known, product, fresh in zip(self.known, self.known_products, new, strict=True):
            joint = np.empty((lags, total, lags, total))
            joint[:, :size, :, :size] = product.reshape(lags, size, lags, size)
            cross = (known.T @ fresh).reshape(lags, size, lags, wanted)
            joint[:, :size, :, size:] = cross
            joint[:, size:, :, :size] = cross.transpose(2, 3, 0, 1)
            joint[:, size:, :, size:] = (fresh.T @ fresh).reshape(lags, wanted, lags, wanted)
            blocks.append((joint.reshape(lags * total, lags * total), total - 1))
        reached, coefficients = self._profile(blocks)
        amplitude = coefficients[self.base_columns :] / norms
        gain = max(reached - self.base_gain, 0.0)
        if np.any(positive & (amplitude <= 0.0)):
            return nothing
        return Scored(gain, amplitude, float(scipy.stats.chi2.sf(2.0 * gain, wanted)))

    def projected(self, columns: np.ndarray) -> np.ndarray:
        """Columns, outputs decorrelated, with what the model can already explain taken out.

        Args:
            columns: (time, ny, column).
        """
        base = np.concatenate([known[:, 1 : self.base_columns + 1] for known in self.known])
        fresh = np.einsum("nyc,yz->nzc", columns, self.white)[self.order :]
        fresh = np.concatenate([fresh[:, z] for z in range(self.outputs)])
        basis, values, _ = np.linalg.svd(
            base / np.maximum(np.linalg.norm(base, axis=0), 1e-300), full_matrices=False
        )
        basis = basis[:, values > 1e-8 * values[0]]
        return fresh - basis @ (basis.T @ fresh)


def family_wise(p_value: float, tests: int) -> float:
    """Probability that the least of several tests is as small as this by chance (Šidák).

    Args:
        p_value: the least of them.
        tests: how many were made.
    """
    if p_value >= 1.0:
        return 1.0
    return float(-np.expm1(tests * np.log1p(-p_value)))
