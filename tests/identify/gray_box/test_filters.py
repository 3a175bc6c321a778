"""Filtered signals against SciPy's exact simulation for held and for straight inputs."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

from lpvid.identify.gray_box import FilterPowers, LaguerreFilters
from lpvid.identify.gray_box._filters import laguerre_signals

COUNT, TAU = 6, 7.0


@pytest.fixture(scope="module")
def filtered():
    rng = np.random.default_rng(0)
    held, ramps = rng.standard_normal((150, 2)), rng.standard_normal((150, 1))
    signals, impulses = laguerre_signals(
        jnp.asarray(held), jnp.asarray(ramps), jnp.asarray(TAU), COUNT
    )
    return held, ramps, np.asarray(signals), np.asarray(impulses)


def scipy_response(zeros, poles, gain, signal, straight):
    time = np.arange(len(signal), dtype=float)
    system = scipy.signal.ZerosPolesGain(zeros, poles, gain).to_ss()
    return scipy.signal.lsim(system, signal, time, interp=straight)[1]


@pytest.mark.parametrize("k", [0, 1, 5])
def test_laguerre_filters_are_exact_for_both_holds(filtered, k):
    held, ramps, signals, impulses = filtered
    # λ p^k = (1/τ) (−1)^k (s − 1/τ)^k / (s + 1/τ)^(k+1)
    zpk = [1 / TAU] * k, [-1 / TAU] * (k + 1), (-1) ** k / TAU
    for channel in range(2):
        expected = scipy_response(*zpk, held[:, channel], False)
        np.testing.assert_allclose(signals[:, channel, k], expected, atol=1e-10)
    expected = scipy_response(*zpk, ramps[:, 0], True)
    np.testing.assert_allclose(signals[:, 2, k], expected, atol=1e-10)
    system = scipy.signal.ZerosPolesGain(*zpk).to_ss()
    time = np.arange(150.0)
    impulse = scipy.signal.impulse(system, T=time)[1] * np.sqrt(2 * TAU)
    np.testing.assert_allclose(impulses[:, k], impulse, atol=1e-10)


@pytest.mark.parametrize("k", [1, 3, 5])
def test_powers_are_combinations_of_laguerre_filters(filtered, k):
    _, ramps, signals, _ = filtered
    weights = FilterPowers().combinations(3)[k]
    found = signals[:, 2] @ weights[1:]
    expected = scipy_response([], [-1 / TAU] * k, TAU**-k, ramps[:, 0], True)
    np.testing.assert_allclose(found, expected, atol=1e-10)
    assert weights[0] == 0.0


@pytest.mark.parametrize("filters", [LaguerreFilters(), FilterPowers()])
def test_shift_of_the_extended_model_gives_back_the_dynamics(filters):
    A, tau = np.array([[0.0, 1.0], [-3.0, -0.4]]), 0.7
    identity = np.eye(2)
    if isinstance(filters, FilterPowers):
        shift = identity + tau * A
    else:
        shift = np.linalg.solve(identity - tau * A, identity + tau * A)
    found = filters.continuous(jnp.asarray(shift), jnp.asarray(tau))
    np.testing.assert_allclose(found, A, atol=1e-12)
