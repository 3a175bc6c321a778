"""The library as a whole: names, grids, units, and a law of a user's own."""

import dataclasses
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import lpvid
from lpvid import effects
from lpvid.effects import LIBRARY, MEMORY, PORTS, Scales, Size, Units, at, fill, law

README = Path(__file__).resolve().parents[2] / "README.md"
FAMILIES = (
    "friction drag hysteresis stiffness backlash saturation gain delay lag mode gravity ripple "
    "disturbance bias drift sensor scheduling inertia"
).split()


def test_names_are_unique_and_families_complete():
    names = [one.name for one in LIBRARY]
    assert len(set(names)) == len(names)
    assert {one.family for one in LIBRARY} == set(FAMILIES)
    for one in LIBRARY:
        assert law(one.name) is one
        assert one.ports and set(one.ports) <= set(PORTS)
        assert one.memory <= MEMORY and 1 <= len(one.amplitudes) <= 2 and len(one.shapes) <= 2
        assert not one.whole or len(one.amplitudes) == 1
        assert not dataclasses.fields(one)


def test_unknown_names_are_answered_with_the_known_ones():
    with pytest.raises(ValueError, match="'colomb' is no law .* coulomb, stribeck"):
        law("colomb")


_lengths = st.one_of(st.just(0.0), st.floats(1e-10, 1e5))


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.tuples(_lengths, st.floats(1.0, 30.0), _lengths), min_size=6, max_size=6),
    st.floats(1e-5, 1.0),
    st.integers(20, 100_000),
)
def test_grids_lie_within_their_bounds_whatever_the_signals(sizes, dt, samples):
    scales = Scales(*(Size(r, r * c, n) for r, c, n in sizes), dt=dt, duration=dt * samples)
    for one in LIBRARY:
        grid, (lower, upper) = one.grid(scales), one.bounds(scales)
        assert grid.ndim == 2 and grid.shape[1] == len(one.shapes) == lower.size == upper.size
        assert 1 <= grid.shape[0] <= 32
        assert np.all(np.isfinite(grid)) and np.all(np.isfinite(upper))
        assert np.all(lower < upper), one.name
        assert np.all((lower < grid) & (grid < upper)), one.name


def test_a_width_never_runs_far_below_the_noise():
    size = Size(rms=1.0, peak=3.0, noise=0.05)
    scales = Scales(size, size, size, size, size, size, dt=0.01, duration=10.0)
    for name in ("coulomb", "stribeck", "asymmetric-coulomb", "load-dependent", "dahl"):
        assert law(name).bounds(scales)[0][0] >= 0.1 * size.noise


def test_dahl_and_bouc_wen_share_no_length():
    size = Size(rms=1.0, peak=3.0)
    scales = Scales(size, size, size, size, size, size, dt=0.01, duration=10.0)
    assert law("dahl").bounds(scales)[1][0] <= law("bouc-wen").bounds(scales)[0][0]


def test_lines_are_whole_periods():
    size = Size(rms=1.0, peak=3.0)
    scales = Scales(size, size, size, size, size, size, dt=0.01, duration=10.0)
    lines = law("periodic-disturbance").lines(scales)
    periods = lines * 10.0 / (2.0 * np.pi)
    np.testing.assert_allclose(periods, np.round(periods), atol=1e-9)
    assert lines[-1] < np.pi / 0.01
    grid = law("periodic-disturbance").grid(scales)[:, 0]
    assert np.isin(grid, lines).all()


@pytest.mark.parametrize(
    ("unit", "filled", "bare"),
    [
        ("{acts_on}", "N·m", "1"),
        ("{acts_on}/{position}^3", "N·m/rad^3", "1"),
        ("{acts_on}·s/{position}", "N·m·s/rad", "s"),
        ("{position}/s", "rad/s", "1/s"),
        ("1/{acts_on}^2", "1/(N·m)^2", "1"),
        ("{acts_on}/{time}", "N·m/s", "1/s"),
        ("1", "1", "1"),
    ],
)
def test_units(unit, filled, bare):
    assert fill(unit, Units("N·m", "rad")) == filled
    assert fill(unit, Units("")) == bare


def test_units_of_every_law_can_be_filled():
    for one in LIBRARY:
        for number in (*one.amplitudes, *one.shapes):
            assert "{" not in fill(number.unit, Units("V", "mm"))


def test_a_law_of_ones_own_in_ten_lines():
    # The README's, as it is printed there.
    (snippet,) = re.findall(r"```py\n(class .*?)\n\nfound", README.read_text(), flags=re.DOTALL)
    assert len([line for line in snippet.splitlines() if line]) <= 10
    namespace = {"lv": lpvid, "jnp": jnp}
    exec(compile(snippet, "README.md", "exec"), namespace)
    QuinticStiffness = namespace["QuinticStiffness"]

    library = (*LIBRARY, QuinticStiffness())
    own = law("quintic-stiffness", library)
    # As the engine uses it: hashable, switched among the others, differentiated.
    assert hash(own) == hash(QuinticStiffness()) and own == QuinticStiffness()
    branches = [
        lambda q, one=one: one.regressors(at(position=q), jnp.ones(2), jnp.zeros(2))[0]
        for one in (law("cubic-stiffness"), own)
    ]
    value, slope = jax.jvp(lambda q: jax.lax.switch(jnp.asarray(1), branches, q), (2.0,), (1.0,))
    assert float(value) == -32.0 and float(slope) == -80.0


def test_a_law_that_lacks_something_cannot_be_made():
    class Nameless(effects.AbstractShapelessLaw):
        family = "stiffness"
        ports = ("force",)
        amplitudes = (effects.Amplitude("k", "1"),)
        whole = False

        def regressors(self, signals, shape, memory):
            return jnp.stack([signals.position])

    with pytest.raises(TypeError, match="name"):
        Nameless()
