"""The two-link arm with ports: beside the one from its energies, and its start."""

import jax.numpy as jnp
import numpy as np
import pytest

from lpvid.data import IOData
from lpvid.loop.structures import structure_named
from lpvid.mechanics import reference_two_link_arm, two_link_arm_gray_box

ARM = reference_two_link_arm()
GAIN = 8.0


def _truth():
    # All but the first velocity gain, which is given.
    return np.delete(np.asarray(two_link_arm_gray_box(ARM).parameters), 8)


@pytest.mark.slow
def test_matrices_are_those_of_the_energies():
    data = IOData(u=np.zeros((9, 2)), y=np.zeros((9, 2)), dt=1e-3, kappa=0.3)
    structure = structure_named("two-link-arm", data, velocity_gain=GAIN)
    degrees = data.replace(units={"kappa": "deg"})
    turned = structure_named("two-link-arm", degrees, velocity_gain=GAIN)
    for theta2 in (0.5, 2.0):
        ports = structure.ports(jnp.asarray(_truth()), jnp.cos(theta2)[None])
        expected = ARM.linearised(theta2)
        for name in "ABC":
            matrix = getattr(expected, name)
            error = np.abs(getattr(ports, name) - matrix).max()
            assert error < 1e-12 * np.abs(matrix).max()
        # The drive's torque enters as a force on the joint does.
        np.testing.assert_allclose(GAIN * ports.force[0, :, 0], ports.B[:, 0])
        again = turned.ports(jnp.asarray(_truth()), jnp.rad2deg(jnp.array([theta2])))
        np.testing.assert_allclose(again.A, ports.A, rtol=1e-10, atol=1e-9)


@pytest.mark.slow
def test_parameters_from_records_at_four_postures():
    random = np.random.default_rng(5)
    inputs, outputs, schedules = [], [], []
    for theta2 in (0.6, 1.2, 1.8, 2.5):
        u = 0.3 * np.repeat(np.sign(random.standard_normal((40, 2))), 20, axis=0)
        y = np.asarray(ARM.linearised(theta2).simulate(u=u, dt=1e-3))
        inputs.append(u)
        outputs.append(y + 1e-3 * y.std() * random.standard_normal(y.shape))
        schedules.append(np.full((len(u), 1), np.cos(theta2)))
    data = IOData(u=inputs, y=outputs, kappa=schedules, dt=1e-3)
    structure = structure_named("two-link-arm", data, velocity_gain=GAIN)
    np.testing.assert_allclose(structure.start(data), _truth(), rtol=0.05)
