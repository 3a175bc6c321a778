"""Levels, spectra and correlations of the test signals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lpvid.mechanics import add_noise, multisine, prbs

KEY = jax.random.key(3)


@given(
    seed=st.integers(0, 1000),
    samples=st.sampled_from([41, 47]),
    hold=st.sampled_from([1, 7]),
)
@settings(max_examples=10, deadline=None)
def test_prbs_has_two_levels_held_and_balanced(seed, samples, hold):
    signal = np.asarray(prbs(jax.random.key(seed), samples, 2, amplitude=0.3, hold=hold))
    assert signal.shape == (samples, 2)
    np.testing.assert_allclose(np.abs(signal), 0.3)
    changes = np.nonzero(np.diff(signal, axis=0).any(axis=1))[0] + 1
    assert np.all(changes % hold == 0)
    bits = signal[::hold]
    assert np.all(np.abs(bits.sum(axis=0)) <= 0.3 * (len(bits) % 2) + 1e-12)


def test_prbs_is_white_and_its_channels_are_uncorrelated():
    bits = 4000
    signal = np.asarray(prbs(KEY, bits, 2))
    # Under whiteness each correlation has a standard deviation of 1/√bits: 5 of them bound 400.
    bound = 5.0 / np.sqrt(bits)
    for a, b, first in ((0, 0, 1), (1, 1, 1), (0, 1, 0), (1, 0, 0)):
        lags = [signal[lag:, a] @ signal[: bits - lag, b] / bits for lag in range(first, 100)]
        assert np.abs(lags).max() < bound
    spectrum = np.abs(np.fft.rfft(signal[:, 0])[1:]) ** 2 / bits
    bands = spectrum[: 20 * (len(spectrum) // 20)].reshape(20, -1).mean(axis=1)
    np.testing.assert_allclose(bands, 1.0, atol=0.5)


def test_prbs_depends_on_the_key_and_traces():
    one, other = (prbs(jax.random.key(i), 100, 1) for i in (0, 1))
    assert not np.array_equal(one, other)
    batch = jax.jit(jax.vmap(lambda key: prbs(key, 100, 1)))(jax.random.split(KEY, 2))
    assert batch.shape == (2, 100, 1)


@pytest.mark.parametrize("samples", [500, 501])
def test_multisine_fills_its_band_and_nothing_else(samples):
    dt, band = 1e-2, (20.0, 120.0)
    signal = np.asarray(multisine(KEY, samples, 3, dt, band, amplitude=0.7))
    np.testing.assert_allclose(signal.std(axis=0), 0.7, rtol=1e-10)
    np.testing.assert_allclose(signal.T @ signal, 0.49 * samples * np.eye(3), atol=1e-9)
    omega = 2 * np.pi * np.fft.rfftfreq(samples, dt)
    lines = np.abs(np.fft.rfft(signal, axis=0)).sum(axis=1)
    inside = (omega >= 20.0) & (omega <= 120.0)
    assert lines[inside].min() > 1.0
    assert lines[~inside].max() < 1e-9


def test_noise_has_the_asked_ratio_in_each_record_and_channel():
    time = jnp.linspace(0.0, 200.0, 20000)
    clean = jnp.stack([jnp.sin(time), 100.0 * jnp.cos(3.0 * time)], axis=1)
    records = jnp.stack([clean, 1e-3 * clean])
    noise = np.asarray(add_noise(KEY, records, 30.0) - records)
    ratio = 10 * np.log10(np.asarray(records).var(axis=1) / noise.var(axis=1))
    # Standard deviation of the estimated ratio: 4.34 √(2 / N) = 0.043 dB.
    np.testing.assert_allclose(ratio, 30.0, atol=0.2)
    assert np.abs(np.corrcoef(noise[0].T)[0, 1]) < 0.03
    assert np.abs(noise.mean(axis=1) / noise.std(axis=1)).max() < 0.03
    mixed = np.asarray(add_noise(KEY, clean, jnp.array([20.0, 40.0])) - clean)
    ratio = 10 * np.log10(np.asarray(clean).var(axis=0) / mixed.var(axis=0))
    np.testing.assert_allclose(ratio, [20.0, 40.0], atol=0.2)


@pytest.mark.parametrize(
    ("call", "word"),
    [
        (lambda: prbs(KEY, 10, 1, hold=0), "hold=0"),
        (lambda: multisine(KEY, 100, 1, 1e-2, (10.0, 400.0)), "Nyquist"),
        (lambda: multisine(KEY, 100, 9, 1e-2, (10.0, 20.0)), "lines"),
        (lambda: add_noise(KEY, jnp.ones(4), 30.0), "y has shape"),
    ],
)
def test_impossible_signals_are_refused(call, word):
    with pytest.raises(ValueError, match=word):
        call()
