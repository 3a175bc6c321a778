"""Mass–spring–damper against SciPy's generalised eigenproblem and published frequencies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from lpvid.mechanics import MassSpringDamper

SYSTEMS = [MassSpringDamper.reference(), MassSpringDamper.micro_manipulator()]


@pytest.mark.parametrize("system", SYSTEMS)
def test_modes_against_scipy(system):
    squares, shapes = scipy.linalg.eigh(system.stiffness, system.mass)
    modes = system.modes()
    np.testing.assert_allclose(modes.frequencies, np.sqrt(squares), rtol=1e-10)
    np.testing.assert_allclose(np.abs(modes.shapes), np.abs(shapes), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(modes.shapes.T @ system.mass @ modes.shapes, np.eye(2), atol=1e-10)


def test_micro_manipulator_frequencies():
    hertz = MassSpringDamper.micro_manipulator().modes().frequencies / (2 * np.pi)
    np.testing.assert_allclose(hertz, [83.1, 96.7], atol=0.05)


def test_modal_damping_is_exact_where_the_modes_are_classical():
    mass = jnp.array([[2.0, 0.3], [0.3, 1.0]])
    stiffness = jnp.array([[50.0, -7.0], [-7.0, 90.0]])
    system = MassSpringDamper(mass, 0.02 * mass + 0.004 * stiffness, stiffness)
    modes = system.modes()
    expected = 0.5 * (0.02 / modes.frequencies + 0.004 * modes.frequencies)
    np.testing.assert_allclose(modes.damping_ratios, expected, rtol=1e-12)
    poles = np.linalg.eigvals(system.state_space().A)
    damping = np.sort(-poles.real / np.abs(poles))[::2]
    np.testing.assert_allclose(damping, np.sort(expected), rtol=1e-8)


@pytest.mark.parametrize("system", SYSTEMS)
def test_state_space_has_the_receptance(system):
    model = system.state_space()
    a, b, c = (np.asarray(matrix) for matrix in (model.A, model.B, model.C))
    m, d, k = (np.asarray(x) for x in (system.mass, system.damping, system.stiffness))
    for omega in (0.5, 11.0, 500.0):
        dynamic = k + 1j * omega * d - omega**2 * m
        response = c @ np.linalg.solve(1j * omega * np.eye(4) - a, b)
        np.testing.assert_allclose(response, np.linalg.inv(dynamic), rtol=1e-9, atol=1e-12)


def test_gradient_of_a_frequency_against_finite_differences():
    system = MassSpringDamper.reference()

    def lowest(coupling):
        stiffness = jnp.stack(
            [jnp.stack([100.0 + coupling, -coupling]), jnp.stack([-coupling, 100.0 + coupling])]
        )
        return MassSpringDamper(system.mass, system.damping, stiffness).modes().frequencies[0]

    slope = (lowest(jnp.array(5.001)) - lowest(jnp.array(4.999))) / 2e-3
    np.testing.assert_allclose(jax.grad(lowest)(jnp.array(5.0)), slope, rtol=1e-6)


@pytest.mark.parametrize(
    ("matrices", "word"),
    [
        ((np.eye(2), np.eye(3), np.eye(2)), "damping"),
        ((np.eye(2), np.eye(2), np.array([[1.0, 0.5], [0.0, 1.0]])), "stiffness is not symmetric"),
        ((np.diag([1.0, 0.0]), np.eye(2), np.eye(2)), "positive definite"),
    ],
)
def test_impossible_systems_are_refused(matrices, word):
    with pytest.raises(ValueError, match=word):
        MassSpringDamper(*matrices)
