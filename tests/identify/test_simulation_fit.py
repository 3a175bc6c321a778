"""Scores of a fit whose records each have an offset of their own."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from lpvid.data import IOData
from lpvid.identify import simulation_fit
from lpvid.models import StateSpace

MODEL = StateSpace([[0.9]], [[1.0]], [[0.5]], dt=0.1)


@pytest.fixture(scope="module")
def data():
    rng = np.random.default_rng(0)
    u = [rng.standard_normal(80), rng.standard_normal(50)]
    y = [
        np.asarray(MODEL.simulate(u=part))[:, 0] + level
        for part, level in zip(u, (3.0, -1.0), strict=True)
    ]
    return IOData(u=u, y=y, dt=0.1)


def test_an_offset_for_each_record(data):
    fit = SimpleNamespace(model=MODEL, output_offset=jnp.array([[3.0], [-1.0]]))
    np.testing.assert_allclose(simulation_fit(fit, data), [100.0], atol=1e-6)
    one = SimpleNamespace(model=MODEL, output_offset=jnp.array([3.0]))
    assert simulation_fit(one, data)[0] < 90.0


def test_offsets_of_another_number_of_records_are_refused(data):
    fit = SimpleNamespace(model=MODEL, output_offset=jnp.zeros((3, 1)))
    with pytest.raises(ValueError, match="offsets of 3 records"):
        simulation_fit(fit, data)
