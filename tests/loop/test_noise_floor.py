"""The noise that periods and repeated records show, and inputs that never come again."""

import numpy as np
import pytest

from lpvid.data import IOData
from lpvid.loop._noise_floor import measured_floor, period_of
from lpvid.models import StateSpace

RNG = np.random.default_rng(0)
PERIOD, SPREAD = 250, np.array([0.02, 0.005])
PLANT = StateSpace([[0.8]], [[1.0]], [[1.0], [2.0]], dt=0.01)
WAVE = np.repeat(RNG.standard_normal(PERIOD // 5), 5)


def record(u, spread=SPREAD, **more):
    y = np.asarray(PLANT.simulate(u=u)) + spread * RNG.standard_normal((u.size, 2))
    return IOData(u=u, y=y, dt=0.01, **more)


def test_periods_show_the_noise_and_not_how_the_plant_settles():
    # 4.4 periods from rest.
    found = measured_floor((record(np.resize(WAVE, 1100)),))
    assert found is not None and "periods" in found.source
    # 500 differences of degrees of freedom each: three standard errors of a standard deviation.
    np.testing.assert_allclose(found.spread, SPREAD, rtol=3.0 / np.sqrt(2 * 500))


def test_repeated_records_show_it_too():
    u = RNG.standard_normal(400)
    found = measured_floor((record(u), record(RNG.standard_normal(300)), record(u)))
    assert found is not None and "repeated" in found.source
    np.testing.assert_allclose(found.spread, SPREAD, rtol=3.0 / np.sqrt(2 * 320))


@pytest.mark.parametrize(
    "u",
    [
        RNG.standard_normal(1000),
        # A slow input resembles itself a sample later without coming again.
        np.sin(np.linspace(0.0, 3.0, 1000)),
        np.resize(WAVE, 600),
        np.resize(WAVE, 1000) + 0.01 * RNG.standard_normal(1000),
        np.r_[np.zeros(500), np.ones(500)],
    ],
    ids=["random", "slow", "two periods", "noisy feedback", "one step"],
)
def test_what_does_not_come_again_shows_nothing(u):
    assert measured_floor((record(u),)) is None


def test_a_moving_schedule_makes_periods_differ():
    u = np.resize(WAVE, 1000)
    assert measured_floor((record(u, kappa=np.linspace(0.0, 1.0, 1000)),)) is None
    assert measured_floor((record(u, kappa=np.ones(1000)),)) is not None


def test_the_period_is_the_shortest_of_all_inputs_together():
    assert period_of(np.resize(WAVE, 1100)[:, None]) == PERIOD
    both = np.stack([np.resize(WAVE, 2000), np.resize(WAVE[:100], 2000)], axis=1)
    assert period_of(both) == 2 * PERIOD
    square = np.sign(np.sin(2.0 * np.pi * (np.arange(2000) + 0.5) / 400))
    assert period_of(square[:, None]) == 400
