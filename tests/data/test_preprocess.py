"""Preprocessing: what each step does, and that it can be undone."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st

from lpvid.data import Decimate, Detrend, IOData, Lowpass, Scale, join, preprocess

DT = 0.01


def noisy(lengths=(400, 331), kappa=0.3, seed=0):
    rng = np.random.default_rng(seed)
    u = [5.0 + rng.standard_normal((n, 2)) for n in lengths]
    y = [1e3 * np.linspace(1, 2, n)[:, None] + 50 * rng.standard_normal((n, 3)) for n in lengths]
    return IOData(
        u=u,
        y=y,
        dt=DT,
        kappa=kappa,
        names={"u": ("a", "b")},
        units={"u": ("V", "A"), "y": ("m",) * 3},
    )


def tones(frequencies, samples=2000, dt=DT):
    time = dt * np.arange(samples)
    waves = np.stack([np.cos(2 * np.pi * f * time + 0.3) for f in frequencies], axis=1)
    return IOData(u=waves, y=waves, dt=dt)


def assert_same(actual, expected):
    assert actual.lengths == expected.lengths and actual.dt == expected.dt
    assert actual.names == expected.names and actual.units == expected.units
    for ours, theirs in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-15 * np.abs(theirs).max() * 8)


STEPS = (Detrend(order=1), Scale("range"), Lowpass(12.0), Decimate(3))


class TestUndo:
    @pytest.mark.parametrize(
        "steps", [(), *[(step,) for step in STEPS], *itertools.permutations(STEPS, 4)]
    )
    def test_untouched_data_come_back(self, steps):
        data = noisy()
        processed, undo = preprocess(data, *steps)
        assert_same(undo(processed), data)

    @settings(max_examples=6, deadline=None)
    @given(
        st.lists(st.integers(150, 300), min_size=1, max_size=3),
        st.integers(1, 5),
        st.floats(1.0, 9.0),
        st.integers(1, 6),
    )
    def test_any_lengths_and_settings(self, lengths, factor, cutoff, order):
        data = noisy(tuple(lengths), kappa=None)
        processed, undo = preprocess(data, Lowpass(cutoff, order=order), Decimate(factor))
        assert processed.lengths == tuple(-(-n // factor) for n in lengths)
        assert_same(undo(processed), data)

    def test_a_change_comes_back_in_the_original_units(self):
        data = noisy()
        processed, undo = preprocess(data, Detrend(), Scale("peak"))
        restored = undo(processed.replace(y=2 * processed.y))
        means = jnp.concatenate(
            [jnp.broadcast_to(r.y.mean(axis=0)[None], r.y.shape) for r in data.records]
        )
        np.testing.assert_allclose(restored.y, 2 * data.y - means, rtol=1e-12)

    def test_is_a_pytree(self):
        processed, undo = preprocess(noisy(), *STEPS)
        same = jax.tree.map(lambda x: x, undo)
        np.testing.assert_array_equal(same(processed).y, undo(processed).y)

    def test_steps_repeat_on_other_data_with_the_same_factors(self):
        train, test = noisy().split(0.5)
        clean, undo = preprocess(train, Lowpass(10.0), Scale())
        again, _ = preprocess(test, *undo.steps)
        filtered, _ = preprocess(test, Lowpass(10.0))
        factor = np.asarray(preprocess(train, Lowpass(10.0))[0].y).std(axis=0)
        np.testing.assert_allclose(again.y, np.asarray(filtered.y) / factor, rtol=1e-12)
        np.testing.assert_allclose(preprocess(train, *undo.steps)[0].y, clean.y, rtol=1e-15)

    @pytest.mark.parametrize("step", [Detrend(), Lowpass(10.0), Decimate(2)])
    def test_other_records_are_refused(self, step):
        processed, undo = preprocess(noisy(), step)
        with pytest.raises(ValueError, match=rf"undo: {type(step).__name__} produced records of"):
            undo(processed.records[0])
        with pytest.raises(ValueError, match=r"with 2 input\(s\) and 3 output\(s\)"):
            undo(processed.select(inputs="a"))
        with pytest.raises(ValueError, match=r"undo\.output: y has shape \(9, 3\)"):
            undo.output(np.zeros((9, 3)))

    def test_scale_needs_its_channels_only(self):
        data = noisy()
        processed, undo = preprocess(data, Scale())
        assert_same(undo(processed.records[1]), data.records[1])
        with pytest.raises(ValueError, match="Scale has factors for 2 input"):
            undo(processed.select(inputs="a"))
        with pytest.raises(ValueError, match=r"y has 1 channel\(s\) but Scale has 3"):
            undo.output(np.zeros(5))

    def test_output_axes(self):
        with pytest.raises(ValueError, match=r"y has shape \(2, 3, 4\)"):
            preprocess(noisy())[1].output(np.zeros((2, 3, 4)))


class TestOutput:
    def test_units_rate_and_trend_return_but_not_what_filters_removed(self):
        slow = tones([1.0, 2.0, 3.0], 3000)
        drift = np.linspace(10.0, 30.0, 3000)[:, None]
        hiss = 0.5 * np.asarray(tones([40.0], 3000).u)
        data = IOData(u=slow.u, y=slow.y + drift + hiss, dt=DT)
        processed, undo = preprocess(
            data, Detrend(order=1), Lowpass(20.0, order=8), Decimate(5), Scale()
        )
        inner = slice(300, -300)
        y_hat = undo.output(processed.y)
        assert y_hat.shape == data.y.shape
        np.testing.assert_allclose(y_hat[inner], (slow.y + drift)[inner], atol=5e-3)
        without = undo.output(processed.y, trend=False)
        line = scipy.signal.detrend(np.asarray(data.y), axis=0)
        np.testing.assert_allclose(without[inner], line[inner] - hiss[inner], atol=5e-3)

    def test_one_dimensional_output(self):
        data = tones([1.0])
        processed, undo = preprocess(data, Scale("peak"))
        np.testing.assert_allclose(undo.output(processed.y[:, 0]), data.y, rtol=1e-15)


class TestDetrend:
    @pytest.mark.parametrize("order, kind", [(0, "constant"), (1, "linear")])
    def test_against_scipy(self, order, kind):
        data = noisy()
        processed, _ = preprocess(data, Detrend(order=order))
        for ours, raw in zip(processed.records, data.records, strict=True):
            for key in ("u", "y"):
                expected = scipy.signal.detrend(np.asarray(getattr(raw, key)), axis=0, type=kind)
                np.testing.assert_allclose(getattr(ours, key), expected, atol=1e-10)
        np.testing.assert_array_equal(processed.kappa, data.kappa)

    def test_order(self):
        with pytest.raises(ValueError, match="Detrend: order is 2"):
            Detrend(order=2)


class TestScale:
    @pytest.mark.parametrize(
        "kind, size",
        [
            ("std", lambda x: x.std(axis=0)),
            ("range", lambda x: np.ptp(x, axis=0)),
            ("peak", lambda x: np.abs(x).max(axis=0)),
        ],
    )
    def test_size_becomes_one_over_all_records(self, kind, size):
        processed, _ = preprocess(noisy(), Scale(kind))
        np.testing.assert_allclose(size(np.asarray(processed.u)), np.ones(2), rtol=1e-12)
        np.testing.assert_allclose(size(np.asarray(processed.y)), np.ones(3), rtol=1e-12)
        assert processed.output_units == ("", "", "")

    def test_given_factors(self):
        data = noisy()
        processed, _ = preprocess(data, Scale(u=2.0, y=np.array([1.0, 2.0, 4.0])))
        np.testing.assert_allclose(processed.u, data.u / 2)
        np.testing.assert_allclose(processed.y, np.asarray(data.y) / np.array([1.0, 2.0, 4.0]))
        with pytest.raises(ValueError, match="Scale: y has 2 factors but the data has 3"):
            preprocess(data, Scale(y=np.array([1.0, 2.0])))

    def test_a_still_channel_stays(self):
        data = IOData(u=np.ones((9, 1)), y=np.zeros((9, 1)), dt=DT)
        for kind in ("std", "range"):
            processed, undo = preprocess(data, Scale(kind))
            np.testing.assert_array_equal(processed.u, data.u)
            np.testing.assert_array_equal(undo(processed).y, data.y)

    def test_kind(self):
        with pytest.raises(ValueError, match="Scale: kind is 'variance': one of std"):
            Scale("variance")

    def test_gradient_through_detrend_and_scale(self):
        data = noisy((30,))

        def loss(y):
            processed, undo = preprocess(data.replace(y=y), Detrend(order=1), Scale())
            return jnp.sum(processed.y[:7] ** 3) + jnp.sum(undo(processed).y * 1e-3)

        gradient = jax.jit(jax.grad(loss))(data.y)
        step = 1e-4
        for place in [(0, 0), (13, 1), (29, 2)]:
            up, down = loss(data.y.at[place].add(step)), loss(data.y.at[place].add(-step))
            np.testing.assert_allclose(gradient[place], (up - down) / (2 * step), rtol=1e-6)

    def test_gradient_is_finite_for_a_still_channel(self):
        def size(y):
            return jnp.sum(preprocess(IOData(u=y, y=y, dt=DT), Scale())[0].y)

        assert np.isfinite(jax.grad(size)(jnp.ones((9, 1)))).all()


class TestLowpass:
    def test_attenuation_of_tones(self):
        frequencies = [1.0, 5.0, 10.0, 20.0]
        data = tones(frequencies)
        processed, _ = preprocess(data, Lowpass(10.0, order=4))
        # Pre-warped bilinear Butterworth, run twice: 1 / (1 + (tan / tan)^2n), no phase.
        warp = np.tan(np.pi * np.array(frequencies) * DT) / np.tan(np.pi * 10.0 * DT)
        inner = slice(300, -300)
        np.testing.assert_allclose(
            processed.y[inner], np.asarray(data.y)[inner] / (1 + warp**8), atol=1e-6
        )

    def test_plant_and_scheduling_are_unchanged(self):
        rng = np.random.default_rng(1)
        u = rng.standard_normal(3000)
        y = scipy.signal.lfilter([0.0, 0.2], [1.0, -0.8], u)
        data = IOData(u=u, y=y, dt=DT, kappa=np.linspace(0, 1, 3000))
        processed, _ = preprocess(data, Lowpass(15.0))
        again = scipy.signal.lfilter([0.0, 0.2], [1.0, -0.8], np.asarray(processed.u[:, 0]))
        np.testing.assert_allclose(processed.y[200:-200, 0], again[200:-200], atol=1e-9)
        np.testing.assert_array_equal(processed.kappa, data.kappa)

    @pytest.mark.parametrize(
        "make, message",
        [
            (lambda: Lowpass(50.0).apply(noisy()), "cutoff_hz=50 is not below the Nyquist.*50 Hz"),
            (lambda: Lowpass(0.0), "cutoff_hz is 0.0"),
            (lambda: Lowpass(1.0, order=0), "order is 0"),
            (lambda: Lowpass(1.0).apply(noisy((10,))), "shortest record has 10 samples"),
            (
                lambda: jax.jit(lambda d: Lowpass(1.0).apply(d)[0].y)(noisy()),
                "Lowpass filters through SciPy and is not differentiable",
            ),
        ],
    )
    def test_refusals(self, make, message):
        with pytest.raises(ValueError, match=message):
            make()


class TestDecimate:
    @pytest.mark.parametrize("factor", [2, 5, 10])
    def test_pass_band_survives_and_stop_band_goes(self, factor):
        nyquist = 0.5 / (DT * factor)
        data = tones([0.1 * nyquist, 0.5 * nyquist, 0.8 * nyquist], 4000)
        inner = slice(400 // factor, -400 // factor)
        processed, _ = preprocess(data, Decimate(factor))
        assert processed.dt == pytest.approx(DT * factor)
        expected = np.asarray(data.y)[::factor]
        np.testing.assert_allclose(processed.y[inner], expected[inner], atol=2e-4)
        above = [f for f in (1.0 * nyquist, 1.3 * nyquist, 1.9 * nyquist) if f < 0.5 / DT]
        gone, _ = preprocess(tones(above, 4000), Decimate(factor))
        assert np.abs(gone.y[inner]).max() < 2e-4

    def test_band_limited_output_is_interpolated(self):
        data = tones([0.5, 3.0, 7.0], 4000)
        processed, undo = preprocess(data, Decimate(5))
        y_hat = undo.output(processed.y)
        np.testing.assert_allclose(y_hat[300:-300], data.y[300:-300], atol=4e-4)

    def test_constants_and_lines_pass_to_the_ends(self):
        n = 301
        line = np.linspace(-1.0, 2.0, n)
        data = IOData(u=np.full(n, 3.0), y=line, dt=DT, kappa=0.3)
        processed, undo = preprocess(data, Decimate(4))
        np.testing.assert_allclose(processed.u, 3.0, rtol=1e-13)
        np.testing.assert_allclose(processed.y[:, 0], line[::4], atol=1e-12)
        np.testing.assert_allclose(processed.operating_point, 0.3, rtol=1e-13)
        np.testing.assert_allclose(undo.output(np.full(76, 3.0)), 3.0, rtol=1e-13)

    def test_records_do_not_leak_into_each_other(self):
        one, two = noisy((200,), seed=1), noisy((333,), seed=2)
        both, _ = preprocess(join([one, two]), Decimate(3))
        alone = join([preprocess(part, Decimate(3))[0] for part in (one, two)])
        np.testing.assert_array_equal(both.y, alone.y)
        assert both.lengths == alone.lengths == (67, 111)

    def test_factor_one_changes_nothing(self):
        data = noisy((100,))
        np.testing.assert_array_equal(preprocess(data, Decimate(1))[0].y, data.y)

    @pytest.mark.parametrize(
        "make, message",
        [
            (lambda: Decimate(0), "factor is 0"),
            (lambda: Decimate(10).apply(noisy((270,))), "has 270 samples.*needs more than 270"),
            (
                lambda: jax.grad(lambda y: Decimate(2).apply(noisy().replace(y=y))[0].y.sum())(
                    noisy().y
                ),
                "Decimate filters through SciPy",
            ),
        ],
    )
    def test_refusals(self, make, message):
        with pytest.raises(ValueError, match=message):
            make()
