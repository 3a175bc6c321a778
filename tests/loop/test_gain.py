"""The predictor's gain beside SciPy's Riccati solver."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from lpvid.data import IOData
from lpvid.effects import law
from lpvid.loop._discretise import sampled
from lpvid.loop._gain import gains as eager
from lpvid.loop._program import Setting
from lpvid.loop._records import records_of
from lpvid.loop.structures import structure_named

THETA = np.array([1.0, 0.1, 0.6, 0.9, -0.2, 0.5, 30.0, -12.0, 22.0])
NOISE = np.array([1e-3, 3e-3])


gains = eqx.filter_jit(eager)


def _gains(ratio):
    data = IOData(u=np.zeros((20, 2)), y=np.zeros((20, 2)), dt=0.05)
    structure = structure_named("mass-spring-damper", data)
    setting = Setting(structure, (law("coulomb"),), 0.05)
    records = records_of(data, np.zeros((1, 0)), 1.0)
    got = gains(setting, records, jnp.asarray(THETA), jnp.asarray(NOISE), jnp.asarray(ratio))
    model = sampled(structure.ports(jnp.asarray(THETA), jnp.zeros(0)), jnp.asarray(0.05))
    return np.asarray(got), model


@pytest.mark.parametrize("ratio", [1e-2, 100.0])
def test_it_is_the_steady_kalman_filter(ratio):
    got, model = _gains(ratio)
    A, B, C = (np.asarray(part) for part in (model.transition, model.drive, model.C))
    # Each port's diffusion alone moves the outputs by as much as their noise.
    energy, state = np.zeros(B.shape[1]), B
    for _ in range(256):
        energy += np.sum((C @ state / NOISE[:, None]) ** 2, axis=0)
        state = A @ state
    Q = B @ np.diag(ratio / energy) @ B.T
    Q += 1e-12 * np.trace(Q) * np.eye(4)
    R = np.diag(NOISE**2)
    P = scipy.linalg.solve_discrete_are(A.T, C.T, Q, R)
    expected = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
    np.testing.assert_allclose(got[0], expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())
    # The predictor forgets.
    poles = np.linalg.eigvals(A @ (np.eye(4) - got[0] @ C))
    assert np.abs(poles).max() < 1.0
    assert np.abs(poles).max() <= np.abs(np.linalg.eigvals(A)).max() + 1e-12


def test_without_diffusion_it_is_a_simulation():
    assert np.abs(_gains(0.0)[0]).max() < 1e-9
