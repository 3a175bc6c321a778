import numpy as np
import pytest
import scipy.signal

from lpvid.plot import residuals


def _signals():
    rng = np.random.default_rng(0)
    time = np.arange(600) * 0.01
    y = np.stack([np.sin(2 * np.pi * 3 * time), np.cos(2 * np.pi * 7 * time)], axis=1)
    return y, y - 0.1 * rng.normal(size=y.shape)


def test_time_autocorrelation_and_spectrum():
    y, y_hat = _signals()
    panels = residuals(y, y_hat, 0.01, names=["a", "b"], units=["V", ""], lags=20)
    assert panels.shape == (2, 3)
    e = (y - y_hat)[:, 1]
    time, lag, spectrum = panels[1]
    np.testing.assert_allclose(time.lines[0].get_ydata(), e)
    centred = e - e.mean()
    direct = [centred[: 600 - k] @ centred[k:] / (centred @ centred) for k in range(1, 21)]
    np.testing.assert_array_equal(lag.lines[0].get_xdata(), np.arange(1, 21))
    np.testing.assert_allclose(lag.lines[0].get_ydata(), direct, atol=1e-12)
    (band,) = lag.patches
    assert band.get_y() == pytest.approx(-1.96 / np.sqrt(600))
    frequency, power = scipy.signal.periodogram(e, fs=100.0)
    # Welch and the plain periodogram agree on the power in all.
    shown = spectrum.lines[1]
    step = shown.get_xdata()[1] - shown.get_xdata()[0]
    whole = np.sum(power) * (frequency[1] - frequency[0])
    assert np.sum(shown.get_ydata()) * step == pytest.approx(whole, rel=0.1)
    assert spectrum.get_xlabel() == "frequency (Hz)"
    assert panels[0, 0].get_ylabel() == "residual (V)"
    assert panels[0, 2].get_title(loc="left") == "power spectral density, (V)²/Hz"


def test_the_measured_peak_is_at_its_frequency_in_hertz():
    y, y_hat = _signals()
    spectrum = residuals(y[:, 0], y_hat[:, 0], 0.01)[0, 2]
    hertz, power = spectrum.lines[0].get_xdata(), spectrum.lines[0].get_ydata()
    assert hertz[np.argmax(power)] == pytest.approx(3.0, abs=hertz[1] - hertz[0])


def test_a_perfect_model_is_drawn_too():
    y, _ = _signals()
    panels = residuals(y, y, 0.01)
    np.testing.assert_array_equal(panels[0, 0].lines[0].get_ydata(), 0.0)
    assert np.all(np.isnan(panels[0, 1].lines[0].get_ydata()))


def test_shapes_must_fit():
    with pytest.raises(ValueError, match="y_hat: shape"):
        residuals(np.zeros(5), np.zeros(6), 0.1)
