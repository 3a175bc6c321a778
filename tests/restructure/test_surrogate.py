"""The smooth surrogate: its limit, and a grid that holds what the first one lacked."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpvid.models import StateSpace
from lpvid.restructure._matching import channel_weights, largest_gain, make_target
from lpvid.restructure._surrogate import power_norm

RNG = np.random.default_rng(0)
norm = jax.jit(lambda error, log2: power_norm(error, log2, 9))


@pytest.fixture(params=[(2, 3), (3, 2), (1, 1)], ids=str)
def error(request):
    shape = (20, *request.param)
    return jnp.asarray(RNG.normal(size=shape) + 1j * RNG.normal(size=shape))


def test_power_norm_is_the_sum_of_powers_and_tends_to_the_squared_norm(error):
    squares = np.linalg.svd(np.asarray(error), compute_uv=False) ** 2
    largest = squares.max()
    values = []
    for log2 in range(10):
        power = 2.0**log2
        # NumPy in logarithms, where the powers themselves overflow.
        expected = largest * np.sum((squares / largest) ** power) ** (1.0 / power)
        values.append(float(norm(error, jnp.asarray(float(log2)))))
        np.testing.assert_allclose(values[-1], expected, rtol=1e-10)
    assert np.all(np.diff(values) <= 1e-12 * largest) and values[-1] >= largest * (1 - 1e-12)
    np.testing.assert_allclose(values[-1], largest, rtol=0.01)
    np.testing.assert_allclose(largest_gain(error), np.sqrt(largest))


def test_power_norm_does_not_depend_on_units():
    error = jnp.asarray(RNG.normal(size=(20, 2, 2)) + 0j)
    for scale in (1e-60, 1e60):
        ratio = norm(scale * error, jnp.asarray(9.0)) / norm(error, jnp.asarray(9.0))
        np.testing.assert_allclose(ratio, scale**2, rtol=1e-9)


def test_power_norm_is_smooth_where_gains_cross():
    # Both singular values equal, at two frequencies at once.
    error = jnp.asarray(np.stack([np.eye(2), 1j * np.eye(2)]))
    direction = jnp.asarray(RNG.normal(size=(2, 2, 2)) + 1j * RNG.normal(size=(2, 2, 2)))

    def along(step):
        return power_norm(error + step.astype(complex) * direction, jnp.asarray(5.0), 9)

    slope = jax.grad(along)(jnp.asarray(0.0))
    numeric = (along(jnp.asarray(1e-6)) - along(jnp.asarray(-1e-6))) / 2e-6
    np.testing.assert_allclose(slope, numeric, rtol=1e-6)
    assert np.isfinite(jax.grad(lambda s: norm(s * error, jnp.asarray(5.0)))(0.0 + 0.0j))


def resonance(frequency, damping):
    A = [[0.0, frequency], [-frequency, -2 * damping * frequency]]
    return StateSpace(A, [[0.0], [1.0]], [[1.0, 0.0]])


def test_the_grid_holds_lightly_damped_peaks():
    system = resonance(3.0, 1e-5) + resonance(70.0, 1e-4)
    target = make_target(system, 20, np.inf)
    assert target.omega.shape == (24,)
    assert np.all(np.diff(target.omega) >= 0)
    for frequency in (3.0, 70.0):
        assert np.min(np.abs(target.omega - frequency)) < 1e-6 * frequency
    np.testing.assert_allclose(target.response, system.frequency_response(target.omega))
    assert target.omega[0] < 0.5 and target.omega[-1] > 200.0


def test_the_grid_ends_where_the_data_do():
    target = make_target(resonance(3.0, 0.1) + resonance(70.0, 0.1), 20, 50.0)
    assert target.omega.max() <= 50.0 * (1 + 1e-12)


def test_an_integrator_does_not_stretch_the_grid():
    system = resonance(3.0, 0.1) + StateSpace([[0.0]], [[1.0]], [[1.0]])
    omega = make_target(system, 20, np.inf).omega
    assert omega.min() > 1e-6 and np.all(np.isfinite(omega))


def test_channels_weigh_alike_however_small():
    gains = np.diag([1.0, 20.0])
    system = StateSpace(-np.eye(2), np.eye(2), gains)
    weights = channel_weights(make_target(system, 20, np.inf))
    np.testing.assert_allclose(weights[0, 0] / weights[1, 1], 20.0)
    # A channel without response is not blown up.
    assert np.all(np.isfinite(weights)) and weights.max() <= 1e3 * weights[1, 1] * 1.001
