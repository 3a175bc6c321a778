"""Black boxes in continuous time: exact without noise, any order, several channels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpvid._results import Status
from lpvid.data import IOData
from lpvid.identify import ContinuousTimeMOESP, identify
from lpvid.mechanics import random_steps
from lpvid.models import StateSpace

DT = 0.02
# Two real poles and a pair. Sizes as in test_mechanical.py, so that compilations are shared.
TRUTH = StateSpace(
    A=[[-1.0, 0.0, 0.0, 0.0], [0.0, -3.0, 0.0, 0.0], [0.0, 0.0, -0.5, 6.0], [0.0, 0.0, -6.0, -0.5]],
    B=[[1.0, 0.2], [-0.5, 2.0], [0.5, 1.0], [-1.0, 0.3]],
    C=[[1.0, 0.5, 0.5, 0.0], [0.0, 1.0, 1.0, 1.0]],
)
METHOD = ContinuousTimeMOESP(order=4, tau=0.15, block_rows=6)


@pytest.fixture(scope="module")
def data():
    u = random_steps(jax.random.key(0), 3000, 2, dt=DT)
    x0 = jnp.array([0.3, 0.0, -0.2, 0.1])
    return IOData(u=u, y=TRUTH.simulate(u=u, dt=DT, x0=x0), dt=DT)


def test_finds_the_plant(data):
    fit = identify(data, METHOD)
    assert fit.status == Status.successful
    assert fit.model.dt == 0.0
    assert fit.order == 4
    assert np.all(fit.fit > 99.9)
    poles = np.sort_complex(np.asarray(fit.model.poles()))
    np.testing.assert_allclose(poles, np.sort_complex(np.asarray(TRUTH.poles())), atol=5e-3)
    omega = np.geomspace(0.1, 20.0, 20)
    np.testing.assert_allclose(
        fit.model.frequency_response(omega), TRUTH.frequency_response(omega), atol=5e-3
    )
    simulated = fit.model.simulate(u=data.u, dt=DT, x0=fit.x0[0])
    np.testing.assert_allclose(simulated, data.y, atol=2e-3)


def test_order_from_the_gap(data):
    method = ContinuousTimeMOESP(tau=0.15, block_rows=6)
    assert identify(data, method).order == 4


def test_few_samples_and_an_order_above_the_rank_are_said():
    """No noise, one state: the second is rounding."""
    u = np.repeat(np.random.default_rng(0).standard_normal((10, 1)), 4, axis=0)
    plant = StateSpace([[-2.0]], [[1.0]], [[1.0]])
    record = IOData(u=u, y=plant.simulate(u=u, dt=DT), dt=DT)
    method = ContinuousTimeMOESP(order=2, tau=0.15, block_rows=3)
    with pytest.warns(UserWarning) as caught:
        fit = identify(record, method, throw=False)
    said = [str(warning.message) for warning in caught]
    assert any("40 samples are few for order=2" in text for text in said)
    assert any("order=2 is above the numerical rank of the data (1)" in text for text in said)
    assert fit.status == Status.ill_conditioned


def test_order_is_needed_under_jit(data):
    method = ContinuousTimeMOESP(tau=0.15, block_rows=6)
    with pytest.raises(ValueError, match='order="auto"'):
        jax.jit(lambda y: identify(IOData(u=data.u, y=y, dt=DT), method).model.A)(data.y)


@pytest.mark.slow
def test_feedthrough_within_the_error_of_the_interpolation():
    u = random_steps(jax.random.key(1), 3000, 2, dt=DT)
    plant = StateSpace(TRUTH.A, TRUTH.B, TRUTH.C, [[0.5, 0.0], [-1.0, 0.3]])
    data = IOData(u=u, y=plant.simulate(u=u, dt=DT), dt=DT)
    method = ContinuousTimeMOESP(order=4, tau=0.15, block_rows=6, feedthrough=True)
    fit = identify(data, method)
    np.testing.assert_allclose(fit.model.D, plant.D, atol=0.1)
