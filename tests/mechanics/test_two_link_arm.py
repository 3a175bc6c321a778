"""The two-link arm against independent mechanics: projected Newton equations, rigid closed form."""

import dataclasses

import control
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from hypothesis import given, settings
from hypothesis import strategies as st

from lpvid._results import Status
from lpvid.mechanics import TwoLinkFlexibleArm, integrate, reference_two_link_arm

ARM = reference_two_link_arm()
ANGLES = [i * np.pi / 8 for i in range(1, 8)]
bent = st.tuples(
    st.floats(-np.pi, np.pi), st.floats(0.3, 2.8), st.floats(-0.4, 0.4), st.floats(-0.4, 0.4)
).map(lambda q: jnp.asarray(q, float))
rates = st.tuples(*[st.floats(-2.0, 2.0)] * 4).map(lambda q: jnp.asarray(q, float))

mass_matrix = eqx.filter_jit(ARM.mass_matrix)
dynamics = eqx.filter_jit(ARM.dynamics)
kinetic_energy = eqx.filter_jit(ARM.kinetic_energy)
joint_velocities = eqx.filter_jit(ARM.joint_velocities)
tip_angles = jax.jit(lambda q: ARM.rigid_inverse_kinematics(ARM.end_effector(q)))


def changed(**values):
    return dataclasses.replace(ARM, **values)


# Independent route: the arm as 42 points in the plane, Newton's law projected on their Jacobian.
_X, _W = np.polynomial.legendre.leggauss(20)
_X, _W = (_X + 1) / 2, _W / 2
_L, _RHO = (0.35, 0.30), (0.6, 0.4)
POINT_MASSES = np.concatenate([_W * _RHO[0] * _L[0], [1.0], _W * _RHO[1] * _L[1], [0.3]])


def points(q):
    theta1, theta2, v1, v2 = q

    def segment(x, v, angle):
        along, across = x - 2 / 3 * x**3 * v**2, x**2 * v
        rotation = jnp.stack([jnp.cos(angle), jnp.sin(angle), -jnp.sin(angle), jnp.cos(angle)])
        return jnp.stack([along, across], axis=1) @ rotation.reshape(2, 2)

    first = segment(jnp.append(_X * _L[0], _L[0]), v1, theta1)
    second = first[-1:] + segment(
        jnp.append(_X * _L[1], _L[1]), v2, theta1 + theta2 + 2 * _L[0] * v1
    )
    return jnp.concatenate([first, second])


@jax.jit
def newton(q, qd, torques):
    jacobian = jax.jacfwd(points)(q)
    centripetal = jax.jvp(lambda p: jax.jvp(points, (p,), (qd,))[1], (q,), (qd,))[1]
    hub = jnp.array([1.0, 1.0, 2 * _L[0], 0.0])
    mass = jnp.einsum("p,pci,pcj->ij", POINT_MASSES, jacobian, jacobian)
    mass = mass.at[0, 0].add(0.02) + 0.008 * jnp.outer(hub, hub)
    spring = jnp.array([0.0, 0.0, 4 * 40.0 * _L[0], 4 * 18.0 * _L[1]])
    inertial = jnp.einsum("p,pci,pc->i", POINT_MASSES, jacobian, centripetal)
    right = jnp.concatenate([torques, jnp.zeros(2)]) - spring * q - inertial
    return mass, jnp.linalg.solve(mass, right)


@given(q=bent, qd=rates)
@settings(max_examples=20, deadline=None)
def test_equations_of_motion_match_projected_newton_equations(q, qd):
    reference = jnp.array([0.3, -0.2])
    torques = jnp.array([8.0, 3.0]) * (reference - qd[:2])
    mass, expected = newton(q, qd, torques)
    np.testing.assert_allclose(mass_matrix(q), mass, rtol=1e-10, atol=1e-13)
    state = jnp.concatenate([q, qd])
    derivative = dynamics(state, reference)
    np.testing.assert_allclose(derivative[:4], qd)
    np.testing.assert_allclose(derivative[4:], expected, rtol=1e-8, atol=1e-8)


@given(q=bent, qd=rates)
@settings(max_examples=20, deadline=None)
def test_mass_matrix_is_symmetric_positive_definite_and_gives_the_energy(q, qd):
    mass = np.asarray(mass_matrix(q))
    np.testing.assert_allclose(mass, mass.T, atol=1e-14)
    assert np.linalg.eigvalsh(mass).min() > 0.0
    np.testing.assert_allclose(kinetic_energy(q, qd), 0.5 * qd @ mass @ qd, rtol=1e-12)


@pytest.mark.parametrize("theta2", ANGLES[::3])
def test_rigid_block_is_the_known_two_link_mass_matrix(theta2):
    (l1, l2), (r1, r2) = _L, _RHO
    i1 = r1 * l1**3 / 3 + 1.0 * l1**2 + (r2 * l2 + 0.3) * l1**2 + 0.02
    i2 = r2 * l2**3 / 3 + 0.3 * l2**2 + 0.008
    h = (r2 * l2 / 2 + 0.3) * l1 * l2 * np.cos(theta2)
    rigid = [[i1 + i2 + 2 * h, i2 + h], [i2 + h, i2]]
    mass = mass_matrix(jnp.array([0.4, theta2, 0.0, 0.0]))
    np.testing.assert_allclose(mass[:2, :2], rigid, rtol=1e-13)
    # The limit of stiff segments: (M s + Λ)⁻¹ Λ from references to joint velocities.
    stiff = changed(bending_stiffnesses=(4e7, 1.8e7)).linearised(theta2)
    a, b, c = (np.asarray(matrix) for matrix in (stiff.A, stiff.B, stiff.C))
    for omega in (3.0, 40.0, 300.0):
        flexible = c @ np.linalg.solve(1j * omega * np.eye(6) - a, b)
        gains = np.diag([8.0, 3.0])
        expected = np.linalg.solve(1j * omega * np.array(rigid) + gains, gains)
        np.testing.assert_allclose(flexible, expected, atol=1e-4)


def test_energy_is_conserved_without_loops():
    free = changed(velocity_gains=(0.0, 0.0))
    start = jnp.array([0.2, 1.3, 0.05, -0.1, 0.5, -1.0, 0.3, 0.2])

    def energy(state):
        return free.kinetic_energy(state[:4], state[4:]) + free.potential_energy(state[:4])

    @jax.jit
    def energies(start):
        states = integrate(free.dynamics, start, jnp.zeros((2000, 2)), 1e-4, every=100)
        return jax.vmap(energy)(states), states

    energy_along, states = energies(start)
    assert np.ptp(states[:, 2]) > 0.05
    np.testing.assert_allclose(energy_along, energy_along[0], rtol=1e-9)


def test_loops_dissipate_and_come_to_rest():
    start = jnp.array([0.0, 1.3, 0.05, -0.1, 0.5, -1.0, 0.3, 0.2])

    @jax.jit
    def final(start):
        return integrate(ARM.dynamics, start, jnp.zeros((6000, 2)), 1e-4, every=500)

    states = final(start)
    np.testing.assert_allclose(states[-1, 2:], 0.0, atol=1e-4)


def test_poles_at_a_right_angle():
    poles = np.sort_complex(np.linalg.eigvals(ARM.linearised(np.pi / 2).A))
    expected = [-698.1, -125.7, -45.6 - 143.5j, -45.6 + 143.5j, -21.6 - 31.5j, -21.6 + 31.5j]
    np.testing.assert_allclose(poles, expected, atol=0.051 * np.sqrt(2))


@pytest.mark.parametrize("theta2", ANGLES)
def test_linearisation_has_the_pattern_of_equation_32(theta2):
    model = ARM.linearised(theta2)
    free = np.asarray(ARM.structured_parameters(theta2)).reshape(4, 4).T
    pattern = np.zeros((6, 6))
    pattern[:2, 4:] = np.eye(2)
    pattern[2:, :4] = free
    np.testing.assert_allclose(model.A, pattern, rtol=1e-9, atol=1e-9)
    drives = np.vstack([np.zeros((2, 2)), -free[:, 2:]])
    np.testing.assert_allclose(model.B, drives, rtol=1e-9, atol=1e-9)
    known = [[0, 0, 1, 0, 0.35, 0], [0, 0, 0, 1, 0.35, 0.30]]
    np.testing.assert_allclose(model.C, known, atol=1e-12)
    np.testing.assert_array_equal(model.D, np.zeros((2, 2)))


def test_structured_parameters_from_mass_and_stiffness():
    theta2 = ANGLES[1]
    inverse = np.linalg.inv(mass_matrix(jnp.array([0.0, theta2, 0.0, 0.0])))
    expected = [
        -56.0 * inverse[:, 2],
        -21.6 * inverse[:, 3],
        -8 * inverse[:, 0],
        -3 * inverse[:, 1],
    ]
    np.testing.assert_allclose(
        ARM.structured_parameters(theta2), np.concatenate(expected), rtol=1e-10
    )
    hessian = jax.hessian(ARM.potential_energy)(jnp.array([0.1, 1.0, 0.2, -0.1]))
    np.testing.assert_allclose(ARM.stiffness_matrix(), hessian, atol=1e-12)


def test_linearisation_against_finite_differences():
    rest, step = jnp.array([0.0, 1.1] + [0.0] * 6), 1e-5
    model = ARM.linearised(1.1)

    def slope(function, at, direction):
        return (function(at + step * direction) - function(at - step * direction)) / (2 * step)

    for column in range(6):
        direction = jnp.zeros(8).at[column + 2].set(1.0)
        a = slope(lambda x: dynamics(x, jnp.zeros(2)), rest, direction)[2:]
        c = slope(lambda x: joint_velocities(x[:4], x[4:]), rest, direction)
        np.testing.assert_allclose(model.A[:, column], a, rtol=1e-6, atol=1e-5)
        np.testing.assert_allclose(model.C[:, column], c, atol=1e-8)
    for column in range(2):
        b = slope(lambda u: dynamics(rest, u), jnp.zeros(2), jnp.eye(2)[column])[2:]
        np.testing.assert_allclose(model.B[:, column], b, rtol=1e-6, atol=1e-8)


def square_references(amplitude, samples=2000, hold=100):
    signs = jax.random.rademacher(jax.random.key(5), (samples // hold, 2), float)
    return amplitude * jnp.repeat(signs, hold, axis=0)


def test_small_motions_follow_the_linearised_model():
    reference, theta2 = square_references(1e-4), ANGLES[2]
    motion = ARM.simulate(reference=reference, dt=1e-4, theta2_start=theta2)
    assert motion.status == Status.successful
    model = ARM.linearised(theta2)
    sampled = control.ss(*(np.asarray(m) for m in (model.A, model.B, model.C, model.D)))
    expected = control.forced_response(sampled.sample(1e-4), inputs=np.asarray(reference).T)
    np.testing.assert_allclose(motion.y, expected.outputs.T, atol=1e-4 * 5e-4)


def test_motion_does_not_depend_on_the_first_angle():
    reference = square_references(0.5)
    motions = [
        ARM.simulate(reference=reference, dt=1e-4, theta2_start=1.0, theta1_start=angle)
        for angle in (0.0, 2.5)
    ]
    np.testing.assert_allclose(motions[0].y, motions[1].y, atol=1e-11)
    turned = motions[1].positions.at[:, 0].add(-2.5)
    np.testing.assert_allclose(motions[0].positions, turned, atol=1e-11)


def test_simulation_against_an_adaptive_integrator():
    reference = jnp.broadcast_to(jnp.array([1.0, -2.0])[None], (2000, 2))
    motion = ARM.simulate(reference=reference, dt=1e-4, theta2_start=1.5)
    solution = scipy.integrate.solve_ivp(
        lambda t, x: np.asarray(dynamics(jnp.asarray(x), reference[0])),
        (0.0, 0.2),
        [0.0, 1.5] + [0.0] * 6,
        method="DOP853",
        t_eval=1e-4 * np.arange(2000),
        rtol=1e-9,
        atol=1e-11,
    )
    np.testing.assert_allclose(motion.positions, solution.y[:4].T, atol=1e-8)
    np.testing.assert_allclose(motion.velocities, solution.y[4:].T, atol=1e-6)


def stiffness_cost(stiffnesses):
    motion = changed(bending_stiffnesses=stiffnesses).simulate(
        reference=square_references(0.2), dt=1e-4, theta2_start=1.0, every=10
    )
    return jnp.sum(motion.y[:, 0] ** 2) - jnp.sum(motion.y[:, 1] ** 2)


def stiffness_slopes():
    steps = 1e-4 * jnp.concatenate([jnp.eye(2), -jnp.eye(2)])
    costs = jax.jit(jax.vmap(stiffness_cost))(jnp.array([[40.0, 18.0]]) + steps)
    return np.asarray(costs[:2] - costs[2:]) / 2e-4


@pytest.mark.slow
def test_gradient_of_a_simulation_with_respect_to_the_stiffnesses():
    gradient = jax.jit(jax.jacfwd(stiffness_cost))(jnp.array([40.0, 18.0]))
    np.testing.assert_allclose(gradient, stiffness_slopes(), rtol=1e-5)


@pytest.mark.slow
def test_reverse_mode_gradient_of_a_simulation():
    gradient = jax.jit(jax.grad(stiffness_cost))(jnp.array([40.0, 18.0]))
    np.testing.assert_allclose(gradient, stiffness_slopes(), rtol=1e-5)


@given(theta1=st.floats(-3.1, 3.1), theta2=st.floats(0.01, 3.13))
@settings(max_examples=30, deadline=None)
def test_inverse_kinematics_round_trip(theta1, theta2):
    angles = tip_angles(jnp.array([theta1, theta2, 0.0, 0.0]))
    # The first angle comes back modulo a turn.
    difference = np.angle(np.exp(1j * (np.asarray(angles) - [theta1, theta2])))
    np.testing.assert_allclose(difference, 0.0, atol=1e-11)


@given(q=bent, qd=rates)
@settings(max_examples=20, deadline=None)
def test_output_is_the_rate_of_the_rigid_angles(q, qd):
    step = 1e-6
    difference = np.asarray(tip_angles(q + step * qd)) - np.asarray(tip_angles(q - step * qd))
    turned = np.angle(np.exp(1j * difference))
    np.testing.assert_allclose(joint_velocities(q, qd), turned / (2 * step), rtol=1e-5, atol=1e-6)


def test_diverging_integration_is_said_in_the_status():
    motion = ARM.simulate(reference=square_references(0.2)[:400], dt=1e-2, theta2_start=1.0)
    assert motion.status == Status.nonfinite


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ({"link_lengths": (0.0, 0.3)}, "link_lengths"),
        ({"payload_mass": -0.1}, "payload_mass"),
        ({"velocity_gains": (-1.0, 3.0)}, "velocity_gains"),
    ],
)
def test_impossible_arms_are_refused(values, name):
    with pytest.raises(ValueError, match=name):
        changed(**values)


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"reference": np.zeros((10, 3))}, "reference"),
        ({"theta2_start": 3.5}, "theta2_start"),
        ({"dt": -1e-4}, "dt"),
        ({"every": 3}, "every=3"),
    ],
)
def test_impossible_simulations_are_refused(options, name):
    with pytest.raises(ValueError, match=name):
        ARM.simulate(
            **({"reference": np.zeros((10, 2)), "dt": 1e-4, "theta2_start": 1.0} | options)
        )


def test_arms_are_batched_by_vmap():
    payloads = jnp.array([0.0, 0.3])
    batch = jax.vmap(lambda mass: changed(payload_mass=mass).structured_parameters(1.0))(payloads)
    assert isinstance(ARM, TwoLinkFlexibleArm)
    np.testing.assert_allclose(batch[1], ARM.structured_parameters(1.0), rtol=1e-12)
    assert np.abs(batch[0] / batch[1] - 1.0).max() > 0.1
