"""The verdict: from what is left, what was gained, and how near the noise the errors are."""

from typing import NamedTuple

import numpy as np

LEVEL = 0.01
"""Family-wise level of all tests."""

NEAR = 1.15
"""Error over noise floor up to which what is left counts as nothing."""

FAR = 1.3
"""Error over noise floor from which something is left whatever the tests of the library say."""

NEARLY_ALL = 0.999
"""Share explained from which `FAR` no longer counts: only what a test sees is left then."""

EXPLAINED = 0.9
"""Share of the error power above the floor that effects must explain to be named at all."""


class Evidence(NamedTuple):
    """What the verdict rests on.

    Attributes:
        p_value: that the model without effects lacks nothing.
        p_value_left: the same for the final model.
        named: whether held-out data confirmed any effect.
        near: worst ratio of one-step error to noise floor of the final model.
        explained: share of the excess error power over the horizon that the effects explain.
    """

    p_value: float
    p_value_left: float
    named: bool
    near: float
    explained: float


def explained(before: np.ndarray, after: np.ndarray, floor: np.ndarray) -> float:
    """Share of the error power above the floor that is gone, over all outputs.

    Args:
        before: root mean square errors (ny,).
        after: the same with the effects.
        floor: noise floor (ny,).
    """
    with np.errstate(all="ignore"):
        excess = np.sum(np.maximum((before / floor) ** 2 - 1.0, 0.0))
        left = np.sum(np.maximum((after / floor) ** 2 - 1.0, 0.0))
        share = 1.0 - left / excess
    return float(share) if np.isfinite(share) else 0.0


def decide(evidence: Evidence) -> tuple[str, str]:
    """The verdict, and what it means in plain words.

    Args:
        evidence: what it rests on.
    """
    # Written so that errors that are not numbers count as far away.
    seen = evidence.p_value_left < LEVEL and not evidence.near <= NEAR
    left = seen or not (evidence.near <= FAR or evidence.explained >= NEARLY_ALL)
    if not evidence.named:
        if evidence.p_value >= LEVEL and not left:
            return "nothing to add", (
                "No effect of the library explains what the model leaves: it is what noise alone "
                "would leave. A richer input or a longer record could still show more."
            )
        if evidence.near <= NEAR:
            return "nothing to add", (
                "The tests see something in the residual, but nothing predicts other data better "
                "and the error is at the noise floor already."
            )
        return "abstain", (
            "The model lacks something, but no effect of the library predicts other data better. "
            "Look at the residual's spectrum and at what the best candidates have in common, "
            "question the structure and its order, or add an effect of your own."
        )
    if not left:
        return "named", "The effects explain what the model lacked, down to the noise."
    if evidence.explained >= EXPLAINED:
        return "named, remainder unknown", (
            "The effects explain most of what the model lacked and other data confirm them; what "
            "is left is more than noise and has no name in the library."
        )
    return "abstain", (
        "The best effects of the library predict other data better but leave too much "
        "unexplained to be the cause. The first round's ranking says what the residual looks "
        "like; question the structure, or add an effect of your own."
    )
