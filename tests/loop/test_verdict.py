"""The verdict for every combination of evidence."""

import numpy as np
import pytest

from lpvid.loop import VERDICTS
from lpvid.loop._verdict import EXPLAINED, LEVEL, NEAR, NEARLY_ALL, Evidence, decide, explained

NO, YES = 0.5, 0.5 * LEVEL
CLOSE, FAR = 1.0, 2.0 * NEAR


@pytest.mark.parametrize(
    ("p_value", "p_value_left", "named", "near", "share", "verdict"),
    [
        # Nothing named: nothing seen, seen but down to the noise, seen and above it.
        (NO, NO, False, CLOSE, 0.0, "nothing to add"),
        (YES, YES, False, CLOSE, 0.0, "nothing to add"),
        (YES, YES, False, FAR, 0.0, "abstain"),
        # Seen by no law of the library, yet far above the noise, or by the omnibus alone.
        (NO, NO, False, FAR, 0.0, "abstain"),
        (NO, YES, False, FAR, 0.0, "abstain"),
        (NO, YES, False, CLOSE, 0.0, "nothing to add"),
        # Named: nothing left, too little left to matter, something left, seen by a test or not.
        (YES, NO, True, CLOSE, 0.99, "named"),
        (YES, NO, True, FAR, 0.99, "named, remainder unknown"),
        (YES, NO, True, FAR, NEARLY_ALL, "named"),
        (YES, YES, True, FAR, NEARLY_ALL, "named, remainder unknown"),
        (YES, YES, True, CLOSE, 0.99, "named"),
        (YES, YES, True, FAR, EXPLAINED, "named, remainder unknown"),
        (YES, YES, True, FAR, 0.5 * EXPLAINED, "abstain"),
    ],
)
def test_verdicts(p_value, p_value_left, named, near, share, verdict):
    got, advice = decide(Evidence(p_value, p_value_left, named, near, share))
    assert got == verdict and got in VERDICTS
    assert advice.endswith(".") and len(advice) > 40


def test_the_share_that_is_explained():
    floor = np.array([1.0, 2.0])
    before, after = np.array([3.0, 2.0]), np.array([np.sqrt(1.0 + 2.0), 2.0])
    # Powers over the floor: 8 and 0 before, 2 and 0 after.
    assert explained(before, after, floor) == pytest.approx(0.75)
    assert explained(before, floor, floor) == 1.0
    # Nothing above the floor, or a floor of nothing, explains nothing.
    assert explained(floor, floor, floor) == 0.0
    assert explained(before, after, np.zeros(2)) == 0.0
