"""From fitted models to the record that the user gets."""

import jax.numpy as jnp
import numpy as np

from lpvid.analysis import residual_tests
from lpvid.loop._assess import default_horizon, errors_of, ladder
from lpvid.loop._bench import Bench
from lpvid.loop._candidates import Place, port_name
from lpvid.loop._loop import Loop
from lpvid.loop._loop_model import LoopModel, loop_model
from lpvid.loop._refit import without
from lpvid.loop._result import (
    Candidate,
    FoundEffect,
    Ladder,
    Series,
)
from lpvid.loop._rounds import Chosen, Ranking, Rounds, held_out_errors
from lpvid.loop._score import family_wise
from lpvid.loop._tune import Fitted
from lpvid.loop._verdict import Evidence, decide, explained
from lpvid.loop._virtual_force import virtual_forces

_SEPARATING = {
    "input": "the same input at two or three amplitudes",
    "force": "slow motion beside fast motion, and small amplitudes beside large ones",
    "output": "motion over the sensor's whole range at low speed",
    "parameter": "the same input at several operating points, and again some time later",
}


def summarise(
    bench: Bench,
    base: Fitted,
    found: Rounds,
    horizon: int | None,
) -> Loop:
    """Everything the report shows.

    Args:
        bench: what the call works with.
        base: the model without effects.
        found: what the rounds came to.
        horizon: samples, or `None` for a twentieth of the held-out record.
    """
    fitted, chosen, rankings, unfruitful = found
    held_out = bench.data[1]
    count = held_out.n_samples
    if horizon is None:
        horizon = default_horizon(held_out)
    errors = {name: held_out_errors(model, bench.held_out) for name, model in _both(base, fitted)}
    before, ladder_before, run_before = errors_of(base, bench.held_out, errors["before"], horizon)
    after, ladder_after, run_after = before, ladder_before, run_before
    if chosen:
        after, ladder_after, run_after = errors_of(fitted, bench.held_out, errors["after"], horizon)
    y = np.asarray(held_out.y)
    floor = np.minimum(bench.noise(errors["after"], y - run_after), after.one_step)
    last = rankings[-1]
    evidence = Evidence(
        p_value=rankings[0].p_value,
        p_value_left=min(1.0, 2.0 * min(last.p_value, last.general)),
        named=bool(chosen),
        near=float(np.max(after.one_step / floor)),
        explained=explained(before.horizon, after.horizon, floor),
    )
    verdict, advice = decide(evidence)
    if verdict == "abstain" and chosen:
        # What is not named is not kept either: the errors are those of the model as it was.
        fitted, chosen = base, []
        after, ladder_after, run_after = before, ladder_before, run_before
        errors["after"] = errors["before"]
    ablation = {}
    for slot, one in enumerate(chosen):
        name = _label(bench, one.entry.trial.place)
        ablation[name] = before.horizon
        if len(chosen) > 1:
            reduced = without(fitted, bench.train, slot)
            steps = ladder(reduced, bench.held_out, horizon)
            ablation[name] = np.sqrt(np.mean(steps**2, axis=0))
    nodes = np.asarray(bench.train.kappa_nodes)
    # One is the other where nothing was added: its covariance is worked out once.
    model_before = loop_model(base, nodes, bench.duration, bench.schedules)
    model = model_before
    if fitted is not base:
        model = loop_model(fitted, nodes, bench.duration, bench.schedules)
    return Loop(
        verdict=verdict,
        advice=advice,
        structure=str(bench.setting.structure.name),
        parameters=model.estimates,
        effects=tuple(_effect(model, bench, slot, one) for slot, one in enumerate(chosen)),
        before=before,
        after=after,
        noise_floor=floor,
        noise_floor_from=(
            "estimated from the top of the residual's spectrum"
            if bench.floor is None
            else bench.floor.source
        ),
        held_out=(bench.first_sample, bench.first_sample + held_out.lengths[0] - 1),
        horizon=horizon,
        ladder=Ladder(np.arange(1, horizon + 1), ladder_before, ladder_after),
        p_value=evidence.p_value,
        p_value_left=evidence.p_value_left,
        tests_made=int(sum(ranking.tests for ranking in rankings)) + unfruitful,
        rounds=tuple(_ranked(bench, ranking) for ranking in rankings),
        ablation=ablation,
        residual_tests=_classical(errors["after"], held_out),
        virtual_forces=virtual_forces(bench, fitted),
        series=Series(
            np.asarray(bench.held_out.time)[:count],
            y,
            run_before,
            run_after,
            errors["before"],
            errors["after"],
        ),
        model=model,
        model_before=model_before,
        output_names=held_out.output_names,
        output_units=held_out.output_units,
        dt=held_out.dt,
        seconds=0.0,
    )


def _both(base: Fitted, fitted: Fitted):
    return (("before", base), ("after", fitted))


def _label(bench: Bench, place: Place) -> str:
    law = bench.setting.laws[place.law]
    port = port_name(bench.setting.structure, place, bench.schedules)
    return f"{law.name} at {port.removeprefix('force at ')}"


def _ranked(bench: Bench, ranking: Ranking) -> tuple[Candidate, ...]:
    structure, laws = bench.setting.structure, bench.setting.laws
    return tuple(
        Candidate(
            name=laws[entry.trial.place.law].name,
            family=laws[entry.trial.place.law].family,
            port=port_name(structure, entry.trial.place, bench.schedules),
            gain=entry.scored.gain,
            penalised=entry.penalised,
            p_value=family_wise(entry.scored.p_value, ranking.tests),
        )
        for entry in ranking.entries
    )


def _effect(model: LoopModel, bench: Bench, slot: int, found: Chosen) -> FoundEffect:
    seated = model.effects[slot]
    confusable = tuple(_label(bench, other) for other in found.confusable)
    return FoundEffect(
        *seated,
        confusable_with=confusable,
        gain=found.entry.scored.gain,
        held_out_gain=found.held_out_gain,
        p_value=found.p_value,
        separating_input=_SEPARATING[found.entry.trial.place.port] if confusable else "",
    )


def _classical(errors: np.ndarray, data) -> dict[str, float]:
    """p-values of the classical tests: whiteness, cross-correlation, and of the squares."""
    found = {}
    try:
        linear = residual_tests(jnp.asarray(errors), data.u, lengths=data.lengths)
        centred = (np.asarray(data.u) - np.mean(np.asarray(data.u), axis=0)) ** 2
        squares = residual_tests(jnp.asarray(errors**2), jnp.asarray(centred), lengths=data.lengths)
    except ValueError:
        # Too short or constant residuals: the tests have nothing to say.
        return found
    found["whiteness"] = float(linear.joint_whiteness_p)
    found["cross-correlation with the input"] = float(np.min(np.asarray(linear.dynamics_p)))
    found["squared residual against squared input"] = float(np.min(np.asarray(squares.dynamics_p)))
    return found
