"""Which model predicts other data better: long-run variance and level of the paired test."""

import numpy as np
import pytest
import scipy.signal
import scipy.stats

from lpvid.loop._compare import better, long_run_variance, sample_likelihood


def _ar(rng, pole, samples, times=1):
    noise = rng.standard_normal((times, samples + 200))
    return scipy.signal.lfilter([1.0], [1.0, -pole], noise, axis=1)[:, 200:]


def test_long_run_variance_of_an_autoregression():
    (values,) = _ar(np.random.default_rng(1), 0.6, 40_000)
    # (1 − 0.6)^-2; the window's 68 lags leave a spread of √(4 · 68 / 3 / 40000) = 5 %.
    assert long_run_variance(values) == pytest.approx(1.0 / 0.4**2, rel=0.15)
    white = np.random.default_rng(2).standard_normal(40_000)
    assert long_run_variance(white) == pytest.approx(1.0, rel=0.15)


@pytest.mark.parametrize("pole", [0.0, 0.6])
def test_level_when_both_are_as_good(pole):
    times = 800
    first = _ar(np.random.default_rng(3), pole, 1500, times)
    second = _ar(np.random.default_rng(4), pole, 1500, times)
    p_values = np.array([better(a, b)[1] for a, b in zip(first, second, strict=True)])
    # Four standard deviations of 800 draws; the window is known to reject a little too often.
    spread = 4.0 * np.sqrt(0.05 * 0.95 / times)
    assert 0.05 - spread < np.mean(p_values < 0.05) < 0.06 + spread


def test_the_better_one_is_told():
    rng = np.random.default_rng(5)
    first = rng.standard_normal(500)
    gain, p_value = better(first, first + 0.3 + 0.1 * rng.standard_normal(500))
    assert gain == pytest.approx(150.0, rel=0.1) and p_value < 1e-6
    assert better(first, first - 0.3 + 0.1 * rng.standard_normal(500))[1] > 0.99
    assert better(first, first)[0] == 0.0


def test_a_prediction_that_runs_away_loses():
    fine, lost = np.zeros(10), np.full(10, -np.inf)
    assert better(lost, fine) == (np.inf, 0.0)
    assert better(fine, lost) == (-np.inf, 1.0)


def test_the_likelihood_is_the_normal_one():
    rng = np.random.default_rng(6)
    covariance = np.array([[2.0, 0.3], [0.3, 0.5]])
    errors = rng.standard_normal((5, 2))
    expected = scipy.stats.multivariate_normal(cov=covariance).logpdf(errors)
    got = sample_likelihood(errors, covariance)
    np.testing.assert_allclose(got - np.log(2.0 * np.pi), expected)
