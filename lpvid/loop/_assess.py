"""Errors of a model with its effects on held-out data, and how sure its numbers are."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.signal

from lpvid.analysis import bft
from lpvid.data import IOData
from lpvid.loop._compare import whitener, window
from lpvid.loop._program import Records
from lpvid.loop._result import Errors
from lpvid.loop._search import run
from lpvid.loop._tune import Fitted, with_starts

_SEGMENTS = 64
"""Starts that the error over the horizon is averaged over, at most."""

_HIGH = 0.6
"""Share of the Nyquist frequency above which a residual counts as noise."""


def _rms(errors: np.ndarray) -> np.ndarray:
    return np.sqrt(np.mean(errors**2, axis=0))


def default_horizon(data: IOData) -> int:
    """A twentieth of the shortest record, 5 to 200 samples.

    Args:
        data: held-out records.
    """
    return int(np.clip(min(data.lengths) // 20, 5, 200))


def free_run(fitted: Fitted, records: Records) -> np.ndarray:
    """Simulated outputs (time, ny) from initial states fitted to the records.

    Args:
        fitted: the model.
        records: held-out data.
    """
    none = jnp.zeros_like(fitted.gain)
    unknowns = with_starts(fitted, records, none)
    out = run(fitted.setting, records, fitted.slots, unknowns, none)
    count = int(np.sum(np.asarray(records.counts)))
    return np.asarray(records.y - out.innovations)[:count]


def ladder(fitted: Fitted, records: Records, horizon: int) -> np.ndarray:
    """Root mean square error 1 … horizon samples ahead (horizon, ny).

    Each start is the predictor's state on its way over the records.

    Args:
        fitted: the model.
        records: held-out data.
        horizon: samples.
    """
    trace = run(fitted.setting, records, fitted.slots, with_starts(fitted, records), fitted.gain)
    count = int(np.sum(np.asarray(records.counts)))
    record = np.asarray(records.record)[:count]
    # The predictor has settled after a horizon; a segment stays within its record.
    latest = count - horizon
    begins = np.unique(np.linspace(min(horizon, latest // 2), latest, _SEGMENTS).astype(int))
    begins = begins[record[begins] == record[np.minimum(begins + horizon - 1, count - 1)]]
    begins = begins[np.arange(_SEGMENTS) % begins.size]
    rows = (begins[:, None] + np.arange(horizon)[None, :]).ravel()
    states, memory = np.asarray(trace.before)[begins], np.asarray(trace.memory)[begins]
    first = np.zeros(rows.size)
    first[::horizon] = 1.0

    def picked(leaf):
        return jnp.asarray(np.asarray(leaf)[rows])

    segments = Records(
        u=picked(records.u),
        change=picked(records.change),
        y=picked(records.y),
        history=picked(records.history),
        time=picked(records.time),
        kappa_nodes=records.kappa_nodes,
        weights=picked(records.weights),
        schedules=picked(records.schedules),
        record=jnp.asarray(np.repeat(np.arange(_SEGMENTS), horizon)),
        first=jnp.asarray(first),
        counts=jnp.ones(rows.size),
        memory=jnp.asarray(memory),
    )
    unknowns = eqx.tree_at(lambda tree: tree.start, fitted.unknowns, jnp.asarray(states))
    out = run(fitted.setting, segments, fitted.slots, unknowns, jnp.zeros_like(fitted.gain))
    errors = np.asarray(out.innovations).reshape(_SEGMENTS, horizon, -1)
    return np.sqrt(np.mean(errors**2, axis=0))


def errors_of(
    fitted: Fitted, records: Records, one_step: np.ndarray, horizon: int
) -> tuple[Errors, np.ndarray, np.ndarray]:
    """Errors on held-out data, the ladder over the horizon, and the simulated outputs.

    Args:
        fitted: the model.
        records: held-out data.
        one_step: one-step errors there (time, ny).
        horizon: samples.
    """
    steps = ladder(fitted, records, horizon)
    simulated = free_run(fitted, records)
    y = np.asarray(records.y)[: simulated.shape[0]]
    with np.errstate(all="ignore"):
        fit = np.asarray(bft(y, simulated))
    errors = Errors(_rms(one_step), _rms(steps), _rms(y - simulated), fit)
    return errors, steps, simulated


def noise_in(residual: np.ndarray) -> np.ndarray:
    """Noise (ny,) from the top of a residual's spectrum, where a model's faults hardly reach.

    Args:
        residual: (time, ny).
    """
    frequency, density = scipy.signal.welch(
        residual, axis=0, nperseg=min(256, residual.shape[0]), detrend="constant"
    )
    high = density[frequency > 0.5 * _HIGH]
    # White noise of variance σ² has the one-sided density 2 σ² at one sample a second.
    return np.sqrt(0.5 * np.mean(high, axis=0))


def robust_covariance(fitted: Fitted) -> np.ndarray:
    """Covariance of the free unknowns, robust to autocorrelated errors (the sandwich formula).

    Args:
        fitted: the model.
    """
    errors, columns = fitted.searched.errors, fitted.searched.columns
    samples = errors.shape[0]
    white = whitener(errors)
    rows = np.einsum("ny,yz->nz", errors, white)
    design = np.einsum("nyc,yz->nzc", columns, white)
    gram = np.einsum("nzc,nzd->cd", design, design, optimize=True)
    if not np.all(np.isfinite(gram)):
        return np.full_like(gram, np.inf)
    score = np.einsum("nz,nzc->nc", rows, design)
    meat = score.T @ score
    lags = window(samples)
    for lag in range(1, lags + 1):
        product = score[lag:].T @ score[:-lag]
        meat += (1.0 - lag / (lags + 1.0)) * (product + product.T)
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    values, vectors = np.linalg.eigh(gram / scale[:, None] / scale[None, :])
    kept = values > 1e-12 * values[-1]
    inverse = np.where(kept, 1.0 / np.where(kept, values, 1.0), 0.0)
    bread = (vectors * inverse) @ vectors.T / scale[:, None] / scale[None, :]
    result = bread @ meat @ bread
    # What the records say nothing about has no finite variance.
    lost = np.sum(vectors[:, ~kept] ** 2, axis=1) > 1e-6
    result[lost, lost] = np.inf
    return result


def standard_errors(covariance: np.ndarray) -> np.ndarray:
    """Square roots of the variances, infinite where there is none.

    Args:
        covariance: of the unknowns.
    """
    diagonal = np.diag(covariance)
    return np.where(np.isfinite(diagonal), np.sqrt(np.maximum(diagonal, 0.0)), np.inf)
