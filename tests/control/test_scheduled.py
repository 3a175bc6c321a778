"""Scheduled controllers: interpolation, frozen and moving kappa, checks, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpvid.analysis import hinf_norm
from lpvid.control import (
    PDP,
    OutputFeedback,
    ProportionalIntegral,
    ScheduledController,
    balanced_sensitivity,
    certify_rate,
    check_trajectory,
    controller_model,
    design_ilqr,
    margins,
    schedule_design,
)
from lpvid.mechanics import OpenLoop
from lpvid.models import (
    FreeStructure,
    LPVStateSpace,
    Polynomial,
    Spline,
    StateSpace,
    polynomial_basis,
)

DT = 0.1
KAPPAS = (0.5, 0.8, 1.4)


def oscillator(kappa):
    """Two states, four outputs as the single-link arm has them; stiffness kappa."""
    A = jnp.array([[1.0, 0.1], [0.0, 0.95]]) - kappa[0] * jnp.array([[0.0, 0.0], [0.1, 0.0]])
    C = jnp.array([[1.0, 0.0], [0.0, 0.0], [0.3, 0.0], [0.0, 1.0]])
    return StateSpace(A, jnp.array([[0.0], [0.1]]), C, dt=DT)


def pdp_of(model):
    return PDP(2.0 * model.A[0, 0] - 5.0 * model.A[1, 0], 1.0 + model.A[1, 0] ** 2, 0.1)


@pytest.fixture(scope="module")
def designs():
    return [pdp_of(oscillator(jnp.array([kappa]))) for kappa in KAPPAS]


@pytest.mark.parametrize("method", [None, Spline(), Polynomial(degree=2)])
def test_interpolation_is_exact_at_the_design_points(method, designs):
    control = ScheduledController.from_designs(designs, KAPPAS, method)
    for kappa, design in zip(KAPPAS, designs, strict=True):
        found = jax.tree.leaves(control.at(kappa))
        np.testing.assert_allclose(found, jax.tree.leaves(design), rtol=1e-12)


def test_linear_between_the_points_and_held_beyond(designs):
    control = ScheduledController.from_designs(designs, KAPPAS)
    ends = [designs[k].proportional for k in (1, 2)]
    np.testing.assert_allclose(control.at(1.0).proportional, (2 * ends[0] + ends[1]) / 3)
    with pytest.warns(UserWarning, match="outside of the designs' range"):
        assert control.at(2.0).proportional == control.at(1.4).proportional


def test_at_constant_kappa_it_is_the_frozen_controller():
    designs = [ProportionalIntegral(k, 3.0 * k, dt=DT) for k in KAPPAS]
    control = ScheduledController.from_designs(designs, KAPPAS)
    frozen = control.at(0.9)
    state, memory = control.initial(), frozen.initial()
    for y in (0.0, 0.4, -1.0):
        state, u = control.step(state, jnp.ones(1), jnp.array([y, 0.9]))
        memory, v = frozen.step(memory, jnp.ones(1), jnp.array([y]))
        np.testing.assert_allclose(u, v, rtol=1e-14)
        np.testing.assert_allclose(state, memory, rtol=1e-14)


@pytest.mark.slow
def test_frozen_checks_are_those_of_numpy(designs):
    designed = schedule_design(oscillator, pdp_of, KAPPAS, between=19)
    np.testing.assert_allclose(designed.gains, [jax.tree.leaves(one) for one in designs])
    check = designed.check
    assert check.kappas.shape == (41, 1)
    gains = controller_model(designed.controller.at(0.65), ny=4, dt=DT).D
    plant = oscillator(jnp.array([0.65]))
    at = int(np.flatnonzero(np.isclose(check.kappas[:, 0], 0.65))[0])
    closed = plant.A + plant.B @ gains[:, 1:] @ plant.C
    radius = np.abs(np.linalg.eigvals(np.asarray(closed))).max()
    np.testing.assert_allclose(check.decay[at], -np.log(radius) / DT, rtol=1e-9)
    z = np.exp(1j * np.linspace(1e-3, np.pi, 20001))[:, None, None]
    response = np.linalg.solve(z * np.eye(2)[None] - np.asarray(plant.A)[None], plant.B[None])
    loop = (-np.asarray(gains[:, 1:] @ plant.C) @ response)[:, 0, 0]
    alpha = 2.0 / np.abs((1.0 - loop) / (1.0 + loop)).max()
    np.testing.assert_allclose(check.disc_margin[at], alpha, rtol=1e-6)
    spread = balanced_sensitivity(plant, designed.controller.at(0.65))
    np.testing.assert_allclose(check.disc_margin[at], 2.0 / hinf_norm(spread).value, rtol=1e-9)
    # What a disc margin promises of the single loop.
    single = margins(jax.tree.map(lambda leaf: leaf[at], check.loops[0]))
    assert single.phase_margin >= np.rad2deg(2.0 * np.arctan(alpha / 2.0)) - 1e-6
    assert single.gain_margin_decibels >= 20.0 * np.log10((2.0 + alpha) / (2.0 - alpha)) - 1e-6


def swapping(kappa):
    """Poles of radius below 0.4 at every kappa in [-1, 1], products of 4 between its ends."""
    share = 0.5 * (kappa[0] + 1.0)
    off = jnp.stack([2.0 * share**8, 2.0 * (1.0 - share) ** 8])
    A = 0.3 * jnp.eye(2) + jnp.diag(off[:1], 1) + jnp.diag(off[1:], -1)
    return StateSpace(A, jnp.zeros((2, 1)), jnp.zeros((4, 2)), dt=DT)


def test_stable_frozen_points_that_are_unstable_together_are_found():
    idle = PDP(0.0, 0.0, 0.0)
    grid = np.linspace(-1.0, 1.0, 41)
    for kappa in grid:
        assert np.abs(np.linalg.eigvals(np.asarray(swapping(jnp.array([kappa])).A))).max() < 1.0
    fast = np.resize([-1.0, 1.0], 41)
    found = check_trajectory(swapping, idle, fast)
    product = np.linalg.multi_dot([np.asarray(swapping(jnp.array([k])).A) for k in fast[::-1]])
    expected = np.log(np.abs(np.linalg.eigvals(product)).max()) / (41 * DT)
    np.testing.assert_allclose(found.exponent, expected, rtol=1e-9)
    assert not found.stable
    slow = np.concatenate([grid[::2], grid[-2::-2]])
    assert bool(check_trajectory(swapping, idle, slow).stable)
    certificate = certify_rate(swapping, idle, grid)
    # Jumps over the whole range are not certified; a random walk of allowed steps converges.
    assert float(certificate.spacing) < float(certificate.step) <= 1.0
    reach = int(np.ceil(round(float(certificate.step) * 40, 6))) - 1
    steps = np.random.default_rng(0).integers(-reach, reach + 1, 41)
    walk = np.clip(20 + np.cumsum(steps), 0, 40)
    assert bool(check_trajectory(swapping, idle, grid[walk]).stable)


def test_derivatives_through_design_and_interpolation():
    y = jnp.array([0.3, 0.0, 0.2, 0.1, 0.7])

    def command(weight):
        plants = [oscillator(jnp.array([k])) for k in KAPPAS]
        designs = [PDP(weight * p.A[1, 0], weight**2, 0.1 / weight) for p in plants]
        control = ScheduledController.from_designs(designs, KAPPAS, Spline())
        return control.step(None, jnp.ones(1), y)[1][0]

    slope = (command(0.5 + 1e-5) - command(0.5 - 1e-5)) / 2e-5
    np.testing.assert_allclose(jax.grad(command)(0.5), slope, rtol=1e-6)


@pytest.mark.slow
def test_derivatives_through_riccati_designs_with_observers():
    noise = {"state_noise": 1.0, "output_noise": 1.0}

    def command(weight):
        def design(model):
            return design_ilqr(model, state_weight=1.0, input_weight=weight, **noise)

        control = schedule_design(oscillator, design, KAPPAS, between=0).controller
        y = jnp.array([0.3, 0.0, 0.0, 0.0, 0.7])
        state = control.initial()
        for _ in range(3):
            state, u = control.step(state, jnp.ones(1), y)
        return u[0]

    command = jax.jit(command)
    slope = (command(0.5 + 1e-5) - command(0.5 - 1e-5)) / 2e-5
    np.testing.assert_allclose(jax.jit(jax.grad(command))(0.5), slope, rtol=1e-6)


def test_bad_input_is_refused(designs):
    one, two = designs[:2]
    with pytest.raises(ValueError, match="of one kind"):
        ScheduledController.from_designs([one, OpenLoop()], [0.0, 1.0])
    with pytest.raises(ValueError, match="of one kind"):
        wide, narrow = (OutputFeedback(jnp.ones((1, n)), jnp.ones((1, n))) for n in (2, 3))
        ScheduledController.from_designs([wide, narrow], [0.0, 1.0])
    with pytest.raises(ValueError, match="holds a point twice"):
        ScheduledController.from_designs([one, two], [1.0, 1.0])
    with pytest.raises(ValueError, match="one for each"):
        ScheduledController.from_designs([one, two], KAPPAS)
    with pytest.raises(ValueError, match="two or more finite"):
        ScheduledController.from_designs([one, two], [0.0, np.nan])
    with pytest.raises(ValueError, match="determine 2 of them"):
        ScheduledController.from_designs([one, two], [0.0, 1.0], Polynomial(degree=2))
    with pytest.raises(ValueError, match="kappa has shape"):
        ScheduledController.from_designs(designs, KAPPAS).at([0.5, 0.6])
    with pytest.raises(ValueError, match="give the points to check"):
        schedule_design(oscillator, pdp_of, [[0.0, 1.0], [1.0, 1.0]])
    structure = FreeStructure(2, 1, 4, feedthrough=False)
    basis = polynomial_basis([0.0, 1.0], 0)
    coefficients = jnp.zeros((1, structure.n_parameters))
    lpv = LPVStateSpace(structure, basis, coefficients, jnp.zeros(1), jnp.ones(1))
    with pytest.raises(ValueError, match="outside of the hull"):
        check_trajectory(lpv, one, [0.5, 1.5], dt=DT)
    with pytest.raises(ValueError, match="dt=None"):
        check_trajectory(lpv, one, [0.5, 1.0])
