"""Periodic records: analytic sinusoids stay what they are, and what cannot be kept is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lpvid.data import IOData, PeriodicBand, preprocess

DT, SAMPLES = 0.01, 400  # lines every 0.25 Hz


def wave(lines, samples=SAMPLES, offset=0.0, scale=1.0):
    """Cosines on the given lines, each with its own size and phase, at any number of samples."""
    angle = 2 * np.pi * np.arange(samples)[:, None] * np.asarray(lines)[None] / samples
    size, phase = 1.0 + np.arange(len(lines)), 0.7 * np.arange(len(lines))
    return offset + scale * (size[None] * np.cos(angle + phase[None])).sum(axis=1)


def record(lines=(4, 9, 30), periods=1, **more):
    return IOData(
        u=np.tile(wave(lines), periods),
        y=np.tile(np.stack([wave(lines, scale=3.0), wave(lines, offset=5.0)], 1), (periods, 1)),
        dt=DT,
        **more,
    )


class TestResampling:
    @settings(max_examples=20, deadline=None)
    @given(
        st.sets(st.integers(4, 30), min_size=1, max_size=5),
        st.integers(61, 900),
        st.integers(1, 3),
    )
    def test_sinusoids_are_sampled_anew_exactly(self, lines, samples, periods):
        lines = sorted(lines)
        step = PeriodicBand(1.0, 7.5, samples_per_period=samples, periods=periods)
        clean, _ = preprocess(record(lines), step)
        assert clean.n_samples == samples * periods
        assert clean.dt * samples == pytest.approx(DT * SAMPLES, rel=1e-12)
        expected = np.tile(wave(lines, samples), periods)
        np.testing.assert_allclose(clean.u[:, 0], expected, atol=1e-11)
        np.testing.assert_allclose(clean.y[:, 0], 3 * expected, atol=1e-11)
        # The offset lies outside the band.
        np.testing.assert_allclose(clean.y[:, 1], expected, atol=1e-11)

    def test_only_the_band_is_kept_with_its_ends(self):
        data = IOData(u=wave((4, 9)), y=wave((3, 4, 9, 10), offset=2.0), dt=DT)
        clean, _ = preprocess(data, PeriodicBand(1, 2.25, periods=1))
        spectrum = np.abs(np.fft.rfft(clean.y[:, 0])) / SAMPLES * 2
        assert set(np.flatnonzero(spectrum > 1e-9)) == {4, 9}
        np.testing.assert_allclose(spectrum[[4, 9]], [2.0, 3.0], rtol=1e-12)

    def test_a_band_from_zero_keeps_the_mean(self):
        clean, _ = preprocess(record(), PeriodicBand(0.0, 7.5, samples_per_period=64))
        np.testing.assert_allclose(jnp.mean(clean.y[:, 1]), 5.0, rtol=1e-12)

    def test_recorded_periods_are_averaged(self):
        lines, noise = (4, 9, 30), 0.1 * np.cos(2 * np.pi * 20.5 * np.arange(800) / SAMPLES)
        data = IOData(u=np.tile(wave(lines), 2), y=np.tile(wave(lines), 2) + noise, dt=DT)
        step = PeriodicBand(1.0, 7.5, recorded_periods=2, periods=1)
        clean, _ = preprocess(data, step)
        assert clean.n_samples == SAMPLES
        # Half a line off, the disturbance changes sign from period to period.
        np.testing.assert_allclose(clean.y[:, 0], wave(lines), atol=1e-11)

    def test_a_constant_operating_point_stays_one(self):
        clean, _ = preprocess(record(kappa=0.3), PeriodicBand(1.0, 7.5, samples_per_period=64))
        np.testing.assert_allclose(clean.operating_point, [0.3], rtol=1e-12)

    def test_several_records_one_by_one(self):
        data = IOData(u=[wave((4,)), wave((9,))], y=[wave((9,)), wave((4,))], dt=DT)
        clean, _ = preprocess(data, PeriodicBand(1.0, 3.0, samples_per_period=50))
        assert clean.lengths == (100, 100)
        np.testing.assert_allclose(clean.records[1].u[:, 0], np.tile(wave((9,), 50), 2), atol=1e-11)


class TestUndo:
    @pytest.mark.parametrize("samples", [64, 101, SAMPLES, 900])
    @pytest.mark.parametrize("recorded", [1, 2])
    def test_untouched_data_come_back(self, samples, recorded):
        rng = np.random.default_rng(0)
        drift = 0.2 * rng.standard_normal((SAMPLES * recorded, 2))
        data = record(periods=recorded, kappa=[0.3])
        data = data.replace(u=data.u + 0.1 * drift[:, :1], y=data.y + drift)
        step = PeriodicBand(1.0, 7.5, samples_per_period=samples, recorded_periods=recorded)
        clean, undo = preprocess(data, step)
        back = undo(clean)
        assert back.dt == data.dt and back.lengths == data.lengths and back.names == data.names
        for ours, theirs in zip(jax.tree.leaves(back), jax.tree.leaves(data), strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-12)

    def test_output_is_the_last_period_at_the_recorded_rate(self):
        step = PeriodicBand(1.0, 7.5, samples_per_period=64, recorded_periods=3)
        _, undo = preprocess(record(periods=3), step)
        transient = np.concatenate([np.ones(64), wave((4, 30), 64)])
        output = undo.output(np.stack([transient, 2 * transient], 1))
        expected = np.tile(wave((4, 30)), 3)
        np.testing.assert_allclose(output, np.stack([expected, 2 * expected], 1), atol=1e-11)

    def test_output_of_another_length_is_refused(self):
        _, undo = preprocess(record(), PeriodicBand(1.0, 7.5, samples_per_period=64))
        with pytest.raises(ValueError, match=r"undo\.output"):
            undo.output(np.ones((64, 2)))


class TestTransformations:
    def test_works_under_jit_and_differentiates(self):
        step, data = PeriodicBand(1.0, 7.5, samples_per_period=64), record()
        expected = preprocess(data, step)[0]
        traced = jax.jit(lambda d: preprocess(d, step)[0])(data)
        np.testing.assert_allclose(traced.y, expected.y, atol=1e-12)

        def energy(scale):
            return jnp.sum(preprocess(data.replace(u=scale * data.u), step)[0].u ** 2)

        # Quadratic in the scale: the derivative at one is twice the value.
        np.testing.assert_allclose(jax.grad(energy)(1.0), 2 * energy(1.0), rtol=1e-12)


class TestFaults:
    @pytest.mark.parametrize(
        ("step", "message"),
        [
            (PeriodicBand(1.0, 50.0), "Nyquist frequency, 50 Hz"),
            (PeriodicBand(1.0, 7.5, samples_per_period=60), "alias.*at least 61"),
            (PeriodicBand(1.01, 1.2), "no line lies.*every 0.25 Hz"),
            (PeriodicBand(1.0, 7.5, recorded_periods=3), "no 3 whole periods"),
            (PeriodicBand(10.0, 12.0), "'u1' has nothing from 10 to 12 Hz"),
            (PeriodicBand(1.0, 7.5, recorded_periods=2), "'u1' does not repeat"),
        ],
    )
    def test_what_does_not_fit_the_record(self, step, message):
        with pytest.raises(ValueError, match=message):
            preprocess(record(lines=(5, 9, 30)), step)

    def test_records_of_different_lengths(self):
        data = IOData(u=[wave((4,)), wave((4,), 200)], y=[wave((4,)), wave((4,), 200)], dt=DT)
        with pytest.raises(ValueError, match="no period in common"):
            preprocess(data, PeriodicBand(1.0, 2.0))

    @pytest.mark.parametrize("band", [(-1.0, 2.0), (3.0, 2.0), (1.0, float("inf"))])
    def test_no_band(self, band):
        with pytest.raises(ValueError, match="is no band"):
            PeriodicBand(*band)

    @pytest.mark.parametrize("setting", ["samples_per_period", "periods", "recorded_periods"])
    def test_counts_from_one(self, setting):
        with pytest.raises(ValueError, match=f"{setting} is 0"):
            PeriodicBand(1.0, 2.0, **{setting: 0})
