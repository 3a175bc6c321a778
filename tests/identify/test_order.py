"""Rules for the order: by hand, and on systems of known order."""

import numpy as np
import pytest

from lpvid.data import IOData
from lpvid.identify import (
    ORSE,
    InformationCriterion,
    LargestGap,
    NoiseFloor,
    PastOutputMOESP,
    Threshold,
    identify,
)
from lpvid.identify._order import Evidence

from .helpers import common_problem, prbs, respond


def evidence(singular_values=(1.0,), correlations=(), largest=5, columns=1000):
    return Evidence(
        singular_values=np.asarray(singular_values, float),
        correlations=np.asarray(correlations, float),
        instruments=16,
        columns=columns,
        nu=1,
        ny=1,
        largest=largest,
    )


def test_largest_gap():
    values = [5.0, 4.0, 3.0, 0.01, 0.009, 0.008]
    assert LargestGap().choose(evidence(values, largest=4)) == 3
    # Rounding noise has large ratios of its own.
    assert LargestGap().choose(evidence([5.0, 4.0, 1e-14, 1e-17, 1e-22], largest=4)) == 2


def test_threshold():
    values = [5.0, 4.0, 0.3, 0.02]
    assert Threshold(0.05).choose(evidence(values)) == 3
    assert Threshold(0.05).choose(evidence(values, largest=2)) == 2
    assert Threshold(2.0).choose(evidence(values)) == 1


def test_noise_floor_counts_what_stands_above_the_edge():
    # Eight rows, 16 instruments: the edge is (√8 + 4)/√1000 = 0.216 in ratio, 1.5 times that 0.324,
    # which is a correlation of 0.308.
    ones = np.ones(8)
    correlations = [1.0, 0.9, 0.31, 0.30, 0.1, 0.0, 0.0, 0.0]
    assert NoiseFloor().choose(evidence(ones, correlations)) == 3
    assert NoiseFloor(margin=1.0).choose(evidence(ones, correlations)) == 4
    assert NoiseFloor().choose(evidence(ones, 8 * [0.01])) == 1


def test_information_criterion_weighs_the_first_correlation_left_out():
    # A parameter set of three costs 3 log(1000)/1000 = 0.0207 an order.
    assert InformationCriterion().choose(evidence(np.ones(4), [0.9, 0.5, 0.2, 0.1])) == 3
    assert InformationCriterion().choose(evidence(np.ones(4), [0.9, 0.5, 0.14, 0.1])) == 2
    assert InformationCriterion(price=0.1).choose(evidence(np.ones(4), [0.9, 0.5, 0.14, 0.01])) == 3


@pytest.mark.parametrize("decibel", [20.0, 30.0, 40.0])
def test_default_finds_the_order_of_the_common_problem(decibel):
    for seed in (1, 2, 3):
        u, _, y = common_problem(3000, seed, decibel)
        assert identify(IOData(u=u, y=y, dt=0.02)).order == 6


def test_default_sees_a_weak_mode_that_the_gap_misses():
    A = np.diag([0.95, 0.3])
    system = A, np.array([[1.0], [0.25]]), np.array([[1.0, 1.0]]), np.zeros((1, 1))
    u = prbs(2000, 1, seed=1)
    y = respond(system, u)
    y = y + 0.03 * y.std() * np.random.default_rng(1).standard_normal(y.shape)
    data = IOData(u=u, y=y, dt=0.1)
    fit = identify(data, PastOutputMOESP(block_rows=15))
    assert fit.order == 2
    assert identify(data, PastOutputMOESP(InformationCriterion(), 15)).order == 2
    assert LargestGap().choose(evidence(fit.singular_values)) == 1


def test_rules_that_need_instruments_say_so():
    u, _, y = common_problem(400)
    with pytest.raises(ValueError, match="has no instruments: give order=Threshold"):
        identify(IOData(u=u, y=y, dt=0.02), ORSE(order=NoiseFloor(), block_rows=8))
