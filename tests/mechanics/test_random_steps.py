"""Random steps: levels and holding times within their ranges, channels of their own."""

import jax
import numpy as np
import pytest

from lpvid.mechanics import random_steps


def test_levels_and_holds_keep_to_their_ranges():
    dt = 5e-3
    u = np.asarray(random_steps(jax.random.key(3), 20_000, 2, dt=dt))
    assert u.shape == (20_000, 2)
    assert np.all((np.abs(u) >= 0.5) & (np.abs(u) <= 1.0))
    for column in u.T:
        jumps = np.flatnonzero(np.diff(column)) + 1
        holds = np.diff(jumps) * dt
        assert holds.min() >= 1.0 - dt
        assert holds.max() <= 4.0 + dt
        # 100 s of steps of 2.5 s on average.
        assert 30 < jumps.size < 52
        assert 0.2 < np.mean(column > 0) < 0.8
    assert abs(np.corrcoef(u.T)[0, 1]) < 0.5


def test_holds_below_a_sample_last_one():
    u = np.asarray(random_steps(jax.random.key(0), 50, dt=1.0, hold=(0.1, 0.2)))
    assert np.unique(u).size == 50


@pytest.mark.parametrize(
    "change",
    [
        {"n_samples": 0},
        {"n_channels": 0},
        {"dt": 0.0},
        {"amplitude": (1.0, 0.5)},
        {"hold": (0.0, 1.0)},
    ],
)
def test_faults_are_named(change):
    settings = {"n_samples": 100, "n_channels": 1, "dt": 0.1} | change
    with pytest.raises(ValueError, match=next(iter(change))):
        random_steps(jax.random.key(0), **settings)
