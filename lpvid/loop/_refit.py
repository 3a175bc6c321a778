"""Refits: a model with a candidate in its next slot, or without one of its effects."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from lpvid.effects import AbstractLaw
from lpvid.loop._candidates import Place, Trial, slots_of
from lpvid.loop._columns import along, scales_of
from lpvid.loop._program import SLOTS, Records, Unknowns
from lpvid.loop._score import Scored
from lpvid.loop._search import errors_of
from lpvid.loop._tune import Fitted, fit, varying

_REALISED = 0.5
"""Share of the promised gain below which a refit counts as a failed search, not as evidence."""

_SURE = 50.0
"""A promise of more than this need not be kept in full: the test is one of small effects."""

_SHORTER = 0.1


class Ranked(NamedTuple):
    """One place with its best shape.

    Attributes:
        trial: place and shape.
        scored: gain, amplitudes, p-value.
        columns: sensitivities (time, ny, column).
        penalised: gain less the complexity penalty.
    """

    trial: Trial
    scored: Scored
    columns: np.ndarray
    penalised: float


def seated(unknowns: Unknowns, slot: int, entry: Ranked, whole: bool) -> Unknowns:
    """The unknowns with a candidate in a slot.

    Args:
        unknowns: the model's.
        slot: of the effect.
        entry: the candidate.
        whole: whether it replaces a signal, with an amplitude of one.
    """
    amplitude, shape = np.array(unknowns.amplitude), np.array(unknowns.shape)
    amplitude[slot], shape[slot] = 0.0, 0.0
    if whole:
        amplitude[slot, 0, 0] = 1.0
    else:
        directions = amplitude.shape[2] if entry.trial.place.port == "force" else 1
        values = entry.scored.amplitude.reshape(-1, directions)
        amplitude[slot, : values.shape[0], :directions] = values
    shape[slot, : entry.trial.shape.size] = entry.trial.shape
    return eqx.tree_at(
        lambda tree: (tree.amplitude, tree.shape),
        unknowns,
        (jnp.asarray(amplitude), jnp.asarray(shape)),
    )


def with_effect(fitted: Fitted, records: Records, entry: Ranked) -> Fitted:
    """The model refitted with a candidate in its next slot.

    Args:
        fitted: the model as it stands.
        records: estimation data.
        entry: the candidate.
    """
    law, place = fitted.setting.laws[entry.trial.place.law], entry.trial.place
    unknowns = seated(fitted.unknowns, len(fitted.places), entry, law.whole)
    if law.whole and law.shapes:
        unknowns = _best_start(fitted, records, entry, unknowns)
    model = _refitted(fitted, records, place, unknowns)
    if not law.whole and not kept(fitted, model, entry.scored.gain):
        # The score test's step is a long one where the model is far off: a shorter one.
        slot = len(fitted.places)
        shorter = unknowns.amplitude.at[slot].mul(_SHORTER)
        unknowns = eqx.tree_at(lambda tree: tree.amplitude, unknowns, shorter)
        again = _refitted(fitted, records, place, unknowns)
        model = max(model, again, key=lambda one: one.searched.log_likelihood)
    return model


@contextlib.contextmanager
def compiled(
    fitted: Fitted, records: Records, entries: Sequence[Ranked]
) -> Iterator[Callable[[Ranked], None]]:
    """Compile the programs of several refits in the background, while the first ones run.

    Gives a function that waits until a candidate's program is there.

    Args:
        fitted: the model as it stands.
        records: estimation data.
        entries: the candidates, in the order they will be wanted.
    """

    def prepare(place: Place) -> None:
        places = (*fitted.places, place)
        setting = varying(fitted.setting, places)
        slots = slots_of(setting.structure, places, records.schedules.shape[1])
        errors_of(setting, records, slots, fitted.unknowns, fitted.gain)

    with ThreadPoolExecutor(1) as pool:
        waiting = {entry.trial.place: pool.submit(prepare, entry.trial.place) for entry in entries}

        def ready(entry: Ranked) -> None:
            if entry.trial.place in waiting:
                waiting[entry.trial.place].result()

        try:
            yield ready
        finally:
            pool.shutdown(cancel_futures=True)


def kept(fitted: Fitted, refitted: Fitted, promised: float) -> bool:
    """Whether a refit gained its share of what the score test promised.

    Args:
        fitted: the model as it stood.
        refitted: the same with the effect.
        promised: gain in log-likelihood.
    """
    realised = refitted.searched.log_likelihood - fitted.searched.log_likelihood
    return realised >= _REALISED * min(promised, _SURE)


def _refitted(fitted: Fitted, records: Records, place: Place, unknowns: Unknowns) -> Fitted:
    law, model = fitted.setting.laws[place.law], fitted
    for _ in range(2):
        trace = along(model.setting, records, model.slots, model.unknowns, model.gain)
        scales = (*fitted.scales, scales_of(trace, place))
        model = fit(
            fitted.setting,
            records,
            (*fitted.places, place),
            scales,
            unknowns,
            fitted.noise,
            ratio=model.ratio,
            ratios=fitted.ratios,
            gain=model.gain,
        )
        if not _cramped(model, law):
            break
        # The better predictor sees its signals with less noise, which widens the bounds.
        unknowns = model.unknowns
    return model


def _best_start(fitted: Fitted, records: Records, entry: Ranked, unknowns: Unknowns) -> Unknowns:
    """Of several shapes of a law that replaces a signal, the one a few steps go furthest from.

    The model's parameters have made up for it as well as they could, so its likelihood has minima
    of its own: an amplitude of 2 at a delay of one sample means two samples or more.
    """
    slot, place = len(fitted.places), entry.trial.place
    trace = along(fitted.setting, records, fitted.slots, fitted.unknowns, fitted.gain)
    scales = (*fitted.scales, scales_of(trace, place))
    lower, upper = fitted.setting.laws[place.law].bounds(scales[-1])
    tried = []
    for factor in (0.5, 1.0, 2.0, 4.0, 8.0):
        shape = np.array(unknowns.shape)
        own = entry.trial.shape * factor
        shape[slot, : own.size] = np.clip(own, lower, upper)
        start = eqx.tree_at(lambda tree: tree.shape, unknowns, jnp.asarray(shape))
        tried.append(
            fit(
                fitted.setting,
                records,
                (*fitted.places, place),
                scales,
                start,
                fitted.noise,
                ratio=fitted.ratio,
                ratios=fitted.ratios,
                gain=fitted.gain,
                cycles=1,
                steps=4,
            )
        )
    return max(tried, key=lambda one: one.searched.log_likelihood).unknowns


def _cramped(model: Fitted, law: AbstractLaw) -> bool:
    """Whether a shape of the newest effect sits at its bound."""
    if not law.shapes:
        return False
    lower, upper = law.bounds(model.scales[-1])
    shape = np.asarray(model.unknowns.shape[len(model.places) - 1])[: len(law.shapes)]
    return bool(np.any((shape <= 1.001 * lower) | (shape >= 0.999 * upper)))


def without(fitted: Fitted, records: Records, slot: int) -> Fitted:
    """The model refitted without one of its effects.

    Args:
        fitted: the model.
        records: estimation data.
        slot: which effect to leave out.
    """
    others = [place for place in range(len(fitted.places)) if place != slot]
    order = np.asarray([*others, slot, *range(len(fitted.places), SLOTS)])
    amplitude = np.array(fitted.unknowns.amplitude)[order]
    shape = np.array(fitted.unknowns.shape)[order]
    amplitude[len(others) :], shape[len(others) :] = 0.0, 0.0
    unknowns = eqx.tree_at(
        lambda tree: (tree.amplitude, tree.shape),
        fitted.unknowns,
        (jnp.asarray(amplitude), jnp.asarray(shape)),
    )
    return fit(
        fitted.setting,
        records,
        [fitted.places[place] for place in others],
        [fitted.scales[place] for place in others],
        unknowns,
        fitted.noise,
        ratio=fitted.ratio,
        ratios=fitted.ratios,
    )
