"""One round: score every candidate, refit the best few, keep what held-out data confirm."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.stats

from lpvid.loop._candidates import Place, modulated_places, places_of
from lpvid.loop._columns import along, force_columns, tests_at, trial_columns
from lpvid.loop._compare import better, sample_likelihood
from lpvid.loop._program import Records
from lpvid.loop._refit import Ranked, compiled, kept, with_effect
from lpvid.loop._score import ScoreTest, family_wise
from lpvid.loop._search import errors_of
from lpvid.loop._tune import Fitted, with_starts
from lpvid.loop._verdict import LEVEL

_ALIKE = 0.95
"""Cosine between projected sensitivities from which two effects are taken for one another."""

_REFITTED, _ATTEMPTS = 3, 6
_HOPEFUL = 0.3
"""Share of the best gain from which a candidate, its shape once free, could still win."""


class Ranking(NamedTuple):
    """All places of a round, best first.

    Attributes:
        entries: one a place, of those with any gain.
        test: the score test, for projections.
        tests: number of tests made.
        p_value: family-wise, of the best.
        general: family-wise p-value of the general force terms.
    """

    entries: tuple[Ranked, ...]
    test: ScoreTest
    tests: int
    p_value: float
    general: float


def rank(fitted: Fitted, records: Records, schedules: Sequence[str]) -> Ranking:
    """Score every law at every port.

    Args:
        fitted: the model as it stands.
        records: estimation data.
        schedules: names of what a parameter may follow.
    """
    setting = fitted.setting
    trace = along(setting, records, fitted.slots, fitted.unknowns, fitted.gain)
    taken = set(fitted.places)
    places = places_of(setting.structure, setting.laws, schedules)
    places += modulated_places(setting.laws, fitted.places, schedules)
    places = [place for place in places if place not in taken]
    tried: dict[Place, int] = {}
    test = ScoreTest(fitted.searched.errors, fitted.searched.columns)
    samples = fitted.searched.errors.shape[0]
    best: dict[Place, Ranked] = {}
    for trial, columns in trial_columns(trace, places):
        tried[trial.place] = tried.get(trial.place, 0) + 1
        law = setting.laws[trial.place.law]
        directions = columns.shape[2] // len(law.amplitudes)
        signed = directions == 1 and not trial.place.modulated
        positive = np.array([a.positive and signed for a in law.amplitudes])
        if law.whole:
            positive = np.ones(len(law.amplitudes), bool)
        scored = test.score(columns, np.repeat(positive, directions))
        numbers = columns.shape[2] + len(law.shapes)
        penalised = scored.gain - 0.5 * numbers * np.log(samples)
        old = best.get(trial.place)
        if scored.gain > 0.0 and (old is None or penalised > old.penalised):
            best[trial.place] = Ranked(trial, scored, columns, penalised)
    entries = sorted(best.values(), key=lambda entry: -entry.penalised)
    least = min((entry.scored.p_value for entry in entries), default=1.0)
    general = _general(trace, test)
    tests = sum(tests_at(trace, place, count) for place, count in tried.items())
    return Ranking(tuple(entries), test, tests, family_wise(least, max(tests, 1)), general)


def _general(trace, test: ScoreTest) -> float:
    """Family-wise p-value of smooth force terms that belong to no effect of the library.

    Products of Legendre polynomials in position and velocity up to degree three, at each
    coordinate, tested together.
    """
    structure = trace.setting.structure
    least, tests = 1.0, 0
    for coordinate in range(len(structure.coordinate_names)):
        start, end = (trace.signals[name] for name in ("start", "end"))
        sizes = {}
        for name in ("position", "velocity"):
            values = np.asarray(start[name][:, coordinate])
            sizes[name] = max(float(np.max(np.abs(values))), 1e-300)

        def terms(signals, sizes=sizes, coordinate=coordinate):
            q = np.clip(np.asarray(signals["position"][:, coordinate]) / sizes["position"], -2, 2)
            v = np.clip(np.asarray(signals["velocity"][:, coordinate]) / sizes["velocity"], -2, 2)
            legendre = np.polynomial.legendre.legvander2d(q, v, (3, 3))
            degrees = np.add.outer(np.arange(4), np.arange(4)).ravel()
            return legendre[:, (degrees > 1) & (degrees < 4)]

        begin, final = terms(start), terms(end)
        columns = force_columns(trace, coordinate, begin, final - begin)
        scored = test.score(columns, np.zeros(columns.shape[2], bool))
        least, tests = min(least, scored.p_value), tests + 1
    return family_wise(least, max(tests, 1))


def held_out_errors(fitted: Fitted, records: Records) -> np.ndarray:
    """One-step errors on other records, initial states fitted (time, ny).

    Args:
        fitted: the model.
        records: held-out data.
    """
    unknowns = with_starts(fitted, records)
    return errors_of(fitted.setting, records, fitted.slots, unknowns, fitted.gain)


def likelihood_on(fitted: Fitted, errors: np.ndarray) -> np.ndarray:
    own = fitted.searched.errors
    return sample_likelihood(errors, own.T @ own / own.shape[0])


class Chosen(NamedTuple):
    """What a round added.

    Attributes:
        fitted: the model with the effect in.
        entry: the candidate.
        confusable: places that the records cannot tell from it.
        held_out_gain: in log-likelihood.
        p_value: family-wise, of the score test; of a folded sensor, which no such test leads to,
            that of the held-out gain.
    """

    fitted: Fitted
    entry: Ranked
    confusable: tuple[Place, ...]
    held_out_gain: float
    p_value: float


class Rounds(NamedTuple):
    """What all rounds came to.

    Attributes:
        fitted: the model with what was found.
        chosen: the effects, in the order of the model's slots.
        rankings: of every round; the last found nothing, or is that of the final model.
        unfruitful: tests of further rankings, which led nowhere.
    """

    fitted: Fitted
    chosen: list[Chosen]
    rankings: list[Ranking]
    unfruitful: int


def choose(fitted: Fitted, ranking: Ranking, records: Records, held_out: Records) -> Chosen | None:
    """Refit the best few and take the one that held-out data prefer, if they prefer any.

    Args:
        fitted: the model as it stands.
        ranking: of this round.
        records: estimation data.
        held_out: data that took no part.
    """
    significant = [
        entry
        for entry in ranking.entries
        if family_wise(entry.scored.p_value, ranking.tests) < LEVEL
    ]
    if not significant:
        return None
    before = likelihood_on(fitted, held_out_errors(fitted, held_out))
    tried: list[tuple[Ranked, Fitted, np.ndarray]] = []
    with compiled(fitted, records, significant[:_REFITTED]) as ready:
        for entry in significant[:_ATTEMPTS]:
            # Judged by the best that kept its promise: one that did not must not shut out the rest.
            if tried and entry.scored.gain < _HOPEFUL * tried[0][0].scored.gain:
                continue
            if len(tried) == _REFITTED:
                break
            ready(entry)
            refitted = with_effect(fitted, records, entry)
            if not kept(fitted, refitted, entry.scored.gain):
                continue
            errors = held_out_errors(refitted, held_out)
            tried.append((entry, refitted, likelihood_on(refitted, errors)))
    if not tried:
        return None
    tried = [one for one in tried if np.all(np.isfinite(one[2]))]
    if not tried:
        return None
    entry, refitted, likelihood = _simplest(tried)
    gain, p_value = better(before, likelihood)
    if p_value > LEVEL:
        return None
    confusable = [
        other.trial.place
        for other, model, rival in tried
        if other is not entry
        and better(rival, likelihood)[1] > LEVEL
        and model.searched.log_likelihood
        > refitted.searched.log_likelihood - 0.5 * scipy.stats.chi2.isf(LEVEL, 1)
    ]
    confusable += _alike(ranking, entry, [one[0] for one in tried])
    promised = family_wise(entry.scored.p_value, ranking.tests)
    return Chosen(refitted, entry, tuple(dict.fromkeys(confusable)), gain, promised)


def _simplest(
    tried: list[tuple[Ranked, Fitted, np.ndarray]],
) -> tuple[Ranked, Fitted, np.ndarray]:
    """Of those that held-out data cannot tell from the best, the one the others' records prefer.

    Preferred by likelihood on the estimation data less the penalty for its numbers.
    """
    best = max(tried, key=lambda one: float(np.sum(one[2])))
    level = [one for one in tried if one is best or better(one[2], best[2])[1] > LEVEL]

    def worth(one):
        entry, model, _ = one
        numbers = entry.columns.shape[2] + entry.trial.shape.size
        samples = model.searched.errors.shape[0]
        return model.searched.log_likelihood - 0.5 * numbers * np.log(samples)

    return max(level, key=worth)


def _alike(ranking: Ranking, entry: Ranked, tried: Sequence[Ranked]) -> list[Place]:
    """Places whose sensitivities point where the winner's do; those refitted have been judged."""
    own = _plane(ranking.test.projected(entry.columns))
    judged = {other.trial.place for other in tried}
    found = []
    for other in ranking.entries:
        # What gains far less cannot point the same way.
        if other.trial.place in judged or other.scored.gain < 0.8 * entry.scored.gain:
            continue
        plane = _plane(ranking.test.projected(other.columns))
        if plane.shape[1] != own.shape[1]:
            continue
        cosine = np.linalg.svd(own.T @ plane, compute_uv=False).min()
        if cosine > _ALIKE:
            found.append(other.trial.place)
    return found


def _plane(columns: np.ndarray) -> np.ndarray:
    norms = np.linalg.norm(columns, axis=0)
    return np.linalg.qr(columns / np.where(norms > 0.0, norms, 1.0))[0]
