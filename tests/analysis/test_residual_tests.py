"""Level and power of the residual tests by Monte Carlo; statistics against their definitions."""

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import binom, chi2, kstest

from lpvid.analysis import residual_tests

N, LAGS = 400, 12


def white(rng):
    mixed = rng.standard_normal((N, 2)) @ np.array([[1.0, 0.6], [0.0, 1.0]])
    return mixed, rng.standard_normal((N, 1))


def coloured(rng):
    e = lfilter([1.0], [1.0, -1.6, 0.81], rng.standard_normal(N + 200))[200:]
    return e, lfilter([1.0], [1.0, -1.5, 0.7], rng.standard_normal(N + 200))[200:]


def sines(rng):
    e = lfilter([1.0], [1.0, -0.9], rng.standard_normal(N + 100))[100:]
    phases = rng.uniform(0.0, 2.0 * np.pi, 3)
    time = 2.0 * np.pi * np.arange(N)
    return e, sum(np.sin(time * k / 60.0 + phases[i]) for i, k in enumerate((1, 3, 7)))


def p_values(make, runs, **options):
    found = [
        residual_tests(*make(np.random.default_rng(s)), lags=LAGS, **options) for s in range(runs)
    ]
    names = ("whiteness_p", "dynamics_p", "feedback_p")
    p = {name: np.array([np.ravel(getattr(one, name))[0] for one in found]) for name in names}
    p["joint"] = np.array([float(one.joint_whiteness_p) for one in found])
    # Lag by lag the same number comes again and again: one lag of each run is looked at.
    p["outside"] = np.sum(
        [np.abs(one.cross_correlation[LAGS, 0, 0]) > one.cross_band[LAGS, 0, 0] for one in found]
    )
    return p


def assert_level(p, level=0.05):
    """Rejections within what 1 in 500 correct tests would leave, and no shape but the uniform."""
    assert_rejections(np.sum(p < level), p.size, level)
    assert kstest(p, "uniform").pvalue > 0.002


def assert_rejections(count, runs, level=0.05):
    low, high = binom.ppf([0.001, 0.999], runs, level)
    assert low <= count <= high


RUNS = [100, pytest.param(1000, marks=pytest.mark.slow)]


@pytest.mark.parametrize("runs", RUNS)
def test_white_residuals_are_rejected_as_often_as_the_level_says(runs):
    p = p_values(white, runs, lengths=(100, 120, 180))
    for name in ("whiteness_p", "joint", "dynamics_p", "feedback_p"):
        assert_level(p[name])
    assert_rejections(p["outside"], runs)


@pytest.mark.parametrize("runs", RUNS)
@pytest.mark.parametrize("make", [coloured, sines])
def test_bands_hold_for_coloured_residuals_and_inputs(make, runs):
    p = p_values(make, runs)
    assert np.all(p["whiteness_p"] < 1e-6)
    assert_level(p["dynamics_p"])
    assert_level(p["feedback_p"])
    assert_rejections(p["outside"], runs)


def test_plain_bands_would_be_wrong_there():
    found = residual_tests(*coloured(np.random.default_rng(0)), lags=LAGS)
    assert np.all(np.asarray(found.cross_band) > 1.5 * 1.96 / np.sqrt(N))


def fitted_fir(rng):
    u, y = rng.standard_normal(N + 4), rng.standard_normal(N)
    regressors = np.stack([u[4 - k : N + 4 - k] for k in range(5)], axis=1)
    return y - regressors @ np.linalg.lstsq(regressors, y, rcond=None)[0], u[4:]


def fitted_autoregression(rng):
    y = lfilter([1.0], [1.0, -1.2, 0.5], rng.standard_normal(N + 50))[50:]
    regressors = np.stack([y[1:-1], y[:-2]], axis=1)
    u = rng.standard_normal(N - 2)
    return y[2:] - regressors @ np.linalg.lstsq(regressors, y[2:], rcond=None)[0], u


@pytest.mark.parametrize("runs", RUNS)
def test_fitted_parameters_are_taken_off_the_degrees_of_freedom(runs):
    assert_level(p_values(fitted_fir, runs, model_parameters=5)["dynamics_p"])
    assert kstest(p_values(fitted_fir, 100)["dynamics_p"], "uniform").pvalue < 1e-4
    assert_level(p_values(fitted_autoregression, runs, noise_parameters=2)["whiteness_p"])


def test_small_faults_are_found_where_they_are():
    """Power: a delay of two samples at 30 % of the noise, moving average noise, and feedback."""
    missed = {"dynamics": 0, "feedback": 0, "white": 0}
    for seed in range(30):
        rng = np.random.default_rng(seed)
        u, e = rng.standard_normal((2, N))
        forgotten = residual_tests(e + 0.3 * np.roll(u, 2), u, lags=LAGS)
        missed["dynamics"] += float(forgotten.dynamics_p[0, 0]) > 0.05
        answered = residual_tests(e, u + 0.3 * np.roll(e, 2), lags=LAGS)
        missed["feedback"] += float(answered.feedback_p[0, 0]) > 0.05
        missed["white"] += float(residual_tests(e + 0.4 * np.roll(e, 1)).whiteness_p[0]) > 0.05
    # Noncentrality 36 with 13 degrees of freedom: power above 0.99.
    assert all(count <= 2 for count in missed.values()), missed


def test_statistics_are_ljung_and_box():
    e = np.random.default_rng(1).standard_normal(N)
    found = residual_tests(e, lags=LAGS)
    c = e - e.mean()
    r = np.array([c[k:] @ c[: N - k] for k in range(LAGS + 1)]) / (c @ c)
    np.testing.assert_allclose(found.autocorrelation[:, 0], r[1:], atol=1e-12)
    q = N * (N + 2) * np.sum(r[1:] ** 2 / (N - np.arange(1, LAGS + 1)))
    np.testing.assert_allclose(found.whiteness_p[0], chi2.sf(q, LAGS), rtol=1e-9)
    np.testing.assert_allclose(found.joint_whiteness_p, found.whiteness_p[0], rtol=1e-9)


def test_cross_covariance_is_that_of_the_definition():
    """Band of a white residual against the sums over the lagged input, one record of three."""
    rng = np.random.default_rng(2)
    lengths = (50, 30, 40)
    e, u = rng.standard_normal((2, sum(lengths)))
    found = residual_tests(e, u, lags=5, lengths=lengths)
    c, v = e - e.mean(), u - u.mean()
    starts = np.cumsum((0, *lengths[:-1]))
    for index, lag in enumerate(range(-5, 6)):
        shifted = np.zeros_like(v)
        for start, n in zip(starts, lengths, strict=True):
            for t in range(n):
                if 0 <= t - lag < n:
                    shifted[start + t] = v[start + t - lag]
        size = np.sqrt((c @ c) * (v @ v))
        np.testing.assert_allclose(
            found.cross_correlation[index, 0, 0], c @ shifted / size, atol=1e-12
        )
        spread = np.std(shifted) * np.sqrt(v.size * c @ c / c.size) / size
        np.testing.assert_allclose(found.cross_band[index, 0, 0], 1.959964 * spread, rtol=1e-6)


def test_the_table_marks_what_fails():
    rng = np.random.default_rng(3)
    u, e = rng.standard_normal((2, N, 2))
    e[:, 1] += np.roll(u[:, 0], 1)
    found = residual_tests(e, u, output_names=["tip", "hub"], input_names=["force", "torque"])
    text = str(found)
    (line,) = [row for row in text.splitlines() if row.split()[:3] == ["dynamics", "hub", "force"]]
    assert line.split()[3:6] == ["<", "0.0001", "*"]
    rows = found.rows()
    assert [row["test"] for row in rows].count("feedback") == 4
    assert len(rows) == 11 and len(text.splitlines()) == 12
    assert "dynamics" not in str(residual_tests(e))


def test_faults_are_named():
    e = np.random.default_rng(4).standard_normal(100)
    for bad, options, message in (
        (e, {"u": e[1:]}, "u has 99 samples"),
        (e, {"lengths": (50, 40)}, "lengths"),
        (e, {"lags": 30}, "lags is 30"),
        (e, {"level": 1.0}, "level"),
        (e * np.nan, {}, "NaN"),
        (np.ones(100), {}, "y1 is constant"),
        (e, {"noise_parameters": 25}, "no degree of freedom"),
        (e, {"output_names": ["a", "b"]}, "output_names: 2 given for 1"),
    ):
        with pytest.raises(ValueError, match=message):
            residual_tests(bad, **options)
