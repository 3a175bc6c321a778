"""What closing the loop came to: verdict, effects, error before and after, and what to plot."""

from typing import NamedTuple

import numpy as np

VERDICTS = ("nothing to add", "named", "named, remainder unknown", "abstain")
"""The four ways it can end."""


class EstimatedNumber(NamedTuple):
    """A number with its standard error (robust to autocorrelation) and its unit.

    Attributes:
        name: of the amplitude, the shape or the model's parameter.
        value: estimate.
        std: standard error; infinite where the records do not decide.
        unit: as text, empty for a pure number.
    """

    name: str
    value: float
    std: float
    unit: str


class SeatedEffect(NamedTuple):
    """An effect in a model, with its numbers.

    Attributes:
        name: of its law.
        family: of its law.
        port: where it acts, such as "force at load" or "input torque".
        parameters: amplitudes, then shapes.
    """

    name: str
    family: str
    port: str
    parameters: tuple[EstimatedNumber, ...]


class FoundEffect(NamedTuple):
    """An effect that the records name.

    Attributes:
        name: of its law.
        family: of its law.
        port: where it acts, such as "force at load" or "input torque".
        parameters: amplitudes, then shapes.
        confusable_with: what the records cannot tell from it, as "name at port".
        gain: in log-likelihood, on the estimation data.
        held_out_gain: in log-likelihood, on data that took no part.
        p_value: of the test that led to it, over all tests made in its round.
        separating_input: what record would tell it from the confusable ones.
    """

    name: str
    family: str
    port: str
    parameters: tuple[EstimatedNumber, ...]
    confusable_with: tuple[str, ...]
    gain: float
    held_out_gain: float
    p_value: float
    separating_input: str


class Errors(NamedTuple):
    """Root mean square errors of each output on held-out data, in the outputs' units.

    Attributes:
        one_step: of the one-step prediction (ny,).
        horizon: of the prediction over `Loop.horizon` samples (ny,).
        free_run: of the simulation from the fitted initial state (ny,).
        bft: best fit of the simulation, % (ny,).
    """

    one_step: np.ndarray
    horizon: np.ndarray
    free_run: np.ndarray
    bft: np.ndarray


class Ladder(NamedTuple):
    """Error over the prediction horizon, before and after.

    Attributes:
        steps: samples ahead (horizon,).
        before: root mean square error (horizon, ny).
        after: the same with the effects (horizon, ny).
    """

    steps: np.ndarray
    before: np.ndarray
    after: np.ndarray


class Candidate(NamedTuple):
    """One effect at one port as a round ranked it.

    Attributes:
        name: of its law.
        family: of its law.
        port: where it would act.
        gain: log-likelihood gain of its best shape by the score test.
        penalised: the gain less the complexity penalty.
        p_value: for all tests of the round.
    """

    name: str
    family: str
    port: str
    gain: float
    penalised: float
    p_value: float


class VirtualForce(NamedTuple):
    """What an effect adds, against what it depends on, over the held-out data.

    Attributes:
        effect: name of the effect.
        regressor_name: with unit, such as "velocity at load (rad/s)".
        regressor: (time,).
        residual: what the model without this effect lacks at the effect's port (time,).
        law: what the effect adds there (time,).
        unit: of residual and law.
    """

    effect: str
    regressor_name: str
    regressor: np.ndarray
    residual: np.ndarray
    law: np.ndarray
    unit: str


class Series(NamedTuple):
    """Held-out signals for the pictures.

    Attributes:
        time: s (time,).
        output: measured (time, ny).
        before: free run of the model without effects (time, ny).
        after: free run with them (time, ny).
        residual_before: one-step prediction errors (time, ny).
        residual_after: the same with the effects (time, ny).
    """

    time: np.ndarray
    output: np.ndarray
    before: np.ndarray
    after: np.ndarray
    residual_before: np.ndarray
    residual_after: np.ndarray
