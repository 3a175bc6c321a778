"""Sensitivities of candidates that are not in the model yet, against those of one that has them."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from lpvid.data import IOData
from lpvid.effects import law
from lpvid.loop._candidates import Place, slots_of
from lpvid.loop._columns import along, trial_columns
from lpvid.loop._gain import gains
from lpvid.loop._path import AMPLITUDES
from lpvid.loop._program import Setting
from lpvid.loop._records import records_of
from lpvid.loop._search import sensitivities
from lpvid.loop._tune import empty_unknowns
from lpvid.loop.structures import Servo

LAWS = (law("coulomb"), law("parameter-drift"))
FRICTION = Place(0, "force", 0)


@pytest.mark.slow
@pytest.mark.parametrize(("parameter", "hold"), [(0, "zero"), (1, "linear")])
def test_a_drifting_parameter_beside_friction(parameter, hold):
    rng = np.random.default_rng(0)
    count, dt = 300, 0.05
    u = np.repeat(rng.standard_normal(count // 15), 15)
    position, speed, y = 0.0, 0.0, []
    for force in u:
        y.append(position + 1e-4 * rng.standard_normal())
        for _ in range(100):
            speed += dt / 100 * (force - speed - 0.3 * np.tanh(speed / 1e-2))
            position += dt / 100 * speed
    data = IOData(u=u, y=np.array(y), dt=dt)
    structure = Servo(data)
    records = records_of(data, np.zeros((1, 0)), count * dt, hold=hold)
    setting = Setting(structure, LAWS, dt, True)
    unknowns = empty_unknowns(np.ones(2), 2, 1, 1)
    unknowns = eqx.tree_at(
        lambda tree: (tree.amplitude, tree.shape),
        unknowns,
        (unknowns.amplitude.at[0, 0, 0].set(0.3), unknowns.shape.at[0, 0].set(0.02)),
    )
    gain = gains(setting, records, unknowns.theta, jnp.array([1e-4]), jnp.asarray(1e-2))
    wanted = Place(1, "parameter", parameter, 0)
    trace = along(
        Setting(structure, LAWS, dt), records, slots_of(structure, [FRICTION], 1), unknowns, gain
    )
    ((_, column),) = trial_columns(trace, [wanted])
    # In the model's second slot, with an amplitude of zero.
    slots = slots_of(structure, [FRICTION, wanted], 1)
    place = unknowns.theta.size + AMPLITUDES
    _, exact = sensitivities(setting, records, slots, unknowns, gain, np.array([place]))
    column, exact = column.ravel(), exact.ravel()
    cosine = column @ exact / np.linalg.norm(column) / np.linalg.norm(exact)
    assert cosine > 0.999
    np.testing.assert_allclose(np.linalg.norm(column), np.linalg.norm(exact), rtol=0.05)
