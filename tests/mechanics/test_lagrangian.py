"""Equations of motion, integrator and linearisation against SciPy and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.linalg

from lpvid.mechanics import accelerations, inertia_matrix, integrate, linearise

A = np.array([[0.0, 1.0, 0.0], [-4.0, -0.4, 1.0], [0.0, -1.0, -3.0]])
B = np.array([[0.0], [1.0], [0.5]])


def linear_dynamics(x, u):
    return jnp.asarray(A) @ x + jnp.asarray(B) @ u


def double_pendulum_kinetic(q, qd, params):
    m1, m2, l1, l2 = params
    return 0.5 * (m1 + m2) * l1**2 * qd[0] ** 2 + 0.5 * m2 * (
        l2**2 * qd[1] ** 2 + 2.0 * l1 * l2 * qd[0] * qd[1] * jnp.cos(q[0] - q[1])
    )


def double_pendulum_potential(q, params):
    m1, m2, l1, l2 = params
    return -9.81 * ((m1 + m2) * l1 * jnp.cos(q[0]) + m2 * l2 * jnp.cos(q[1]))


def test_double_pendulum_accelerations_against_the_textbook():
    m1, m2, l1, l2, g = 1.3, 0.7, 0.9, 0.6, 9.81
    params = tuple(jnp.asarray(p) for p in (m1, m2, l1, l2))
    a, b, da, db = 0.7, -0.4, 1.1, -2.3
    actual = jax.jit(accelerations, static_argnums=(0, 1))(
        double_pendulum_kinetic,
        double_pendulum_potential,
        jnp.array([a, b]),
        jnp.array([da, db]),
        jnp.zeros(2),
        params,
    )
    c, s = np.cos(a - b), np.sin(a - b)
    mass = np.array([[(m1 + m2) * l1, m2 * l2 * c], [l1 * c, l2]])
    right = np.array(
        [-m2 * l2 * db**2 * s - (m1 + m2) * g * np.sin(a), l1 * da**2 * s - g * np.sin(b)]
    )
    np.testing.assert_allclose(actual, np.linalg.solve(mass, right), rtol=1e-12)


@pytest.mark.parametrize("dof", [1, 5])
def test_accelerations_solve_with_a_full_mass_matrix(dof):
    rng = np.random.default_rng(dof)
    half = rng.normal(size=(dof, dof))
    mass = jnp.asarray(half @ half.T + np.eye(dof))
    forces = jnp.asarray(rng.normal(size=dof))

    def kinetic(q, qd, m):
        return 0.5 * qd @ m @ qd

    zero = jnp.zeros(dof)
    solve = jax.jit(accelerations, static_argnums=(0, 1))
    actual = solve(kinetic, lambda q, m: jnp.zeros(()), zero, zero, forces, mass)
    np.testing.assert_allclose(actual, scipy.linalg.solve(mass, forces), rtol=1e-10)
    np.testing.assert_allclose(inertia_matrix(kinetic, zero, mass), mass, rtol=1e-14)


def exact_samples(inputs, dt):
    block = scipy.linalg.expm(np.block([[A, B], [np.zeros((1, 4))]]) * dt)
    state, states = np.array([1.0, 0.0, -1.0]), []
    for u in inputs:
        states.append(state)
        state = block[:3, :3] @ state + block[:3, 3:] @ u
    return np.array(states)


def test_integrator_is_of_fourth_order_under_a_held_input():
    inputs = jax.random.normal(jax.random.key(0), (12, 1), float)
    start, exact = jnp.array([1.0, 0.0, -1.0]), exact_samples(np.asarray(inputs), 0.2)
    errors = [
        np.abs(integrate(linear_dynamics, start, inputs, 0.2, substeps=s) - exact).max()
        for s in (4, 8)
    ]
    assert errors[1] < 1e-6
    assert 14.0 < errors[0] / errors[1] < 18.0


def test_every_keeps_every_kth_sample():
    inputs = jax.random.normal(jax.random.key(1), (12, 1), float)
    start = jnp.array([1.0, 0.0, -1.0])
    full = integrate(linear_dynamics, start, inputs, 0.05)
    np.testing.assert_allclose(
        integrate(linear_dynamics, start, inputs, 0.05, every=4), full[::4], rtol=1e-14
    )


def test_integrator_against_an_adaptive_one_on_a_nonlinear_oscillator():
    def dynamics(x, u):
        return jnp.stack([x[1], (1.0 - x[0] ** 2) * x[1] - x[0] + u[0]])

    states = integrate(dynamics, jnp.array([0.5, 0.0]), jnp.ones((40, 1)), 0.1, substeps=20)
    reference = scipy.integrate.solve_ivp(
        lambda t, x: [x[1], (1.0 - x[0] ** 2) * x[1] - x[0] + 1.0],
        (0.0, 4.0),
        [0.5, 0.0],
        method="DOP853",
        t_eval=0.1 * np.arange(40),
        rtol=1e-11,
        atol=1e-12,
    )
    np.testing.assert_allclose(states, reference.y.T, atol=1e-7)


def test_gradient_through_the_integrator_matches_finite_differences():
    def cost(log_rate):
        def dynamics(x, u):
            return -jnp.exp(log_rate) * x**3 + u

        states = integrate(dynamics, jnp.ones(1), 0.3 * jnp.ones((10, 1)), 0.1, every=5, substeps=2)
        return jnp.sum(states**2)

    slope = (cost(0.3 + 1e-6) - cost(0.3 - 1e-6)) / 2e-6
    np.testing.assert_allclose(jax.grad(cost)(0.3), slope, rtol=1e-7)
    np.testing.assert_allclose(jax.jvp(cost, (0.3,), (1.0,))[1], slope, rtol=1e-7)


def test_linearise_recovers_a_linear_system():
    model = linearise(linear_dynamics, lambda x, u: x[:1] + 2.0 * u, jnp.ones(3), jnp.ones(1))
    np.testing.assert_allclose(model.A, A, atol=1e-15)
    np.testing.assert_allclose(model.B, B, atol=1e-15)
    np.testing.assert_allclose(model.C, [[1.0, 0.0, 0.0]], atol=1e-15)
    np.testing.assert_allclose(model.D, [[2.0]], atol=1e-15)
    assert model.dt == 0.0


@pytest.mark.parametrize(
    ("options", "word"), [({"every": 5}, "every=5"), ({"substeps": 0}, "substeps=0")]
)
def test_integrate_refuses_what_does_not_divide(options, word):
    with pytest.raises(ValueError, match=word):
        integrate(linear_dynamics, jnp.zeros(3), jnp.zeros((12, 1)), 0.1, **options)
