"""Fitting a model with its effects: innovations by least squares, diffusion by likelihood."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from lpvid.effects import AbsoluteValueSensor, Scales
from lpvid.loop._candidates import Place, slots_of
from lpvid.loop._gain import gains
from lpvid.loop._path import AMPLITUDES
from lpvid.loop._program import SHAPES, SLOTS, Records, Setting, Slots, Unknowns
from lpvid.loop._search import Searched, errors_of, log_likelihood, search

RATIOS = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0, 1e4)
"""Diffusions tried, relative to the outputs' noise. None at all would let errors of the parameters
add up without end on other data."""

_WORTH = 0.5
"""Least gain in log-likelihood for which diffusion and parameters take another turn."""


class Fitted(NamedTuple):
    """A model with its effects, fitted.

    Attributes:
        setting: structure, laws, sample time.
        places: where each effect sits.
        scales: sizes of the signals at each effect's port.
        slots: the same as arrays.
        unknowns: everything estimated.
        gain: L at the nodes of κ.
        ratio: diffusion.
        noise: standard deviation of the outputs' noise that the gain was made for (ny,).
        searched: errors, derivatives, likelihood.
        ratios: diffusions that refits may choose from.
    """

    setting: Setting
    places: tuple[Place, ...]
    scales: tuple[Scales, ...]
    slots: Slots
    unknowns: Unknowns
    gain: Array
    ratio: float
    noise: np.ndarray
    searched: Searched
    ratios: tuple[float, ...] = RATIOS


_gains = eqx.filter_jit(gains)


def rough_noise(y: np.ndarray) -> np.ndarray:
    """Noise of the outputs (ny,) from their fourth differences, which smooth motion hardly has.

    Args:
        y: (time, ny).
    """
    difference = np.diff(y, n=4, axis=0)
    # The binomial coefficients' squares sum to 70.
    spread = np.median(np.abs(difference), axis=0) / 0.6745 / np.sqrt(70.0)
    return np.maximum(spread, 1e-9 * np.maximum(np.std(y, axis=0), 1e-300))


def empty_unknowns(theta: np.ndarray, states: int, records: int, directions: int) -> Unknowns:
    """Unknowns of a model without effects, at rest.

    Args:
        theta: parameters (parameter,).
        states: of the model.
        records: how many.
        directions: of a force.
    """
    return Unknowns(
        theta=jnp.asarray(theta, float),
        amplitude=jnp.zeros((SLOTS, AMPLITUDES, directions)),
        shape=jnp.zeros((SLOTS, SHAPES)),
        start=jnp.zeros((records, states)),
    )


def start_places(unknowns: Unknowns) -> np.ndarray:
    """Places of the initial states in the flattened unknowns.

    Args:
        unknowns: whose layout it is.
    """
    size = unknowns.start.size
    before = unknowns.theta.size + unknowns.amplitude.size + unknowns.shape.size
    return np.arange(before, before + size)


def free_unknowns(
    setting: Setting, places: Sequence[Place], scales: Sequence[Scales], unknowns: Unknowns
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What is estimated: places in the flattened unknowns, least and greatest values.

    Args:
        setting: structure and laws.
        places: of the effects.
        scales: at their ports.
        unknowns: whose layout it is.
    """
    lower, upper = (list(map(float, bound)) for bound in setting.structure.bounds())
    where = list(range(unknowns.theta.size))
    directions = unknowns.amplitude.shape[2]
    offset = unknowns.theta.size
    shape_offset = offset + unknowns.amplitude.size
    for slot, (place, scale) in enumerate(zip(places, scales, strict=True)):
        law = setting.laws[place.law]
        along = directions if place.port == "force" else 1
        if not law.whole:
            for number, amplitude in enumerate(law.amplitudes):
                for direction in range(along):
                    where.append(offset + (slot * AMPLITUDES + number) * directions + direction)
                    signed = amplitude.positive and along == 1 and not place.modulated
                    lower.append(0.0 if signed else -np.inf)
                    upper.append(np.inf)
        least, greatest = law.bounds(scale) if law.shapes else (np.zeros(0), np.zeros(0))
        for number in range(len(law.shapes)):
            where.append(shape_offset + slot * SHAPES + number)
            lower.append(float(least[number]))
            upper.append(float(greatest[number]))
    starts = start_places(unknowns)
    where += list(starts)
    lower += [-np.inf] * starts.size
    upper += [np.inf] * starts.size
    return np.asarray(where), np.asarray(lower), np.asarray(upper)


def varying(setting: Setting, places: Sequence[Place]) -> Setting:
    """The setting, told whether a parameter varies.

    Args:
        setting: structure, laws, sample time.
        places: of the effects.
    """
    wanted = any(place.port == "parameter" for place in places)
    return dataclasses.replace(setting, varying=wanted)


def fit(
    setting: Setting,
    records: Records,
    places: Sequence[Place],
    scales: Sequence[Scales],
    unknowns: Unknowns,
    noise: np.ndarray,
    *,
    ratio: float = RATIOS[-2],
    ratios: tuple[float, ...] = RATIOS,
    gain: Array | None = None,
    cycles: int = 8,
    steps: int = 12,
) -> Fitted:
    """Parameters, effects and initial states by likelihood, the diffusion by likelihood too.

    Args:
        setting: structure, laws, sample time.
        records: estimation data.
        places: of the effects.
        scales: at their ports.
        unknowns: where to start.
        noise: standard deviation of the outputs' noise (ny,).
        ratio: diffusion to start with.
        ratios: those to choose from.
        gain: that the first cycle keeps, so that a larger model never starts behind a smaller
            one; worked out from the parameters if `None`.
        cycles: how often diffusion and parameters take turns at most.
        steps: of each search.
    """
    setting = varying(setting, places)
    slots = slots_of(setting.structure, places, records.schedules.shape[1])
    where, lower, upper = free_unknowns(setting, places, scales, unknowns)
    spread = jnp.asarray(noise)

    def gain_of(values, level):
        return _gains(setting, records, values.theta, spread, jnp.asarray(float(level)))

    def choose(values, near):
        at = ratios.index(near)
        # Far off, the optimum is worth a look only when a neighbour is better.
        neighbours = ratios[max(at - 2, 0) : at + 2]
        scored = []
        for level in neighbours:
            gain = gain_of(values, level)
            scored.append(log_likelihood(errors_of(setting, records, slots, values, gain)))
        return neighbours[int(np.argmax(scored))]

    best: tuple[Searched, Array, float] | None = None
    for cycle in range(cycles):
        if gain is None or cycle:
            gain = gain_of(unknowns, ratio)
        found = search(setting, records, slots, unknowns, gain, where, lower, upper, steps=steps)
        reached = -np.inf if best is None else best[0].log_likelihood
        if best is None or found.log_likelihood > reached:
            best = found, gain, ratio
        following = choose(found.unknowns, ratio) if len(ratios) > 1 else ratio
        settled = following == ratio and found.converged
        if settled or found.log_likelihood < reached + _WORTH:
            break
        unknowns, ratio = found.unknowns, following
    assert best is not None
    found, gain, ratio = best
    return Fitted(
        setting=setting,
        places=tuple(places),
        scales=tuple(scales),
        slots=slots,
        unknowns=found.unknowns,
        gain=gain,
        ratio=ratio,
        noise=noise,
        searched=found,
        ratios=ratios,
    )


def refit(fitted: Fitted, records: Records, ratio: float, ratios: tuple[float, ...]) -> Fitted:
    """The same model fitted again with other diffusions to choose from.

    Args:
        fitted: the model.
        records: estimation data.
        ratio: diffusion to start with.
        ratios: those to choose from.
    """
    return fit(
        fitted.setting,
        records,
        fitted.places,
        fitted.scales,
        fitted.unknowns,
        fitted.noise,
        ratio=ratio,
        ratios=ratios,
    )


def simulation_fit(fitted: Fitted, records: Records) -> Fitted:
    """The same model fitted again by its error in simulation; the gain is worked out anew after.

    Args:
        fitted: the model, with initial states of the records.
        records: estimation data.
    """
    setting, places, scales, slots, unknowns = fitted[:5]
    where, lower, upper = free_unknowns(setting, places, scales, unknowns)
    none = jnp.zeros_like(fitted.gain)
    found = search(setting, records, slots, unknowns, none, where, lower, upper)
    theta, noise = found.unknowns.theta, jnp.asarray(fitted.noise)
    gain = _gains(setting, records, theta, noise, jnp.asarray(float(fitted.ratio)))
    return fitted._replace(unknowns=found.unknowns, gain=gain, searched=found)


def with_starts(fitted: Fitted, records: Records, gain: Array | None = None) -> Unknowns:
    """The fitted unknowns with initial states fitted to other records.

    Args:
        fitted: the model.
        records: as many as it was fitted to.
        gain: L; the model's own if `None`.
    """
    first, *others = [
        _started(fitted, records, starts, gain) for starts in _rough_starts(fitted, records)
    ]
    if not others:
        return first.unknowns
    # Each record starts by the sign that suits it.
    starts, sizes = np.array(first.unknowns.start), _sizes(first, records)
    for other in others:
        better = _sizes(other, records) < sizes
        starts[better] = np.asarray(other.unknowns.start)[better]
        sizes = np.minimum(sizes, _sizes(other, records))
    return eqx.tree_at(lambda tree: tree.start, first.unknowns, jnp.asarray(starts))


def _started(fitted: Fitted, records: Records, starts: Array, gain: Array | None) -> Searched:
    unknowns = eqx.tree_at(lambda tree: tree.start, fitted.unknowns, starts)
    places = start_places(unknowns)
    free = np.full(places.size, np.inf)
    return search(
        fitted.setting,
        records,
        fitted.slots,
        unknowns,
        fitted.gain if gain is None else gain,
        places,
        -free,
        free,
        steps=5,
        tolerance=0.1,
    )


def _sizes(found: Searched, records: Records) -> np.ndarray:
    """Sum of the squared errors of each record, infinite where they are not finite."""
    record = np.asarray(records.record)[: found.errors.shape[0]]
    spread = np.maximum(np.std(np.asarray(records.y), axis=0), 1e-300)
    with np.errstate(all="ignore"):
        squares = np.sum((found.errors / spread) ** 2, axis=1)
    sizes = np.bincount(record, squares, minlength=records.memory.shape[0])
    return np.where(np.isfinite(sizes), sizes, np.inf)


def _rough_starts(fitted: Fitted, records: Records) -> list[Array]:
    """Initial states (record, state): the outputs as measured, the rest at rest.

    One for each sign that an output whose sensor folds it may have.
    """
    C = fitted.setting.structure.ports(fitted.unknowns.theta, records.kappa_nodes[0]).C
    first = np.asarray(records.y)[np.asarray(records.first) > 0.0]
    signs = [np.ones(first.shape[1])]
    for place in fitted.places:
        if isinstance(fitted.setting.laws[place.law], AbsoluteValueSensor):
            turned = np.where(np.arange(first.shape[1]) == place.where, -1.0, 1.0)
            signs += [one * turned for one in signs]
    return [jnp.asarray((first * one) @ np.linalg.pinv(np.asarray(C)).T) for one in signs]
