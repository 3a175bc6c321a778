"""Close the loop: fit, test, add, refit, confirm on other data, and say what came of it."""

import time
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from lpvid.data import IOData
from lpvid.effects import LIBRARY, AbstractLaw, InputDelay
from lpvid.loop._assess import default_horizon, ladder, noise_in
from lpvid.loop._bench import Bench
from lpvid.loop._checks import checked_fit, checked_options, checked_records, checked_signals
from lpvid.loop._compare import better
from lpvid.loop._folded import folded_sensor
from lpvid.loop._loop import Loop
from lpvid.loop._noise_floor import measured_floor
from lpvid.loop._ported import AbstractPortedStructure
from lpvid.loop._program import SLOTS, Setting
from lpvid.loop._records import records_of, schedule_names, scheduling_nodes
from lpvid.loop._refit import without
from lpvid.loop._rounds import (
    Chosen,
    Ranking,
    Rounds,
    choose,
    held_out_errors,
    likelihood_on,
    rank,
)
from lpvid.loop._summary import summarise
from lpvid.loop._tune import RATIOS, Fitted, empty_unknowns, fit, refit, rough_noise
from lpvid.loop._verdict import LEVEL, NEAR
from lpvid.loop.structures import PortedModel, structure_named

_SLOWER = 1.001e-3
"""Diffusion of the slow gain over that of the likeliest one (a hair more, for rounding)."""


def close_the_loop(
    model: Any,
    data: IOData,
    *,
    test: IOData | None = None,
    split: float = 2.0 / 3.0,
    laws: Sequence[AbstractLaw] = LIBRARY,
    most_effects: int = SLOTS,
    horizon: int | None = None,
    hold: str = "zero",
    progress: bool = False,
) -> Loop:
    """Find what a model lacks in measured records, add it, and report the error before and after.

    Its parameters are started and fitted from the records; the predictor's residual is
    tested against every law of the library at every port; the best few are refitted, their shapes
    free, and only what predicts held-out data better is added; at most three effects, each
    questioned again once another is in. Where scheduling signals are measured, an effect that is
    in is also tested for a strength that follows them: "coulomb, force at joint 2 over kappa1" is
    the slope over κ, from −1 at its least to 1 at its largest, beside the level.

    Not for `jit`, `vmap` or `grad`: what it does depends on what it finds. The predictor inside is
    compiled once for each set of laws.

    Args:
        model: a structure with ports (`lpvid.loop.structures`), the name of one, or any linear
            model that `PortedModel` takes: a `StateSpace`, a fit, a gray-box or an LPV model.
        data: one or several records, each with both estimation and held-out data in it unless
            `test` is given.
        test: other records for the held-out errors and decisions; all of `data` then estimates.
        split: share of each record that estimates.
        laws: the library of effects.
        most_effects: effects to add at most.
        horizon: samples of the horizon error; a twentieth of the held-out record if `None`.
        hold: what the inputs do between samples: "zero" where a converter holds them, "linear"
            where they were measured and are band-limited; the input delay, a law of held inputs, is
            then left out.
        progress: whether a bar shows the rounds.

    Returns:
        A `Loop`: verdict, effects, errors, and what the pictures need.

    Raises:
        ValueError: unusable records, too short ones, a split that leaves nothing, channels that
            do not suit the structure.

    Source: the score test is that of C. R. Rao (Proc. Cambridge Phil. Soc. 44 (1948) 50–57), with
    an autoregressive noise model profiled for each candidate; the predictor is a steady Kalman
    filter whose diffusion is chosen by likelihood.

    Example:
        >>> generator = np.random.default_rng(0)
        >>> u = np.repeat(generator.standard_normal(60), 10)
        >>> position, speed, y = 0.0, 0.0, []
        >>> for force in u:
        ...     y.append(position + 1e-3 * generator.standard_normal())
        ...     for _ in range(100):
        ...         speed += 5e-4 * (force - speed - 0.4 * np.tanh(speed / 1e-3))
        ...         position += 5e-4 * speed
        >>> data = IOData(u=u, y=y, dt=0.05)
        >>> found = close_the_loop("servo", data)
        >>> found.verdict, [effect.name for effect in found.effects]
        ('named', ['coulomb'])
    """
    begun = time.perf_counter()
    checked_options(test, split, most_effects, horizon, hold)
    checked_signals(data, test)
    structure = _structure(model, data if test is not None else data.split(split)[0])
    checked_records(structure, data, test, split, horizon)
    kept = tuple(law for law in laws if hold == "zero" or not isinstance(law, InputDelay))
    bench = _bench(structure, data, test, split, kept, hold)
    with tqdm(total=most_effects + 3, disable=not progress, desc="fitting") as bar:
        base = _base(bench)
        bar.update()
        found = _rounds(bench, base, most_effects, bar)
        bar.set_description("assessing")
        loop = summarise(bench, base, found, horizon)
        bar.update()
    return loop._replace(seconds=time.perf_counter() - begun)


def _structure(model: Any, train: IOData) -> AbstractPortedStructure:
    """What was given, as a structure with ports."""
    if isinstance(model, AbstractPortedStructure):
        return model
    if isinstance(model, str):
        return structure_named(model, train)
    return PortedModel(model, train)


def _bench(structure, data, test, split, laws, hold) -> Bench:
    if test is None:
        train, held_out = data.split(split)
        starts = [data.dt * length for length in train.lengths]
        first = train.lengths[0]
    else:
        train, held_out, starts, first = data, test, None, 0
    setting = Setting(structure, laws, train.dt, hold=hold)
    nodes = scheduling_nodes(data)
    duration = train.dt * (max(data.lengths) if test is None else max(train.lengths))
    length = max(train.n_samples, held_out.n_samples)
    return Bench(
        setting=setting,
        data=(train, held_out),
        train=records_of(train, nodes, duration, None, length, hold=hold),
        held_out=records_of(held_out, nodes, duration, starts, length, hold=hold),
        schedules=schedule_names(data),
        duration=duration,
        first_sample=first,
        floor=measured_floor(data.records if test is None else data.records + test.records),
    )


def _base(bench: Bench) -> Fitted:
    """The model without effects, fitted; its noise from the top of the residual's spectrum."""
    structure = bench.setting.structure
    train = bench.data[0]
    theta = np.asarray(structure.start(train), float)
    ports = structure.ports(jnp.asarray(theta), bench.train.kappa_nodes[0])
    unknowns = empty_unknowns(theta, ports.A.shape[0], len(train.lengths), ports.force.shape[2])
    noise = rough_noise(np.asarray(train.y))
    fitted = fit(bench.setting, bench.train, (), (), unknowns, noise)
    checked_fit(fitted.searched.log_likelihood, structure)
    noise = np.maximum(noise_in(fitted.searched.errors), 1e-3 * noise)
    return fit(bench.setting, bench.train, (), (), fitted.unknowns, noise, ratio=fitted.ratio)


def _rounds(bench: Bench, base: Fitted, most: int, bar: tqdm) -> Rounds:
    fitted, chosen, rankings, unfruitful = base, [], [], 0
    for _ in range(most):
        bar.set_description(f"round {len(rankings) + 1}")
        ranking = rank(fitted, bench.train, bench.schedules)
        rankings.append(ranking)
        folded = None if chosen else folded_sensor(bench, fitted)
        quiet = ranking.p_value > LEVEL or (chosen and _at_floor(bench, fitted))
        if quiet and folded is None:
            return Rounds(fitted, chosen, rankings, unfruitful)
        found = choose(fitted, ranking, bench.train, bench.held_out)
        if folded is not None and (found is None or folded.held_out_gain > found.held_out_gain):
            found = folded
            rankings[-1] = ranking._replace(p_value=min(ranking.p_value, folded.p_value))
        slower = max((one for one in RATIOS if one <= _SLOWER * fitted.ratio), default=None)
        if found is None and slower is not None:
            bar.set_description(f"round {len(rankings)}, slow gain")
            found, slow = _at_slow_gain(bench, fitted, slower)
            unfruitful += slow.tests
            if found is not None:
                rankings[-1] = slow
                unfruitful += ranking.tests - slow.tests
        bar.update()
        if found is None:
            return Rounds(fitted, chosen, rankings, unfruitful)
        fitted = found.fitted
        chosen.append(found)
        if len(chosen) > 1:
            fitted, chosen = _questioned(bench, fitted, chosen)
    rankings.append(rank(fitted, bench.train, bench.schedules))
    return Rounds(fitted, chosen, rankings, unfruitful)


def _at_floor(bench: Bench, fitted: Fitted) -> bool:
    """Whether so little is left, at one step and further ahead, that a name for it is moot.

    What is left of a sharp effect behind a smooth law would get a name of its own otherwise.
    """
    errors = held_out_errors(fitted, bench.held_out)
    one_step = np.sqrt(np.mean(errors**2, axis=0))
    steps = ladder(fitted, bench.held_out, default_horizon(bench.data[1]))
    floor = np.minimum(bench.noise(errors), one_step)
    ahead = np.sqrt(np.mean(steps**2, axis=0))
    return bool(np.max(np.maximum(one_step, ahead) / floor) <= NEAR)


def _at_slow_gain(bench: Bench, fitted: Fitted, ratio: float) -> tuple[Chosen | None, Ranking]:
    """A round with a predictor that follows its model for longer.

    Diffusion takes what the model lacks for noise, and the faster gain that comes of it swallows
    effects that act slowly. What is found is refitted with the diffusion free, and has to predict
    held-out data better so as well.
    """
    slow = refit(fitted, bench.train, ratio, (ratio,))
    ranking = rank(slow, bench.train, bench.schedules)
    found = choose(slow, ranking, bench.train, bench.held_out)
    if found is None:
        return None, ranking
    free = refit(found.fitted, bench.train, fitted.ratio, fitted.ratios)
    before, after = (
        likelihood_on(fitted, held_out_errors(one, bench.held_out)) for one in (fitted, free)
    )
    gain, p_value = better(before, after)
    if p_value > LEVEL:
        return None, ranking
    # The round looked twice.
    promised = min(2.0 * found.p_value, 1.0)
    return found._replace(fitted=free, held_out_gain=gain, p_value=promised), ranking


def _questioned(bench: Bench, fitted: Fitted, chosen: list[Chosen]) -> tuple[Fitted, list[Chosen]]:
    """Take out earlier effects that held-out data no longer ask for."""
    slot = 0
    while slot < len(chosen) - 1:
        full = likelihood_on(fitted, held_out_errors(fitted, bench.held_out))
        reduced = without(fitted, bench.train, slot)
        rival = likelihood_on(reduced, held_out_errors(reduced, bench.held_out))
        if better(rival, full)[1] < LEVEL:
            slot += 1
            continue
        fitted = reduced
        chosen = chosen[:slot] + chosen[slot + 1 :]
    return fitted, chosen
