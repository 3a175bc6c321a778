"""Steps of the search: logarithmic where numbers are positive, and cut by bounds."""

import jax.numpy as jnp
import numpy as np

from lpvid.data import IOData
from lpvid.loop import _search
from lpvid.loop._candidates import slots_of
from lpvid.loop._program import Setting
from lpvid.loop._records import records_of
from lpvid.loop._search import _moved
from lpvid.loop._tune import empty_unknowns
from lpvid.loop.structures import Servo


def test_a_step_keeps_positive_numbers_positive_and_within_bounds():
    point, move = np.array([2.0, 2.0, -1.0, 0.5]), np.array([-50.0, 0.02, 3.0, 1e-3])
    lower = np.array([1e-12, 1e-12, -np.inf, 0.0])
    upper = np.array([np.inf, np.inf, 1.0, np.inf])
    moved, taken = _moved(point, move, lower, upper)
    # Far below zero: one step goes no further than a factor.
    np.testing.assert_allclose(moved[0], 2.0 * np.exp(-1.5))
    np.testing.assert_allclose(moved[1], 2.0 * np.exp(0.01))
    assert moved[2] == 1.0 and taken[2] == 2.0
    # At first order a short step is the one that was wanted.
    np.testing.assert_allclose(taken[[1, 3]], move[[1, 3]])
    assert taken[0] != move[0]


def test_sensitivities_that_overflow_in_their_products_end_the_search(monkeypatch):
    data = IOData(u=np.zeros(20), y=np.zeros(20), dt=0.1)
    setting = Setting(Servo(data), (), data.dt)
    records = records_of(data, np.zeros((1, 0)), 2.0)
    errors, columns = np.ones((20, 1)), np.full((20, 1, 2), 1e200)
    errors[::2] = -1.0
    monkeypatch.setattr(_search, "sensitivities", lambda *_: (errors, columns))
    free, start = np.full(2, np.inf), empty_unknowns(np.array([1.0, 2.0]), 2, 1, 1)
    slots, gain = slots_of(setting.structure, (), 1), jnp.zeros((1, 2, 1))
    found = _search.search(setting, records, slots, start, gain, np.arange(2), -free, free)
    np.testing.assert_array_equal(found.unknowns.theta, [1.0, 2.0])
    assert not found.converged
