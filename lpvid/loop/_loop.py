"""The record that `close_the_loop` returns."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from lpvid.loop._loop_model import LoopModel
from lpvid.loop._result import (
    Candidate,
    Errors,
    EstimatedNumber,
    FoundEffect,
    Ladder,
    Series,
    VirtualForce,
)


class Loop(NamedTuple):
    """The record that `close_the_loop` returns.

    Attributes:
        verdict: one of `VERDICTS`.
        advice: what the verdict means for these records and what to do next, in plain words.
        structure: name of the model's structure.
        parameters: of the model, with the effects in place.
        effects: those found, in the order they were found.
        before: errors of the model without effects, refitted to the estimation data.
        after: errors with the effects.
        noise_floor: least error that the records allow (ny,).
        noise_floor_from: how it was found, in words.
        held_out: first and last sample of the held-out data, or of the test record; of the first
            record where there are several.
        horizon: samples of the `horizon` errors.
        ladder: the errors over the horizon.
        p_value: family-wise, that nothing is missing from the starting model.
        p_value_left: the same for the final model.
        tests_made: number of hypotheses tried in all.
        rounds: the ranking of each round.
        ablation: for each effect, "name at port", the held-out horizon error (ny,) without it.
        residual_tests: p-values of the classical tests by name.
        virtual_forces: one for each effect.
        series: held-out signals.
        model: with the effects in place, to simulate and predict other records.
        model_before: the model without effects, refitted.
        output_names: of the record.
        output_units: of the record.
        dt: sample time, s.
        seconds: wall time spent.
    """

    verdict: str
    advice: str
    structure: str
    parameters: tuple[EstimatedNumber, ...]
    effects: tuple[FoundEffect, ...]
    before: Errors
    after: Errors
    noise_floor: np.ndarray
    noise_floor_from: str
    held_out: tuple[int, int]
    horizon: int
    ladder: Ladder
    p_value: float
    p_value_left: float
    tests_made: int
    rounds: tuple[tuple[Candidate, ...], ...]
    ablation: Mapping[str, np.ndarray]
    residual_tests: Mapping[str, float]
    virtual_forces: tuple[VirtualForce, ...]
    series: Series
    model: LoopModel
    model_before: LoopModel
    output_names: tuple[str, ...]
    output_units: tuple[str, ...]
    dt: float
    seconds: float
