"""The loop closed over small records: what is there is named, what is not is not."""

import numpy as np
import pytest

import lpvid as lv
from lpvid.loop import structure_named

from .engine_records import DAMPING, FEW, MASS, NOISE, STIFFNESS, closed, coulomb, record

LEVEL = 0.4


@pytest.fixture(scope="module")
def linear():
    """A record of the linear plant, and what came of it."""
    return closed(record(seed=21), laws=FEW)


@pytest.fixture(scope="module")
def rubbed():
    """The same plant with dry friction."""
    return closed(record(coulomb(LEVEL), seed=21), laws=FEW)


def test_a_linear_plant_gets_nothing(linear):
    assert linear.verdict == "nothing to add"
    assert linear.effects == () and linear.virtual_forces == ()
    assert linear.p_value > 0.01
    for name in ("one_step", "horizon", "free_run"):
        np.testing.assert_array_equal(getattr(linear.before, name), getattr(linear.after, name))
    # Held-out errors are the noise's, of 300 samples.
    np.testing.assert_allclose(linear.after.free_run, NOISE, rtol=4.0 / np.sqrt(600.0))


def test_dry_friction_is_named_and_measured(rubbed):
    assert rubbed.verdict == "named"
    (effect,) = rubbed.effects
    assert (effect.name, effect.family, effect.port) == ("coulomb", "friction", "force at place")
    level, width = effect.parameters
    assert (level.unit, width.unit) == ("N", "m/s")
    assert abs(level.value - LEVEL) < min(5.0 * level.std, 0.02 * LEVEL)
    assert effect.p_value < 1e-20 and effect.gain > 50.0 and effect.held_out_gain > 20.0
    for number, truth in zip(rubbed.parameters, (MASS, DAMPING, STIFFNESS), strict=True):
        assert abs(number.value - truth) < min(5.0 * number.std, 0.02 * truth), number


def test_errors_before_and_after(rubbed):
    assert np.all(rubbed.after.free_run < 0.1 * rubbed.before.free_run)
    np.testing.assert_allclose(rubbed.after.one_step, NOISE, rtol=0.2)
    assert rubbed.after.bft[0] > rubbed.before.bft[0]
    first, last = rubbed.held_out
    assert (first, last) == (600, 899)
    series = rubbed.series
    assert {len(part) for part in series} == {last - first + 1}
    error = series.output - series.after
    np.testing.assert_allclose(rubbed.after.free_run, np.sqrt(np.mean(error**2, axis=0)))
    assert rubbed.ladder.steps[-1] == rubbed.horizon
    assert rubbed.ladder.after[-1, 0] < rubbed.ladder.before[-1, 0]
    # Taking the effect out again costs what it had gained.
    ((name, left_out),) = rubbed.ablation.items()
    assert name.startswith("coulomb") and left_out[0] > 2.0 * rubbed.after.horizon[0]


def test_the_ranking_the_tests_and_the_force_are_told(rubbed):
    first = rubbed.rounds[0]
    assert first[0].name == "coulomb"
    assert [one.penalised for one in first] == sorted(one.penalised for one in first)[::-1]
    assert rubbed.tests_made > len(first)
    assert rubbed.p_value < 1e-20 < rubbed.p_value_left
    (force,) = rubbed.virtual_forces
    assert "velocity" in force.regressor_name and force.unit == "N"
    assert force.law.shape == force.regressor.shape == force.residual.shape
    fast = np.abs(force.regressor) > 0.05
    off = np.abs(force.law[fast] + LEVEL * np.sign(force.regressor[fast]))
    # All but the few samples in which the velocity turns.
    assert np.mean(off < 0.05 * LEVEL) > 0.95


def test_a_record_for_the_test_takes_the_place_of_a_part(rubbed):
    data = record(coulomb(LEVEL), seed=21)
    train, test = data.split(2.0 / 3.0)
    again = lv.close_the_loop(
        structure_named("mass-spring-damper", train), train, test=test, laws=FEW
    )
    assert again.held_out == (0, 299)
    np.testing.assert_allclose(again.effects[0].parameters[0].value, LEVEL, rtol=0.02)
    np.testing.assert_allclose(again.after.one_step, rubbed.after.one_step, rtol=0.05)
