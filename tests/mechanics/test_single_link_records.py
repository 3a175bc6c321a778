"""Experiments of Sun 2000: commands, travel, labels; what closed loops do about friction."""

import jax
import numpy as np
import pytest

from lpvid.mechanics import (
    ArmEffects,
    DryFriction,
    ProportionalDerivative,
    Quantisation,
    bounded_position_record,
    closed_loop_record,
    open_loop_record,
    reference_single_link_arm,
    simulate_single_link,
)

# Every experiment compiles a closed loop; `test_single_link_simulation` runs the same arm.
pytestmark = pytest.mark.slow

ARM = reference_single_link_arm()
KEY = jax.random.key(5)
STICKY = ArmEffects(friction=DryFriction(0.4))
EXCITATIONS = ("square", "periodic random", "varying square", "random")
# Coarse steps are enough to see where the arm goes.
LONG = {"duration": 20.0, "substeps": 3}


@pytest.fixture(scope="module")
def open_loop():
    return {e: open_loop_record(ARM, KEY, excitation=e, **LONG) for e in EXCITATIONS}


def test_records_are_labelled(open_loop):
    data = open_loop["square"]
    assert data.dt == 1 / 300
    assert (data.input_names, data.input_units) == (("command",), ("V",))
    assert data.output_names == ("hub angle", "base strain", "middle strain", "tachometer")
    assert data.output_units == ("V",) * 4
    assert data.u.shape == (6000, 1) and data.y.shape == (6000, 4)


def test_open_loop_commands_are_those_of_the_thesis(open_loop):
    u = {e: np.asarray(d.u)[:, 0] for e, d in open_loop.items()}
    turns = {e: np.flatnonzero(np.diff(np.sign(s))) + 1 for e, s in u.items()}
    for name in ("square", "varying square"):
        np.testing.assert_array_equal(np.abs(u[name]), 2.0)
    # 0.5 Hz: after the first half pulse one second each.
    np.testing.assert_array_equal(turns["square"], 150 + 300 * np.arange(20))
    np.testing.assert_array_equal(turns["periodic random"], turns["square"])
    widths = np.diff(turns["varying square"]) / 300
    assert widths.min() > 0.5 / 3.0 - 0.01 and widths.max() < 0.5 / 0.6 + 0.01
    assert widths.std() > 0.05
    for name in ("periodic random", "random"):
        levels = np.abs(u[name]).reshape(-1, 3)
        np.testing.assert_array_equal(levels, levels[:, :1] * np.ones(3))
        assert levels.max() < 2.5 and 0.85 < levels.mean() < 1.15
    assert np.abs(u["random"].reshape(-1, 300).mean(axis=1)).max() < 1e-12
    assert len(turns["random"]) > 500


def test_the_defaults_stay_within_the_travel(open_loop):
    # Beyond ±80° the record would have warned, and warnings are errors here.
    for data in open_loop.values():
        assert np.abs(data.y[:, 0]).max() * 35 / 3 < 80.0
    other = open_loop_record(ARM, jax.random.key(6), excitation="random", **LONG)
    assert not np.array_equal(other.u, open_loop["random"].u)


def test_bounded_position_turns_where_the_angle_passes_the_bound():
    data = bounded_position_record(ARM, KEY, **LONG)
    u, angle = np.asarray(data.u)[:, 0], np.asarray(data.y)[:, 0]
    np.testing.assert_array_equal(np.abs(u), 3.0)
    turns = np.flatnonzero(np.diff(u)) + 1
    assert u[0] > 0 and len(turns) > 8
    for turn in turns:
        # The first sample beyond the bound, on the side that it was driven to.
        side = -np.sign(u[turn])
        assert side * angle[turn] > 3.0 >= side * angle[turn - 1]
    varied = np.abs(bounded_position_record(ARM, KEY, random_size=True, **LONG).u[:, 0])
    np.testing.assert_array_equal(varied.reshape(-1, 30)[:, 0], varied.reshape(-1, 30)[:, -1])
    assert varied.max() <= 3.0 and 1.3 < varied.mean() < 1.7


def test_closed_loop_sticks_short_of_its_goal_unless_compensated():
    long = {"duration": 15.0, "substeps": 3, "effects": STICKY}
    plain = closed_loop_record(ARM, KEY, **long)
    helped = closed_loop_record(ARM, KEY, compensation=0.8, **long)
    settled = 300 * 5 - 1
    # Held anywhere in |kp (R − y)| · 0.5 A/V < 0.4 A, and seen to stop well short.
    assert 0.2 < 3.0 - plain.y[settled, 0] <= 0.8
    assert abs(3.0 - helped.y[settled, 0]) < 0.05
    assert helped.y[2 * settled, 0] < -2.9
    kept = closed_loop_record(ARM, KEY, compensation=0.8, keep_compensation=True, **long)
    np.testing.assert_array_equal(kept.y, helped.y)
    u = np.asarray(kept.u)
    np.testing.assert_allclose(helped.u, u - 0.8 * np.sign(u), atol=1e-12)
    asked = 3.0 * np.where(np.arange(4500) % 3000 < 1500, 1, -1)
    effort = asked - np.asarray(helped.y) @ np.array([1.0, 0.0, 0.0, 2.8])
    np.testing.assert_allclose(helped.u[:, 0], effort, atol=1e-9)


def test_varying_references_have_the_thesis_periods():
    data = closed_loop_record(
        ARM, KEY, reference="varying square", duration=15.0, substeps=3, effects=STICKY
    )
    reference = np.asarray(data.u)[:, 0] + np.asarray(data.y) @ np.array([1.0, 0.0, 0.0, 2.8])
    np.testing.assert_allclose(np.abs(reference), 3.0, atol=1e-9)
    widths = np.diff(np.flatnonzero(np.diff(np.sign(reference)))) / 300
    assert widths.min() > 1.25 - 0.01 and widths.max() < 2.5 + 0.01


def test_records_repeat_with_their_key_and_draw_their_noise_from_it():
    effects = ArmEffects(noise=0.01, quantisation=Quantisation())
    options = {"duration": 1.0, "effects": effects, "substeps": 3}
    first = open_loop_record(ARM, KEY, **options)
    again = open_loop_record(ARM, KEY, **options)
    other = open_loop_record(ARM, jax.random.key(6), **options)
    np.testing.assert_array_equal(first.y, again.y)
    np.testing.assert_array_equal(first.u, other.u)
    assert 0.012 < np.std(first.y - other.y) < 0.017


def test_leaving_the_travel_is_a_warning():
    controller = ProportionalDerivative(1.0, 2.8)
    motion = simulate_single_link(
        ARM,
        reference=np.full(4500, 8.0),
        dt=1 / 300,
        controller=controller,
        effects=STICKY,
        substeps=3,
    )
    with pytest.warns(UserWarning, match="80°"):
        motion.data(1 / 300)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: open_loop_record(ARM, KEY, excitation="triangle"), "excitation"),
        (lambda: closed_loop_record(ARM, KEY, reference="triangle"), "reference"),
        (lambda: open_loop_record(ARM, KEY, duration=0.001), "duration"),
    ],
)
def test_unknown_experiments_are_refused(call, message):
    # The annotation's own check comes first where types are enforced.
    with pytest.raises((ValueError, TypeError), match=message):
        call()
