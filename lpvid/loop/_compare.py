"""Which of two models predicts other data better: a paired test robust to autocorrelation."""

import numpy as np
import scipy.stats

_SINGULAR = 1e-10
"""Share of the variances added to a covariance, so that it has an inverse."""


def window(samples: int) -> int:
    """Lags of the Bartlett window, growing with the cube root of the record.

    Args:
        samples: length of the record.
    """
    return max(int(2.0 * samples ** (1.0 / 3.0)), 4)


def long_run_variance(values: np.ndarray) -> float:
    """Variance of the mean times the number of samples, by Newey and West (1987).

    Args:
        values: one series (time,).
    """
    centred = values - values.mean()
    total = float(centred @ centred)
    lags = window(values.size)
    for lag in range(1, min(lags, values.size - 1) + 1):
        total += 2.0 * (1.0 - lag / (lags + 1.0)) * float(centred[lag:] @ centred[:-lag])
    return max(total / values.size, 1e-300)


def whitener(errors: np.ndarray) -> np.ndarray:
    """W for which errors W have unit covariance (ny, ny).

    Args:
        errors: (time, ny).
    """
    covariance = errors.T @ errors / errors.shape[0]
    # Two outputs that say the same leave it without an inverse.
    covariance = covariance + _SINGULAR * np.diag(np.diag(covariance))
    return np.linalg.inv(np.linalg.cholesky(covariance)).T


def sample_likelihood(errors: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Gaussian log-likelihood of each sample (time,).

    Args:
        errors: (time, ny).
        covariance: of the errors, from the estimation data (ny, ny).
    """
    factor = np.linalg.cholesky(covariance + _SINGULAR * np.diag(np.diag(covariance)))
    white = np.linalg.solve(factor, errors.T)
    return -0.5 * np.sum(white**2, axis=0) - float(np.sum(np.log(np.diag(factor))))


def better(first: np.ndarray, second: np.ndarray) -> tuple[float, float]:
    """Gain of the second model over the first, and the chance of it if they were equal.

    Args:
        first: log-likelihood of each held-out sample under one model (time,).
        second: the same under the other.

    Returns:
        Total gain, and the one-sided p-value of a normal test with a long-run variance.
    """
    difference = second - first
    if not np.all(np.isfinite(difference)):
        return (np.inf, 0.0) if np.all(np.isfinite(second)) else (-np.inf, 1.0)
    spread = np.sqrt(long_run_variance(difference) / difference.size)
    ratio = float(difference.mean() / spread) if spread > 0.0 else 0.0
    return float(difference.sum()), float(scipy.stats.norm.sf(ratio))
