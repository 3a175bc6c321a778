"""IOData: what goes in, what comes out, what is refused."""

import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpvid.data import IOData, join


def ramp(samples, channels, start=0.0):
    return start + np.arange(samples * channels, dtype=float).reshape(samples, channels)


def single(samples=20, **options):
    return IOData(u=ramp(samples, 2), y=ramp(samples, 1, 100.0), dt=0.1, **options)


def several(lengths=(5, 7, 6), **options):
    u = [ramp(n, 2, 1000.0 * n) for n in lengths]
    y = [ramp(n, 1, -1000.0 * n) for n in lengths]
    return IOData(u=u, y=y, dt=0.1, **options)


class TestConstruction:
    def test_one_dimensional_signals_become_single_channels(self):
        data = IOData(u=np.arange(4), y=jnp.arange(4.0), dt=0.5)
        assert data.u.shape == data.y.shape == (4, 1)
        assert data.u.dtype == jnp.float64
        assert (data.nu, data.ny, data.nk, data.n_samples, data.lengths) == (1, 1, 0, 4, (4,))
        assert data.kappa is None
        np.testing.assert_array_equal(data.time, [0.0, 0.5, 1.0, 1.5])

    def test_three_axes_are_records_of_equal_length(self):
        u = np.arange(24.0).reshape(2, 6, 2)
        data = IOData(u=u, y=u[:, :, :1], dt=1.0)
        assert data.lengths == (6, 6)
        np.testing.assert_array_equal(data.u, u.reshape(12, 2))
        np.testing.assert_array_equal(data.records[1].y, u[1, :, :1])
        np.testing.assert_array_equal(data.time, np.tile(np.arange(6.0), 2))

    def test_a_list_is_records_of_any_length(self):
        data = several()
        assert data.lengths == (5, 7, 6)
        assert data.u.shape == (18, 2)
        assert [record.n_samples for record in data.records] == [5, 7, 6]
        np.testing.assert_array_equal(data.records[1].u, ramp(7, 2, 7000.0))

    def test_a_list_of_numbers_is_one_record(self):
        assert IOData(u=[1.0, 2.0, 3.0], y=[1, 2, 3], dt=1.0).u.shape == (3, 1)

    @pytest.mark.parametrize(
        "kappa, expected",
        [
            (0.3, np.full((20, 1), 0.3)),
            (np.array([0.3, 0.4]), np.tile([0.3, 0.4], (20, 1))),
            ([0.3, 0.4], np.tile([0.3, 0.4], (20, 1))),
            (np.arange(20.0), np.arange(20.0)[:, None]),
            (ramp(20, 3), ramp(20, 3)),
        ],
    )
    def test_scheduling_of_one_record(self, kappa, expected):
        np.testing.assert_array_equal(single(kappa=kappa).kappa, expected)

    @pytest.mark.parametrize(
        "kappa, expected",
        [
            (0.3, [0.3, 0.3, 0.3]),
            ([0.1, 0.2, 0.3], [0.1, 0.2, 0.3]),
            (np.array([0.1, 0.2, 0.3]), [0.1, 0.2, 0.3]),
            (np.array([[0.1], [0.2], [0.3]]), [0.1, 0.2, 0.3]),
            ([np.full(5, 0.1), 0.2, np.full((6, 1), 0.3)], [0.1, 0.2, 0.3]),
        ],
    )
    def test_scheduling_of_several_records(self, kappa, expected):
        data = several(kappa=kappa)
        np.testing.assert_array_equal(data.kappa[:, 0], np.repeat(expected, data.lengths))
        points = [record.operating_point[0] for record in data.records]
        np.testing.assert_array_equal(points, expected)

    def test_labels(self):
        data = single(kappa=0.1, names={"u": ("torque", "force"), "y": "angle"}, units={"y": "rad"})
        assert data.names == {"u": ("torque", "force"), "y": ("angle",), "kappa": ("kappa1",)}
        assert data.units == {"u": ("", ""), "y": ("rad",), "kappa": ("",)}

    def test_repr(self):
        u = np.zeros((2, 3000, 2))
        data = IOData(u=u, y=u, dt=1e-3, kappa=0.3)
        assert repr(data) == (
            "IOData(3000 samples x 2 records, 2 inputs (u1, u2), 2 outputs (y1, y2), kappa 1, "
            "dt=0.001 s)"
        )
        assert repr(single()) == "IOData(20 samples, 2 inputs (u1, u2), 1 output (y1), dt=0.1 s)"
        assert repr(several()).startswith("IOData(5 + 7 + 6 samples, ")


GOOD = np.zeros((10, 2))
NAN = np.where(np.arange(20).reshape(10, 2) == 13, np.nan, 0.0)


class TestRefusals:
    @pytest.mark.parametrize(
        "changes, message",
        [
            (dict(u=np.zeros((3, 1000))), r"u has 1000 channels but only 3 samples.*transpose"),
            (dict(y=np.zeros((9, 2))), r"y has 9 samples but u has 10.*cut the longer"),
            (dict(u=np.zeros((1, 1))), r"u has 1 sample.*2 or more"),
            (dict(u=np.zeros((10, 0))), r"u has shape \(10, 0\), so no channel"),
            (dict(u=np.zeros((1, 2, 3, 4))), r"u has shape \(1, 2, 3, 4\)"),
            (dict(u=[]), r"u is empty"),
            (dict(u=np.zeros((0, 5, 1))), r"so no record"),
            (dict(u=[[1.0, 2.0], [3.0, 4.0]]), r"u is a nested list.*numpy\.asarray"),
            (dict(u=GOOD * 1j), r"u holds complex128 values"),
            (dict(u=jnp.zeros((10, 2), complex)), r"u holds complex128 values"),
            (dict(u=np.array([["a", "b"]] * 10)), r"u holds <U1 values"),
            (dict(u=[GOOD, GOOD]), r"y has 1 record\(s\) but u has 2"),
            (dict(u=[GOOD, GOOD], y=[GOOD, GOOD[:9]]), r"9 samples but u has 10 in record 1"),
            (dict(u=[GOOD, GOOD[:, :1]], y=[GOOD, GOOD]), r"u\[1\] has 1 channel.*u\[0\] has 2"),
            (dict(dt=0.0), r"dt is 0\.0: give the sample time in seconds"),
            (dict(dt=-1.0), r"dt is -1\.0"),
            (dict(dt=np.nan), r"dt is nan"),
            (dict(y=NAN), r"y is not finite: channel 'y2', sample 6 is nan"),
            (dict(u=[GOOD, NAN], y=[GOOD] * 2), r"u is not finite.*'u2', sample 6 of record 1"),
            (dict(kappa=np.inf), r"kappa is not finite: channel 'kappa1', sample 0 is inf"),
            (dict(u=np.ma.masked_greater(ramp(10, 2), 18.5)), r"u is not finite.*sample 9"),
            (dict(kappa=np.zeros(100)), r"kappa has 100 entries: neither the record's 10 samples"),
            (dict(kappa=np.zeros((9, 1))), r"kappa has 9 samples but u has 10"),
            (dict(kappa=np.zeros((2, 10, 1))), r"kappa has 2 entries.*1 records"),
            (
                dict(u=[GOOD] * 2, y=[GOOD] * 2, kappa=[0.1, 0.2, 0.3]),
                r"kappa has 3 entries along its first axis but there are 2 records",
            ),
            (dict(names={"u": "one"}), r"names\['u'\] has 1 entries but u has 2"),
            (dict(names={"u": ("a", "a")}), r"names\['u'\] repeats a name"),
            (dict(names={"x": "a"}), r"names has the keys \['x'\]"),
            (dict(units={"kappa": "m"}), r"units\['kappa'\] has 1 entries but kappa has 0"),
        ],
    )
    def test_bad_input(self, changes, message):
        with pytest.raises(ValueError, match=message):
            IOData(**{"u": GOOD, "y": GOOD, "dt": 0.1, **changes})

    def test_traced_sample_time(self):
        with pytest.raises(ValueError, match="dt is traced"):
            jax.jit(lambda dt: IOData(u=GOOD, y=GOOD, dt=dt).u)(0.1)


class TestViews:
    def test_slices(self):
        data = single(kappa=np.arange(20.0))[5:-5]
        assert data.n_samples == 10
        np.testing.assert_array_equal(data.u, ramp(20, 2)[5:15])
        np.testing.assert_array_equal(data.kappa[:, 0], np.arange(5.0, 15.0))
        assert data[:100].n_samples == 10

    @pytest.mark.parametrize(
        "index, message",
        [
            (slice(0, 10, 2), r"would alias: use preprocess"),
            (3, r"index time by a slice"),
            (slice(4, 5), r"leaves 1 of 20 samples"),
            (slice(30, 50), r"leaves 0 of 20 samples"),
        ],
    )
    def test_bad_slices(self, index, message):
        with pytest.raises(ValueError, match=message):
            single()[index]

    def test_slicing_several_records_is_refused(self):
        with pytest.raises(ValueError, match=r"single record, but there are 3.*data\.records"):
            several()[0:3]

    def test_split(self):
        first, rest = single().split(0.25)
        assert (first.n_samples, rest.n_samples) == (5, 15)
        np.testing.assert_array_equal(np.concatenate([first.y, rest.y]), single().y)
        first, rest = several(kappa=0.2).split(3)
        assert (first.lengths, rest.lengths) == ((3, 3, 3), (2, 4, 3))
        np.testing.assert_array_equal(rest.records[1].u, ramp(7, 2, 7000.0)[3:])
        assert single().split(-4)[1].n_samples == 4

    @pytest.mark.parametrize("at", [0.0, 1.0, 1.5, -0.5])
    def test_split_outside_the_record(self, at):
        with pytest.raises(ValueError, match=r"split: the fraction .* between 0 and 1"):
            single().split(at)

    @pytest.mark.parametrize("at", [0, 1, 4, 40, 0.01])
    def test_split_too_near_an_end(self, at):
        with pytest.raises(ValueError, match=r"split: .* fewer than 2 samples.*record 0"):
            several().split(at)

    def test_join_takes_records_together_again(self):
        data = several(kappa=[0.1, 0.2, 0.3])
        assert eqx.tree_equal(join(data.records), data)
        assert join([single()]).lengths == (20,)

    @pytest.mark.parametrize(
        "other, message",
        [
            (IOData(u=GOOD, y=GOOD[:, 0], dt=0.2), r"part 1 has dt=0\.2 s but part 0 has dt=0\.1"),
            (IOData(u=GOOD, y=GOOD, dt=0.1), r"part 1 has the names .*data\.select"),
            (single(kappa=0.1), r"part 1 has the names"),
            (single(units={"y": "m"}), r"part 1 has the units"),
        ],
    )
    def test_join_refuses(self, other, message):
        with pytest.raises(ValueError, match=message):
            join([single(), other])

    def test_join_of_nothing(self):
        with pytest.raises(ValueError, match="no data given"):
            join([])

    def test_select(self):
        data = several(kappa=0.1, names={"u": ("a", "b")}, units={"u": ("V", "A")})
        chosen = data.select(inputs=("b", "a"))
        np.testing.assert_array_equal(chosen.u, data.u[:, ::-1])
        assert (chosen.input_names, chosen.input_units) == (("b", "a"), ("A", "V"))
        assert chosen.lengths == data.lengths
        only = data.select(inputs="b", scheduling=())
        assert (only.nu, only.kappa, only.nk) == (1, None, 0)
        with pytest.raises(ValueError, match=re.escape("inputs: no channel 'c'; there are a, b")):
            data.select(inputs="c")

    def test_replace(self):
        data = several(kappa=0.1, names={"u": ("a", "b"), "y": "angle"})
        doubled = data.replace(y=2 * data.y)
        np.testing.assert_array_equal(doubled.y, 2 * data.y)
        assert doubled.lengths == data.lengths and doubled.names == data.names
        assert eqx.tree_equal(data.replace(y=list(jnp.split(data.y, [5, 12]))), data)
        wider = data.replace(u=np.ones((18, 3)))
        assert wider.input_names == ("u1", "u2", "u3")
        assert data.replace(units={"y": "rad"}, dt=2.0).output_units == ("rad",)
        scheduled = data.replace(kappa=[1.0, 2.0, 3.0])
        np.testing.assert_array_equal(scheduled.kappa[:, 0], np.repeat([1.0, 2.0, 3.0], (5, 7, 6)))
        with pytest.raises(ValueError, match="y has 1 record"):
            data.replace(y=np.ones(17))

    def test_operating_point(self):
        np.testing.assert_array_equal(single(kappa=[0.3, 2.0]).operating_point, [0.3, 2.0])
        with pytest.raises(ValueError, match="no kappa"):
            _ = single().operating_point
        with pytest.raises(ValueError, match=r"'kappa1' varies by 19 within the record"):
            _ = single(kappa=np.arange(20.0)).operating_point
        with pytest.raises(ValueError, match="operating_point needs a single record"):
            _ = several(kappa=0.1).operating_point


class TestPytree:
    def test_leaves_and_static_fields(self):
        data = several(kappa=0.1)
        assert len(jax.tree.leaves(data)) == 3
        assert len(jax.tree.leaves(several())) == 2
        negative = jax.tree.map(lambda x: -x, data)
        np.testing.assert_array_equal(negative.u, -data.u)
        assert negative.lengths == data.lengths

    def test_unflattening_does_not_validate(self):
        broken = jax.tree.map(lambda x: x.at[0, 0].set(jnp.nan), single())
        assert bool(jnp.isnan(broken.u[0, 0]))
        assert repr(jax.tree.map(lambda _: "leaf", single())) == repr(single())

    def test_methods_under_jit(self):
        @jax.jit
        def energy(data):
            first, rest = data.split(0.5)
            whole = join([first, rest]).select(inputs="u2")
            return jnp.sum(whole.u**2) + jnp.sum(data[2:4].y) + data.operating_point[0]

        data = single(kappa=0.5)
        expected = np.sum(data.u[:, 1] ** 2) + np.sum(data.y[2:4]) + 0.5
        np.testing.assert_allclose(energy(data), expected, rtol=1e-14)

    def test_construction_under_vmap_and_grad(self):
        def mean_square(scale):
            data = IOData(u=scale * ramp(4, 1), y=ramp(4, 1), dt=0.1, kappa=[scale, scale])
            return jnp.mean(data.u**2) + jnp.sum(data.operating_point)

        scales = jnp.array([1.0, 2.0, 3.0])
        expected = [s**2 * 3.5 + 2 * s for s in (1.0, 2.0, 3.0)]
        np.testing.assert_allclose(jax.vmap(mean_square)(scales), expected)
        np.testing.assert_allclose(jax.grad(mean_square)(2.0), 2 * 2.0 * 3.5 + 2)

    def test_a_batch_of_records_as_leaves(self):
        batch = jax.tree.map(lambda x: jnp.stack([x, 2 * x]), single(kappa=0.5))
        sums = jax.vmap(lambda data: jnp.sum(data[0:10].u))(batch)
        np.testing.assert_allclose(sums, np.array([1.0, 2.0]) * np.sum(ramp(20, 2)[:10]))
        assert (batch.nu, batch.n_samples) == (2, 20)
