import equinox as eqx
import numpy as np
import pytest
from analysis_systems import modal_system, sampled

from lpvid.analysis import hinf_norm, peak_frequencies, singular_values
from lpvid.models import StateSpace

peaks = eqx.filter_jit(peak_frequencies)


@pytest.mark.slow
@pytest.mark.parametrize("dt", [0.0, pytest.param(0.01, marks=pytest.mark.slow)])
def test_peaks_are_the_local_maxima_of_a_dense_grid(dt):
    A, B, C, D = modal_system(np.random.default_rng(1), 8, 2, 2, damping=3e-3, feedthrough=0.1)
    if dt:
        A, B, C, D = sampled(A, B, C, D, dt)
    system = StateSpace(A, B, C, D, dt=dt)
    grid = np.geomspace(1e-2, np.pi / dt if dt else 500.0, 50_001)
    gain = np.asarray(singular_values(system, grid))[:, 0]
    inner = np.flatnonzero((gain[1:-1] > gain[:-2]) & (gain[1:-1] > gain[2:])) + 1
    omega, height = peaks(system, 12)
    for index in inner:
        nearest = np.argmin(np.abs(omega - grid[index]))
        np.testing.assert_allclose(omega[nearest], grid[index], rtol=5e-4)
        assert height[nearest] >= gain[index] * (1 - 1e-12)
    # Descending, and then the highest again.
    assert np.sum(np.diff(height) > 0.0) <= 1
    norm = hinf_norm(system)
    if np.isfinite(norm.frequency):
        np.testing.assert_allclose(height[0], norm.value, rtol=1e-9)


@pytest.mark.slow
def test_both_peaks_beside_nearly_equal_modes_are_found():
    def mode(frequency, damping, B, C):
        A = [[0.0, frequency], [-frequency, -2.0 * damping * frequency]]
        return StateSpace(A, B, C)

    grid = np.linspace(8.0, 12.0, 4001)
    # Those of 300 with two peaks, seven of which no climb from the poles or between them reaches.
    for seed in (33, 78, 102, 105, 115, 145, 171, 271):
        rng = np.random.default_rng(seed)
        B, C = rng.normal(size=(2, 1)), rng.normal(size=(2, 2))
        change = rng.normal(size=2) * [0.003, 0.1]
        other = (m * (1.0 + 0.05 * rng.normal(size=m.shape)) for m in (B, C))
        system = mode(10.0, 0.02, B, C) - mode(10 + 10 * change[0], 0.02 + 0.02 * change[1], *other)
        omega, _ = peaks(system, 4)
        gain = np.asarray(singular_values(system, grid))[:, 0]
        tops = 1 + np.flatnonzero((gain[1:-1] > gain[:-2]) & (gain[1:-1] > gain[2:]))
        tops = tops[gain[tops] > 0.5 * gain.max()]
        assert len(tops) == 2
        for top in tops:
            assert np.min(np.abs(omega - grid[top])) < 5e-3


def test_padding_repeats_the_highest():
    system = StateSpace(np.diag([-1.0, -3.0]), [[1.0], [0.0]], [[2.0, 0.0]])
    omega, gain = peaks(system, 5)
    assert omega.shape == gain.shape == (5,)
    assert (omega[0], gain[0]) == (0.0, 2.0)
    np.testing.assert_array_equal(omega[-1], omega[0])
    with pytest.raises(ValueError, match="count"):
        peak_frequencies(system, 0)


def test_defective_systems_have_peaks_too():
    # 1 / (s + 1)^2 - 0.9 / (s + 1), largest away from zero.
    system = StateSpace([[-1.0, 1.0], [0.0, -1.0]], [[0.0], [1.0]], [[1.0, -0.9]])
    omega, gain = peaks(system, 5)
    grid = np.linspace(0.0, 10.0, 100_001)
    dense = np.abs(1 / (1j * grid + 1) ** 2 - 0.9 / (1j * grid + 1))
    np.testing.assert_allclose(gain[0], dense.max(), rtol=1e-8)
    np.testing.assert_allclose(omega[0], grid[np.argmax(dense)], atol=1e-3)
    assert np.all(np.isfinite(omega))


def test_batches_of_peaks():
    A = np.array([[[-1.0, 0.0], [0.0, -3.0]], [[-2.0, 0.0], [0.0, -3.0]]])
    system = StateSpace(A, [[1.0], [0.0]], [[2.0, 0.0]])
    omega, gain = peaks(system, 2)
    np.testing.assert_allclose(gain[:, 0], [2.0, 1.0])
    assert omega.shape == (2, 2)


def test_singular_values():
    A, B, C, D = modal_system(np.random.default_rng(2), 4, 2, 3)
    omega = np.array([0.0, 1.0, 30.0])
    states = np.linalg.solve(1j * omega[:, None, None] * np.eye(4) - A, B[None])
    expected = np.linalg.svd(C @ states + D, compute_uv=False)
    np.testing.assert_allclose(singular_values(StateSpace(A, B, C, D), omega), expected, rtol=1e-9)
    with pytest.raises(ValueError, match="omega"):
        singular_values(StateSpace(A, B, C, D), omega[None])
