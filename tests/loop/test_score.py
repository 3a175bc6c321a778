"""The score test: its level under coloured noise, its power, its signs, its estimates."""

import numpy as np
import pytest
import scipy.signal
import scipy.stats

from lpvid.loop._score import ScoreTest, family_wise

SAMPLES, TIMES = 400, 300


def _coloured(rng, poles, outputs=1):
    noise = rng.standard_normal((SAMPLES + 200, outputs))
    return scipy.signal.lfilter([1.0], poles, noise, axis=0)[200:]


def _columns(rng, count, outputs=1):
    """Slow columns, as sensitivities are."""
    raw = rng.standard_normal((SAMPLES, outputs, count))
    return scipy.signal.lfilter([1.0], [1.0, -0.9], raw, axis=0)


def _rejected(poles, outputs, size, wanted):
    rng = np.random.default_rng(7)
    values = []
    for _ in range(TIMES):
        errors = _coloured(rng, poles, outputs)
        base, candidate = _columns(rng, 3, outputs), _columns(rng, wanted, outputs)
        errors = errors + size * candidate[:, :, 0]
        values.append(ScoreTest(errors, base).score(candidate, np.zeros(wanted, bool)).p_value)
    return np.mean(np.asarray(values) < 0.05)


@pytest.mark.parametrize(
    ("poles", "outputs", "wanted"),
    [([1.0], 1, 1), ([1.0, -0.8], 1, 1), ([1.0, -0.8], 2, 2), ([1.0, -1.5, 0.7], 1, 2)],
)
def test_level_under_coloured_noise(poles, outputs, wanted):
    # 5 % by theory; four standard deviations of 300 draws, and a tenth for a finite record.
    spread = 4.0 * np.sqrt(0.05 * 0.95 / TIMES)
    share = _rejected(poles, outputs, 0.0, wanted)
    assert 0.05 - spread < share < 1.1 * 0.05 + spread


def test_power_is_that_of_the_normal_law():
    # White noise: the estimate over its standard error is normal about this.
    rng = np.random.default_rng(8)
    size = 0.06
    sums = [np.sum(_columns(rng, 1) ** 2) for _ in range(50)]
    expected = np.mean(scipy.stats.ncx2.sf(3.84, 1, size**2 * np.array(sums)))
    assert 0.5 < expected < 0.9
    assert _rejected([1.0], 1, size, 1) == pytest.approx(expected, abs=0.1)


def test_the_amplitude_is_least_squares_and_what_is_known_adds_nothing():
    rng = np.random.default_rng(9)
    base, candidate = _columns(rng, 2), _columns(rng, 1)
    noise = 0.1 * rng.standard_normal((SAMPLES, 1))
    # Columns are derivatives of the innovations, so an amplitude of 2 leaves −2 columns behind.
    errors = noise - 2.0 * candidate[:, :, 0] - base @ np.array([0.5, -0.3])
    test = ScoreTest(errors, base)
    found = test.score(candidate, np.array([True]))
    design = np.concatenate([base[:, 0], candidate[:, 0]], axis=1)
    expected = -np.linalg.lstsq(design, errors[:, 0], rcond=None)[0][2]
    spread = 0.1 / np.linalg.norm(candidate)
    assert abs(found.amplitude[0] - expected) < 2.0 * spread
    assert found.gain > 100.0 and found.p_value < 1e-40
    again = test.score(base[:, :, :1] - 3.0 * base[:, :, 1:], np.array([False]))
    assert again.gain < 1e-3


def test_a_physical_amplitude_of_the_wrong_sign_is_no_find():
    rng = np.random.default_rng(10)
    base, candidate = _columns(rng, 2), _columns(rng, 1)
    errors = rng.standard_normal((SAMPLES, 1)) + candidate[:, :, 0]
    test = ScoreTest(errors, base)
    assert test.score(candidate, np.array([False])).amplitude[0] < 0.0
    refused = test.score(candidate, np.array([True]))
    assert refused.gain == 0.0 and refused.p_value == 1.0


def test_candidates_that_are_nothing_gain_nothing():
    rng = np.random.default_rng(11)
    test = ScoreTest(rng.standard_normal((SAMPLES, 1)), _columns(rng, 2))
    for column in (np.zeros((SAMPLES, 1, 1)), np.full((SAMPLES, 1, 1), np.inf)):
        assert test.score(column, np.array([False])).p_value == 1.0


def test_what_the_model_explains_is_projected_out():
    rng = np.random.default_rng(12)
    base, fresh = _columns(rng, 3, 2), _columns(rng, 1, 2)
    test = ScoreTest(rng.standard_normal((SAMPLES, 2)), base)
    within = test.projected(base @ np.array([[1.0], [2.0], [-1.0]]))
    assert np.linalg.norm(within) < 1e-8 * np.linalg.norm(base)
    rest = test.projected(fresh)
    np.testing.assert_allclose(test.projected(fresh + base[:, :, :1]), rest, atol=1e-8)


def test_the_least_of_many_p_values():
    assert family_wise(0.01, 1) == pytest.approx(0.01)
    assert family_wise(0.01, 20) == pytest.approx(1.0 - 0.99**20)
    # Without loss where 1 − p rounds to 1.
    assert family_wise(1e-30, 50) == pytest.approx(5e-29)
    assert family_wise(1.0, 3) == 1.0
