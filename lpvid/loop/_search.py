"""Levenberg–Marquardt on the predictor's innovations, over any subset of the unknowns."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from lpvid.loop._compare import whitener
from lpvid.loop._program import (
    Feedback,
    Injection,
    Records,
    Setting,
    Slots,
    Trace,
    Unknowns,
    nothing_injected,
    trace,
)

COLUMNS = 24
"""Sensitivities are worked out in multiples of this, so that one program serves for all."""

_DAMPING, _LESS, _MORE, _MOST = 1e-4, 0.2, 8.0, 1e8
_RANK = 1e-12
_FURTHEST = 1.5
"""Longest step of the logarithm of a positive number."""


@eqx.filter_jit
def _errors_and_columns(
    setting: Setting,
    records: Records,
    slots: Slots,
    unknowns: Unknowns,
    gain: Float[Array, "node state ny"],
    directions: Float[Array, "column unknown"],
    injections: Injection,
) -> tuple[Float[Array, "time ny"], Float[Array, "column time ny"]]:
    """Innovations and their derivatives along directions of unknowns and injections at once."""
    flat, unravel = ravel_pytree(unknowns)
    nothing = nothing_injected(records, unknowns.start.shape[1])

    def errors(values, injection):
        out = trace(setting, records, slots, unravel(values), gain, injection)
        return out.innovations * records.counts[:, None]

    def column(direction, injection):
        return jax.jvp(errors, (flat, nothing), (direction, injection))

    return jax.vmap(column, out_axes=(None, 0))(directions, injections)


@eqx.filter_jit
def run(
    setting: Setting,
    records: Records,
    slots: Slots,
    unknowns: Unknowns,
    gain: Float[Array, "node state ny"],
    feedback: Feedback | None = None,
) -> Trace:
    """The predictor's trace; the compiled form of `trace` without injection.

    Args:
        setting: structure, laws, sample time.
        records: signals.
        slots: which effects.
        unknowns: their numbers and the model's.
        gain: L at the nodes of κ.
        feedback: a controller in place of the recorded inputs.
    """
    return trace(
        setting,
        records,
        slots,
        unknowns,
        gain,
        nothing_injected(records, unknowns.start.shape[1]),
        feedback,
    )


def injected(
    setting: Setting,
    records: Records,
    slots: Slots,
    unknowns: Unknowns,
    gain: Float[Array, "node state ny"],
    columns: Injection,
) -> np.ndarray:
    """Sensitivities of the innovations to signals added to state and output (column, time, ny).

    Args:
        setting: structure, laws, sample time.
        records: signals.
        slots: which effects are in already.
        unknowns: their numbers and the model's.
        gain: L at the nodes of κ.
        columns: injections, with a leading axis of `COLUMNS`.
    """
    size = ravel_pytree(unknowns)[0].size
    still = jnp.zeros((COLUMNS, size))
    return np.asarray(
        _errors_and_columns(setting, records, slots, unknowns, gain, still, columns)[1]
    )


def errors_of(
    setting: Setting,
    records: Records,
    slots: Slots,
    unknowns: Unknowns,
    gain: Float[Array, "node state ny"],
) -> np.ndarray:
    """Innovations (time, ny), padding left out.

    By the program that gives the sensitivities too: running it costs little beside compiling
    another one.

    Args:
        setting: structure, laws, sample time.
        records: signals.
        slots: which effects.
        unknowns: their numbers and the model's.
        gain: L at the nodes of κ.
    """
    return sensitivities(setting, records, slots, unknowns, gain, np.zeros(1, int))[0]


def sensitivities(
    setting: Setting,
    records: Records,
    slots: Slots,
    unknowns: Unknowns,
    gain: Float[Array, "node state ny"],
    places: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Innovations (time, ny) and their derivatives (time, ny, column), padding left out.

    Args:
        setting: structure, laws, sample time.
        records: signals.
        slots: which effects.
        unknowns: where to differentiate.
        gain: L at the nodes of κ.
        places: indices into the flattened unknowns (column,).
    """
    size = ravel_pytree(unknowns)[0].size
    length, states = records.u.shape[0], unknowns.start.shape[1]
    still = Injection(jnp.zeros((COLUMNS, length, states)), jnp.zeros((COLUMNS, *records.y.shape)))
    count = int(np.sum(np.asarray(records.counts)))
    parts, errors = [], None
    for begin in range(0, places.size, COLUMNS):
        wanted = places[begin : begin + COLUMNS]
        directions = np.zeros((COLUMNS, size))
        directions[np.arange(wanted.size), wanted] = 1.0
        errors, columns = _errors_and_columns(
            setting, records, slots, unknowns, gain, jnp.asarray(directions), still
        )
        parts.append(np.moveaxis(np.asarray(columns)[: wanted.size], 0, 2)[:count])
    return np.asarray(errors)[:count], np.concatenate(parts, axis=2)


class Searched(NamedTuple):
    """Outcome of a search.

    Attributes:
        unknowns: the best seen.
        errors: innovations there (time, ny).
        columns: their derivatives by the free unknowns (time, ny, column).
        places: the free unknowns, indices into the flattened ones.
        log_likelihood: concentrated over the innovations' covariance.
        converged: whether no further step was worth taking, or none was better.
    """

    unknowns: Unknowns
    errors: np.ndarray
    columns: np.ndarray
    places: np.ndarray
    log_likelihood: float
    converged: bool


def log_likelihood(errors: np.ndarray) -> float:
    """Gaussian, concentrated over the covariance; −∞ where the errors are not finite.

    Args:
        errors: (time, ny).
    """
    with np.errstate(all="ignore"):
        covariance = errors.T @ errors / errors.shape[0]
        sign, logarithm = np.linalg.slogdet(covariance)
    if not np.isfinite(logarithm) or sign <= 0.0:
        return -np.inf
    return float(-0.5 * errors.shape[0] * logarithm)


def _step(gram: np.ndarray, slope: np.ndarray, damping: float) -> np.ndarray:
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    values, vectors = np.linalg.eigh(gram / scale[:, None] / scale[None, :])
    inverse = np.where(values > _RANK * values[-1], 1.0 / (values + damping), 0.0)
    return -(vectors @ (inverse * (vectors.T @ (slope / scale)))) / scale


def _moved(
    point: np.ndarray, move: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A point moved, steps logarithmic where values are positive, and the step at first order."""
    positive = lower > 0.0
    size = np.where(positive, point, 1.0)
    share = np.clip(np.where(positive, move / size, 0.0), -_FURTHEST, _FURTHEST)
    wanted = np.where(positive, size * np.exp(share), point + move)
    moved = np.clip(wanted, lower, upper)
    taken = np.where(positive, size * share, move)
    cut = moved != wanted
    return moved, np.where(cut, moved - point, taken)


def search(
    setting: Setting,
    records: Records,
    slots: Slots,
    unknowns: Unknowns,
    gain: Float[Array, "node state ny"],
    places: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    *,
    steps: int = 20,
    tolerance: float = 3e-2,
) -> Searched:
    """Maximise the likelihood of the innovations over the unknowns at `places`.

    Args:
        setting: structure, laws, sample time.
        records: signals.
        slots: which effects.
        unknowns: where to start.
        gain: L at the nodes of κ, kept.
        places: indices into the flattened unknowns that are free.
        lower: least values (column,).
        upper: greatest values (column,).
        steps: trials at most.
        tolerance: least expected gain in log-likelihood worth another step.
    """
    flat, unravel = ravel_pytree(unknowns)
    # A copy that is written to: the views that JAX gives are read-only.
    best = np.array(flat)
    best[places] = np.clip(best[places], lower, upper)

    def evaluate(values):
        errors, columns = sensitivities(
            setting, records, slots, unravel(jnp.asarray(values)), gain, places
        )
        return errors, columns, log_likelihood(errors)

    errors, columns, reached = evaluate(best)
    damping, converged = _DAMPING, False
    for _ in range(steps):
        if not np.isfinite(reached):
            break
        white = whitener(errors)
        rows = np.einsum("ny,yz->nz", errors, white).reshape(-1)
        design = np.einsum("nyc,yz->nzc", columns, white).reshape(rows.size, -1)
        with np.errstate(all="ignore"):
            gram, slope = design.T @ design, design.T @ rows
        # Sensitivities that run away may overflow in their products only.
        if not (np.all(np.isfinite(gram)) and np.all(np.isfinite(slope))):
            break
        point = best[places]
        # What sits at a bound and would leave it does not take part in this step.
        free = ~(((point <= lower) & (slope > 0.0)) | ((point >= upper) & (slope < 0.0)))
        move = np.zeros(places.size)
        trial, got = best, None
        while damping <= _MOST:
            move[free] = _step(gram[np.ix_(free, free)], slope[free], damping)
            trial = best.copy()
            trial[places], taken = _moved(point, move, lower, upper)
            promised = -(slope @ taken + 0.5 * taken @ gram @ taken)
            if promised < tolerance and np.array_equal(taken, move):
                break
            if promised >= tolerance:
                found = evaluate(trial)
                if found[2] > reached:
                    damping, got = max(damping * _LESS, 1e-9), found
                    break
            # A step that bounds cut short points elsewhere: damping turns it along the slope.
            damping *= _MORE
        if got is None:
            converged = True
            break
        gained = got[2] - reached
        best, (errors, columns, reached) = trial, got
        if gained < tolerance:
            converged = True
            break
    return Searched(unravel(jnp.asarray(best)), errors, columns, places, reached, converged)
