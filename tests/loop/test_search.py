"""Steps of the search: logarithmic where numbers are positive, and cut by bounds."""

import numpy as np

from lpvid.loop._search import _moved


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
