"""The model that a closed loop leaves behind, on records that took no part."""

import equinox as eqx
import numpy as np
import pytest

from lpvid.control import ProportionalIntegral, set_point_following
from lpvid.data import IOData, join

from .engine_records import NOISE, closed, coulomb, record


@pytest.fixture(scope="module")
def loop():
    return closed(record(coulomb(0.4), seed=31))


def test_it_simulates_and_predicts_other_records(loop):
    other = record(coulomb(0.4), seed=32)
    y = np.asarray(other.y)
    free = [np.std(y - model.simulate(other)) for model in (loop.model_before, loop.model)]
    steps = [np.std(y - model.predict(other)) for model in (loop.model_before, loop.model)]
    assert steps[1] < 1.2 * NOISE < 1.5 * NOISE < steps[0]
    assert free[1] < 1.5 * NOISE and free[1] < 0.2 * free[0]
    np.testing.assert_array_equal(
        loop.model.parameters, [number.value for number in loop.parameters]
    )


def test_several_records_are_simulated_one_after_the_other(loop):
    records = [record(coulomb(0.4), seed=seed) for seed in (32, 33)]
    starts = np.zeros((2, 2))
    together = loop.model.simulate(join(records), initial_states=starts)
    for part, one in zip(np.split(together, 2), records, strict=True):
        alone = loop.model.simulate(one, initial_states=starts[:1])
        np.testing.assert_allclose(part, alone, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("simulation", [True, False])
def test_what_was_found_is_fitted_to_other_records(loop, simulation):
    # From parameters that are off, on two records in place of one.
    theta = lambda model: model.fitted.unknowns.theta  # noqa: E731
    off = eqx.tree_at(theta, loop.model, 1.1 * theta(loop.model))
    longer = join([record(coulomb(0.4), seed=seed) for seed in (33, 35)])
    refined = off.refine(longer, simulation=simulation)
    other = record(coulomb(0.4), seed=34)
    errors = [np.std(np.asarray(other.y) - one.simulate(other)) for one in (refined, off)]
    assert errors[0] < 1.2 * NOISE < 0.5 * errors[1]
    (effect,) = refined.effects
    level = effect.parameters[0]
    assert (effect.name, effect.port, level.name) == ("coulomb", "force at place", "Fc")
    assert abs(level.value - 0.4) < 5.0 * level.std < 0.05
    assert refined.parameters.tolist() == [number.value for number in refined.estimates]
    assert loop.model.effects[0].parameters == loop.effects[0].parameters


def test_held_out_parts_of_several_records_keep_their_own_clock():
    lengths = (400, 700)
    data = join([record(samples=n, seed=n) for n in lengths])
    loop = closed(data, laws=())
    # Two thirds estimate, rounded; each held-out part goes on where its own record was cut.
    cuts = [round(2 / 3 * n) for n in lengths]
    expected = np.concatenate(
        [data.dt * np.arange(cut, n) for cut, n in zip(cuts, lengths, strict=True)]
    )
    np.testing.assert_allclose(loop.series.time, expected, rtol=1e-12)
    assert loop.held_out == (cuts[0], lengths[0] - 1)


def test_test_records_may_be_more_than_those_that_estimate():
    test = join([record(seed=41), record(seed=42)])
    loop = closed(record(seed=40), test=test, laws=())
    assert loop.series.output.shape == (test.n_samples, 1)
    assert loop.after.one_step[0] < 1.2 * NOISE


def test_records_of_another_kind_are_refused(loop):
    other = record(coulomb(0.4), seed=32)
    with pytest.raises(ValueError, match="resample"):
        loop.model.simulate(other.replace(dt=2.0 * other.dt))
    with pytest.raises(ValueError, match="inputs"):
        loop.model.simulate(other.replace(u=np.concatenate([other.u, other.u], axis=1)))
    with pytest.raises(ValueError, match="scheduling signals"):
        loop.model.predict(other.replace(kappa=np.zeros(other.n_samples)))
    with pytest.raises(ValueError, match="one row for each record"):
        loop.model.simulate(other, initial_states=np.zeros((3, 2)))


@pytest.fixture(scope="module")
def following(loop):
    """Set-points under integral control: reference, controller, what the mass did."""
    reference = np.repeat(0.1 * np.array([1.0, -0.5, 0.3, 0.0]), 100)
    proportional, integral = 2.0, 0.5
    total = [0.0]

    def command(k, position):
        total[0] += reference[k] - position
        return proportional * (reference[k] - position) + integral * total[0]

    truth = record(coulomb(0.4), samples=400, noise=0.0, command=command)
    return reference, ProportionalIntegral(proportional, integral, dt=1.0), truth


def test_under_a_controller_it_does_what_the_plant_does(loop, following):
    reference, controller, truth = following
    motions = [
        model.simulate_closed_loop(controller, reference=reference)
        for model in (loop.model_before, loop.model)
    ]
    missed = set_point_following(
        {"linear": motions[0], "with friction": motions[1]}, truth, reference=reference
    ).relative_error[:, 0]
    assert missed[1] < missed[0] / 3.0
    assert missed[1] < 0.05


def test_the_commands_alone_give_the_same_motion(loop, following):
    motion = loop.model.simulate_closed_loop(following[1], reference=following[0])
    data = IOData(u=motion.u, y=motion.y, dt=motion.dt)
    again = loop.model.simulate(data, initial_states=np.zeros((1, 2)))
    np.testing.assert_allclose(again, motion.y, rtol=0.0, atol=1e-9)
    with pytest.raises(ValueError, match="initial_states: 2 numbers"):
        loop.model.simulate_closed_loop(
            following[1], reference=following[0], initial_states=np.zeros(3)
        )
