"""The stages of one restructuring, each compiled on its own."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from lpvid._results import Status
from lpvid.analysis import HinfNorm
from lpvid.models import AbstractStructure
from lpvid.restructure._bundle import descend_nonsmooth
from lpvid.restructure._certificate import Certificate, certify
from lpvid.restructure._matching import (
    Target,
    error_norm,
    is_stable,
    largest_gain,
    match_from_starts,
    response_error,
    weighted_response,
)
from lpvid.restructure._method import HinfMatching
from lpvid.restructure._minima import tally
from lpvid.restructure._restructured import Restructured
from lpvid.restructure._surrogate import refine_smooth

# Two ways to one norm agree to this share.
_SLACK = 1e-6


def run_stages(
    target: Target,
    structure: AbstractStructure,
    search: AbstractStructure,
    scattered: Array | None,
    given: Array | None,
    method: HinfMatching,
    stable: bool,
) -> Restructured:
    """All stages from the starts on, scattered in `search` and given in `structure`."""
    # Compiled piece by piece: each piece then serves every number and kind of starts, and the
    # norm, dear to compile, is compiled once for all its callers.
    candidates, told = [], None
    if scattered is not None and search is structure:
        candidates.append(scattered)
    elif scattered is not None:
        found = _match(search, scattered, target, method.match_steps, False)
        told = _tally(search, found, target)
        # Two, as many as a point has neighbours: one compilation serves both kinds of start.
        best = found.value[jnp.argsort(found.cost)[:2]]
        candidates.append(jax.vmap(structure.from_search)(best))
    if given is not None:
        candidates.append(given)
    starts = jnp.concatenate(candidates)
    matched = _match(structure, starts, target, method.match_steps, stable)
    # Hits are counted where the search was made: the polished point is one more trial.
    told = _tally(structure, matched, target) if told is None else told
    # An earlier result is a minimum of the norm, which least squares leaves: the best start counts.
    best = [*matched.value[jnp.argsort(matched.cost)[:2]], _closest(structure, starts, target)]
    parameters, norm, peak = _lowest_norm(structure, best, target, stable)
    history = [norm]
    for _ in range(method.passes):
        descent = _descend(structure, parameters, target, peak[None], method)
        moved = error_norm(structure, descent.value, target)
        ahead = jnp.isfinite(moved.value) & (moved.value < norm)
        if stable:
            ahead = ahead & is_stable(structure, descent.value)
        parameters = jnp.where(ahead, descent.value, parameters)
        # The peak is kept in any case: it is what the last grid lacked.
        norm, peak = jnp.where(ahead, moved.value, norm), moved.frequency
        history.append(norm)
    certificate = None
    if method.bundle_steps > 0:
        descent, certificate = _bundle(structure, parameters, target, method, stable)
        reached = error_norm(structure, descent.value, target).value
        # Peaks mean nothing where numbers overflow; a point that the norm refuses is left.
        sound = (reached <= norm * (1.0 + _SLACK)) | ~jnp.isfinite(norm)
        parameters = jnp.where(sound, descent.value, parameters)
        history.append(jnp.where(sound, reached, norm))
        certificate = replace(
            certificate,
            distance=jnp.where(sound, certificate.distance, jnp.inf),
            certified=certificate.certified & sound,
        )
    final = error_norm(structure, parameters, target)
    forbidden = ~is_stable(structure, parameters) if stable else jnp.asarray(False)
    return Restructured(
        structure=structure,
        parameters=parameters,
        error_norm=final.value,
        peak_frequency=final.frequency,
        match_costs=told.costs,
        hits=told.hits,
        margin=told.margin,
        history=jnp.stack(history),
        status=_outcome(final, target, certificate, forbidden),
        minima=told.minima,
        certificate=certificate,
    )


def _lowest_norm(structure, best: list[Array], target, stable):
    """The best one by the norm: least squares may miss a spike."""
    norms = [error_norm(structure, parameters, target) for parameters in best]
    values = jnp.stack([norm.value for norm in norms])
    if stable:
        allowed = jnp.stack([is_stable(structure, parameters) for parameters in best])
        values = jnp.where(allowed, values, jnp.inf)
    peaks = jnp.stack([norm.frequency for norm in norms])
    winner = jnp.argmin(jnp.where(jnp.isfinite(values), values, jnp.inf))
    return jnp.stack(best)[winner], values[winner], peaks[winner]


def _outcome(
    final: HinfNorm, target: Target, certificate: Certificate | None, forbidden: Array
) -> Status:
    """The norm's own status, unless the zero model would have done as well.

    `forbidden` says that a stable model was asked for and none was found.
    """
    size = largest_gain(weighted_response(target))
    poor = (final.value >= 0.999 * size) & (size > 0.0) & jnp.isfinite(final.value)
    status = final.status
    if certificate is not None:
        told = (status != Status.successful) | certificate.certified
        status = Status.where(told, status, Status.uncertified)
    status = Status.where(poor, Status.poor_match, status)
    status = Status.where(forbidden, Status.unstable, status)
    known = jnp.isfinite(final.value) | (final.status == Status.infinite_norm)
    return Status.where(known, status, Status.nonfinite)


@eqx.filter_jit
def _match(structure, starts, target, max_steps, stable):
    return match_from_starts(structure, starts, target, max_steps, stable)


@eqx.filter_jit
def _closest(structure, starts, target):
    """The start of the least gain on the grid, within the bounds."""
    lower, upper = structure.bounds()
    starts = jnp.clip(starts, lower[None], upper[None])
    gains = jax.vmap(lambda p: largest_gain(response_error(structure, p, target)))(starts)
    return starts[jnp.argmin(jnp.where(jnp.isfinite(gains), gains, jnp.inf))]


_tally = eqx.filter_jit(tally)


@eqx.filter_jit
def _descend(structure, start, target, peaks, method):
    return refine_smooth(
        structure,
        start,
        target,
        peaks,
        log2_powers=method.log2_powers,
        steps=method.descent_steps,
    )


@eqx.filter_jit
def _bundle(structure, start, target, method, stable):
    descent = descend_nonsmooth(
        structure,
        start,
        target,
        steps=method.bundle_steps,
        tolerance=method.tolerance,
        stable=stable,
    )
    return descent, certify(structure, descent, target, method.tolerance)
