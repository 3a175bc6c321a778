"""The single-link arm against independent mechanics: exact beam theory, Newton equations."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from lpvid.mechanics import integrate, reference_single_link_arm

ARM = reference_single_link_arm()
LOADED = reference_single_link_arm(payload_mass=0.3)
EI, RHO = 68.9e9 * 0.051 * 0.003**3 / 12, 2700 * 0.051 * 0.003

frequencies = eqx.filter_jit(lambda arm: arm.natural_frequencies())
driven = eqx.filter_jit(lambda arm, state, torque: arm.driven(state, torque))
bent = st.tuples(st.floats(-1.4, 1.4), *[st.floats(-0.1, 0.1)] * 3)
rates = st.tuples(st.floats(-4.0, 4.0), *[st.floats(-1.0, 1.0)] * 3)


def exact_frequencies(payload, count, inertia=0.0035):
    """Roots of the beam equation: y(0) = 0, J ÿ'(0) = EI y''(0), y''(1) = 0, m ÿ = EI y'''(1)."""

    def determinant(k):
        square = EI * k**4 / RHO
        c, s, ch, sh = np.cos(k), np.sin(k), np.cosh(k), np.sinh(k)
        # Columns: cos − cosh, sin, sinh; the last row is divided by k.
        rows = [
            [2 * EI * k, -inertia * square, -inertia * square],
            [-(c + ch) / ch, -s / ch, sh / ch],
            [
                (EI * k**3 * (s - sh) + payload * square * (c - ch)) / ch,
                (-EI * k**3 * c + payload * square * s) / ch,
                (EI * k**3 * ch + payload * square * sh) / ch,
            ],
        ]
        return np.linalg.det(rows)

    grid = np.linspace(0.5, 14.0, 2000)
    values = np.array([determinant(k) for k in grid])
    crossings = np.flatnonzero(values[:-1] * values[1:] < 0)[:count]
    roots = np.array([brentq(determinant, grid[i], grid[i + 1]) for i in crossings])
    return np.sqrt(EI / RHO) * roots**2


def test_frequencies_are_near_those_of_the_thesis():
    poles = np.asarray(ARM.linearised().poles())
    poles = poles[poles.imag > 1.0]
    damped = np.sort(np.abs(poles)) / (2 * np.pi)
    for found in (damped, np.asarray(frequencies(ARM)) / (2 * np.pi)):
        np.testing.assert_allclose(found, [9.0, 25.0, 48.0], rtol=0.15)


@pytest.mark.parametrize("payload", [0.0, 0.2, 0.3, 0.4])
def test_frequencies_converge_to_those_of_the_continuous_beam(payload):
    exact = exact_frequencies(payload, 3)
    three = frequencies(reference_single_link_arm(payload_mass=payload))
    many = frequencies(reference_single_link_arm(payload_mass=payload, modes=8))
    # Rayleigh–Ritz: from above, and a tip mass is what free-tip modes show last.
    assert np.all(np.asarray(three) > exact * (1 - 1e-9))
    assert np.all(np.asarray(three) >= np.asarray(many)[:3])
    np.testing.assert_allclose(many[:3], exact, rtol=3e-3)
    np.testing.assert_allclose(three, exact, rtol=0.03 if payload else 2e-3)


# Independent route: 60 points of the bent beam, Newton's law projected on their Jacobian.
_X, _W = np.polynomial.legendre.leggauss(60)
_X, _W = (_X + 1) / 2, _W / 2
_BETA = np.array([1.8751040687, 4.6940911330, 7.8547574382])
_SIGMA = (np.cosh(_BETA) + np.cos(_BETA)) / (np.sinh(_BETA) + np.sin(_BETA))
_PLACES = np.append(_X, 1.0)


def slope(eta, x):
    b = _BETA * x[..., None]
    shapes = np.sinh(b) + np.sin(b) - _SIGMA * (np.cosh(b) - np.cos(b))
    return (_BETA * shapes) @ eta


_INNER = _PLACES[:, None] * _X[None, :]


def points(q):
    deflection = _PLACES * (slope(q[1:], _INNER) @ _W)
    shortening = 0.5 * _PLACES * (slope(q[1:], _INNER) ** 2 @ _W)
    along, across = _PLACES - shortening, deflection
    cosine, sine = jnp.cos(q[0]), jnp.sin(q[0])
    return jnp.stack([cosine * along - sine * across, sine * along + cosine * across], axis=1)


@jax.jit
def newton(q, qd, torque, payload):
    jacobian = jax.jacfwd(points)(q)
    centripetal = jax.jvp(lambda p: jax.jvp(points, (p,), (qd,))[1], (q,), (qd,))[1]
    masses = jnp.append(RHO * jnp.asarray(_W), payload)
    mass = jnp.einsum("p,pci,pcj->ij", masses, jacobian, jacobian).at[0, 0].add(0.0035)
    stiffness = EI * jnp.asarray(_BETA) ** 4
    damping = 2 * 0.005 * jnp.sqrt(stiffness * RHO)
    forces = jnp.concatenate([torque[None], -stiffness * q[1:] - damping * qd[1:]])
    return jnp.linalg.solve(mass, forces - jnp.einsum("p,pci,pc->i", masses, jacobian, centripetal))


@given(q=bent, qd=rates)
@settings(max_examples=15, deadline=None)
def test_equations_of_motion_match_projected_newton_equations(q, qd):
    q, qd, torque = jnp.asarray(q), jnp.asarray(qd), jnp.asarray(0.7)
    derivative = driven(LOADED, jnp.concatenate([q, qd]), torque)
    expected = newton(q, qd, torque, 0.3)
    np.testing.assert_array_equal(derivative[:4], qd)
    # The mode's wave numbers are typed in to ten digits.
    scale = np.abs(expected).max() + 1.0
    np.testing.assert_allclose(derivative[4:], expected, atol=1e-7 * scale)


def test_energy_is_conserved_without_damping():
    free = dataclasses.replace(LOADED, damping_ratios=jnp.zeros(3), viscous_friction=0.0)
    start = jnp.array([0.2, 0.08, 0.02, -0.005, 1.0, 0.5, -0.3, 0.2])

    @jax.jit
    def energies(start):
        still = jnp.zeros((1000, 1))
        states = integrate(lambda x, u: free.dynamics(x, u[0]), start, still, 2.5e-4)
        kinetic = jax.vmap(free.kinetic_energy)(states[:, :4], states[:, 4:])
        return kinetic, kinetic + jax.vmap(free.potential_energy)(states[:, :4])

    kinetic, total = energies(start)
    assert np.ptp(kinetic) > 0.3 * total[0]
    np.testing.assert_allclose(total, total[0], rtol=1e-6)


def test_linearised_model_from_mass_stiffness_and_gains():
    model = LOADED.linearised(tip=True)
    mass = np.asarray(LOADED.mass_matrix(jnp.zeros(4)))
    stiffness = np.diag(np.append(0.0, EI * _BETA**4))
    damping = np.diag(np.append(0.12, 0.01 * np.sqrt(EI * _BETA**4 * RHO)))
    inverse = np.linalg.inv(mass)
    expected = np.block([[np.zeros((4, 4)), np.eye(4)], [-inverse @ stiffness, -inverse @ damping]])
    np.testing.assert_allclose(model.A, expected, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(model.B[4:, 0], 0.5 * 0.3 * inverse[:, 0], rtol=1e-12)
    np.testing.assert_array_equal(model.D, np.zeros((5, 1)))
    output = np.zeros((5, 8))
    output[0, 0], output[3, 4] = 3.0 / np.deg2rad(35.0), 1.0
    step = 1e-4
    for row, place in ((1, 0.02), (2, 0.5)):
        around = np.array([place - step, place + step])
        curvature = np.stack([np.diff(slope(e, around)) for e in np.eye(3)])[:, 0] / (2 * step)
        output[row, 1:4] = 2e4 * 0.0015 * curvature
    output[4, 1:4] = [2.0, -2.0, 2.0]
    np.testing.assert_allclose(model.C, output, rtol=1e-5, atol=1e-9)


def test_frequencies_have_the_gradient_of_finite_differences():
    def first(payload, stiffness):
        arm = dataclasses.replace(ARM, payload_mass=payload, bending_stiffness=stiffness)
        return arm.natural_frequencies()[1]

    at = (jnp.asarray(0.25), jnp.asarray(8.0))
    gradient = jax.jit(jax.grad(first, (0, 1)))(*at)
    for k, h in enumerate((1e-5, 1e-4)):
        ahead, behind = ([a + s * h * (i == k) for i, a in enumerate(at)] for s in (1, -1))
        expected = (first(*ahead) - first(*behind)) / (2 * h)
        np.testing.assert_allclose(gradient[k], expected, rtol=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"payload_mass": -0.1}, "non-negative"),
        ({"length": 0.0}, "positive"),
        ({"gauge_positions": jnp.array([0.02, 1.5])}, "off the beam"),
        ({"gauge_gains": jnp.ones(3)}, "shape"),
        ({"damping_ratios": jnp.zeros(0)}, "mode"),
    ],
)
def test_impossible_arms_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(ARM, **change)


def test_no_modes_are_refused():
    with pytest.raises(ValueError, match="at least 1"):
        reference_single_link_arm(modes=0)
