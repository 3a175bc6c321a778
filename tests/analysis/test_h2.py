import control
import jax
import numpy as np
import pytest
from analysis_systems import modal_system, sampled

from lpvid.analysis import h2_norm
from lpvid.models import StateSpace


@pytest.mark.parametrize("dt", [0.0, 0.05])
def test_agrees_with_python_control(dt):
    A, B, C, D = modal_system(np.random.default_rng(0), 6, 2, 3, damping=1e-2, feedthrough=1.0)
    if dt:
        A, B, C, D = sampled(A, B, C, D, dt)
    else:
        D = 0.0 * D
    expected = control.norm(control.ss(A, B, C, D, dt), 2)
    np.testing.assert_allclose(h2_norm(StateSpace(A, B, C, D, dt=dt)), expected, rtol=1e-8)


def test_gradient_against_differences():
    A, B, C, D = modal_system(np.random.default_rng(1), 4, 2, 2, damping=1e-2, feedthrough=0.0)
    direction = np.random.default_rng(2).standard_normal(A.shape)

    def norm(scale):
        return h2_norm(StateSpace(A + scale * direction, B, C, D))

    difference = (norm(1e-6) - norm(-1e-6)) / 2e-6
    np.testing.assert_allclose(jax.grad(norm)(0.0), difference, rtol=1e-5)


def test_infinite_and_zero():
    assert h2_norm(StateSpace([[1.0]], [[1.0]], [[1.0]])) == np.inf
    assert h2_norm(StateSpace([[-1.0]], [[1.0]], [[1.0]], [[1.0]])) == np.inf
    assert h2_norm(StateSpace([[-1.0]], [[0.0]], [[1.0]])) == 0.0
    batch = StateSpace([[[-1.0]], [[1.0]]], [[1.0]], [[1.0]])
    np.testing.assert_allclose(h2_norm(batch), [np.sqrt(0.5), np.inf])
