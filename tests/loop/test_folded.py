"""Sensors that cannot tell the sign: the signal behind them, and the loop that starts from it."""

import numpy as np
import pytest
import scipy.signal

from lpvid.data import IOData
from lpvid.loop import close_the_loop
from lpvid.loop.structures import unfolded

NOISE = 2e-3


def _oscillator(seed, samples=1000, dt=0.02, fine=20):
    """Force and position of q̈ + 0.3 q̇ + 4 q = f by a symplectic integrator of its own."""
    u = np.repeat(np.random.default_rng(seed).standard_normal(samples // 20), 20)
    q, v, path = 0.0, 0.0, []
    for force in u:
        path.append(q)
        for _ in range(fine):
            v += dt / fine * (force - 0.3 * v - 4.0 * q)
            q += dt / fine * v
    return u, np.array(path)


@pytest.fixture(scope="module")
def folded():
    rng = np.random.default_rng(5)
    pairs = [_oscillator(seed) for seed in (0, 1)]
    behind = [q for _, q in pairs]
    y = [np.abs(q) + NOISE * rng.standard_normal(q.size) for q in behind]
    return IOData(u=[u for u, _ in pairs], y=y, dt=0.02), behind


def test_the_signal_behind_is_found_up_to_its_sign(folded):
    data, behind = folded
    straight, outputs = unfolded(data)
    assert outputs == (0,)
    np.testing.assert_allclose(np.abs(straight.y), np.abs(data.y))
    for record, q in zip(straight.records, behind, strict=True):
        clear = np.abs(q) > 5.0 * NOISE
        agree = np.sign(np.asarray(record.y)[clear, 0]) == np.sign(q[clear])
        assert max(np.mean(agree), 1.0 - np.mean(agree)) > 0.99


@pytest.mark.parametrize("change", ["as it is", "above zero", "noise alone"])
def test_other_signals_are_left_alone(change):
    u, q = _oscillator(2)
    noise = np.random.default_rng(6).standard_normal(q.size)
    signal = {
        "as it is": q + NOISE * noise,
        "above zero": q - q.min() + NOISE * noise,
        "noise alone": np.abs(noise),
    }[change]
    data = IOData(u=u, y=signal, dt=0.02)
    assert unfolded(data) == (data, ())


@pytest.mark.parametrize("noise", [0.01, 0.03, 0.05])
def test_a_plant_that_rests_at_zero_is_left_alone(noise):
    rng = np.random.default_rng(3)
    u = np.zeros(1500)
    for begin in range(100, 1500, 250):
        u[begin : begin + 40] = rng.uniform(0.5, 1.0)
    _, y, _ = scipy.signal.lsim(([25.0], [1.0, 10.0, 25.0]), u, 0.02 * np.arange(1500))
    y = y + noise * np.sqrt(np.mean(y**2)) * rng.standard_normal(1500)
    data = IOData(u=u, y=y, dt=0.02)
    assert unfolded(data) == (data, ())


@pytest.mark.slow
def test_the_sensor_is_named_and_the_plant_found_behind_it(folded):
    data, _ = folded
    first = data.records[0]
    found = close_the_loop("mass-spring-damper", first)
    assert [effect.name for effect in found.effects] == ["absolute-value-sensor"]
    assert found.verdict == "named"
    for number, truth in zip(found.parameters, (1.0, 0.3, 4.0), strict=True):
        assert abs(number.value - truth) < max(4.0 * number.std, 3e-3 * truth)
    assert found.after.free_run[0] < 1.3 * NOISE < 0.05 * found.before.free_run[0]
