"""Steady-state fit in a band, against simulation over many periods."""

import jax
import numpy as np
import pytest

from lpvid.analysis import band_fit, band_lines
from lpvid.data import IOData
from lpvid.models import StateSpace

DT, SAMPLES = 0.05, 128
PLANT = StateSpace([[0.0, 9.0], [-9.0, -0.8]], [[0.0], [1.0]], [[1.0, 0.0], [0.0, 2.0]])
OTHER = StateSpace([[0.0, 8.0], [-8.0, -0.5]], [[0.0], [1.0]], [[1.0, 0.0], [0.0, 2.0]])
BAND = (0.4, 4.0)


@pytest.fixture(scope="module")
def steady():
    """One period of the response of the discretised plant after its transient."""
    u = np.random.default_rng(0).standard_normal(SAMPLES)
    discrete = PLANT.discretise(DT)
    y = discrete.simulate(u=np.tile(u, 12))[-SAMPLES:]
    return discrete, IOData(u=u, y=y, dt=DT)


def test_lines_are_those_of_the_transform_with_both_ends():
    data = IOData(u=np.ones(100), y=np.ones(100), dt=0.01)
    np.testing.assert_allclose(band_lines(data, (0, 3.0)) / (2 * np.pi), [0, 1, 2, 3], rtol=1e-14)
    np.testing.assert_allclose(band_lines(data, (1.5, 2.0)) / (2 * np.pi), [2.0], rtol=1e-14)


def test_the_true_model_fits_completely(steady):
    model, data = steady
    np.testing.assert_allclose(band_fit(model, data, BAND), [100.0, 100.0], atol=1e-6)


def test_equals_the_fit_of_band_limited_simulation(steady):
    """By Parseval: errors and outputs in time, both cut to the band by NumPy's transform."""
    _, data = steady
    other = OTHER.discretise(DT)
    y_hat = np.asarray(other.simulate(u=np.tile(data.u, (12, 1))))[-SAMPLES:]
    frequency = np.fft.rfftfreq(SAMPLES, DT)
    inside = (frequency >= BAND[0]) & (frequency <= BAND[1])

    def cut(signal):
        return np.fft.irfft(np.fft.rfft(signal, axis=0) * inside[:, None], SAMPLES, axis=0)

    y = np.asarray(data.y)
    expected = 100 * (1 - np.linalg.norm(cut(y - y_hat), axis=0) / np.linalg.norm(cut(y), axis=0))
    np.testing.assert_allclose(band_fit(other, data, BAND), expected, atol=1e-5)


def test_takes_a_response_and_a_continuous_model(steady):
    _, data = steady
    response = OTHER.frequency_response(band_lines(data, BAND))
    np.testing.assert_allclose(band_fit(response, data, BAND), band_fit(OTHER, data, BAND))
    np.testing.assert_allclose(band_fit(0 * response, data, BAND), [0.0, 0.0], atol=1e-12)


def test_records_count_together(steady):
    model, data = steady
    twice = IOData(u=[data.u] * 2, y=[data.y, 3 * data.y], dt=DT)
    # The second record is three times the model's output: errors 0 and 2, outputs 1 and 3.
    expected = 100 * (1 - 2 / np.sqrt(10))
    np.testing.assert_allclose(band_fit(model, twice, BAND), [expected] * 2, atol=1e-5)


def test_differentiates_in_the_model(steady):
    _, data = steady
    other = OTHER.discretise(DT)

    def fit(gain):
        model = StateSpace(other.A, other.B, gain * other.C, other.D, other.dt)
        return band_fit(model, data, BAND).sum()

    step = 1e-5
    numeric = (fit(1.0 + step) - fit(1.0 - step)) / (2 * step)
    np.testing.assert_allclose(jax.grad(fit)(1.0), numeric, rtol=1e-6)


@pytest.mark.parametrize("band", [(0.01, 0.02), (3.0, 2.0), (1.0, 10.0), (-1.0, 2.0)])
def test_bands_without_lines_are_refused(steady, band):
    with pytest.raises(ValueError, match="band: "):
        band_lines(steady[1], band)


def test_channels_and_lengths_must_fit(steady):
    _, data = steady
    with pytest.raises(ValueError, match="model: its response"):
        band_fit(StateSpace([[-1.0]], [[1.0]], [[1.0]]), data, BAND)
    uneven = IOData(u=[data.u, data.u[:64]], y=[data.y, data.y[:64]], dt=DT)
    with pytest.raises(ValueError, match="different lines"):
        band_fit(PLANT, uneven, BAND)
