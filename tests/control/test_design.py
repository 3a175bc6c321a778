"""Designs: gradients through the simulation, optima, Riccati equations against SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from lpvid._results import Status, is_successful
from lpvid.control import (
    PDP,
    ProportionalIntegral,
    _design_pdp,
    closed_loop,
    design_ilqr,
    design_pdp,
    design_pi,
    itae,
    kalman,
    loop_transfer,
    lqr,
    margins,
    pdp_cost,
    simulate_closed_loop,
)
from lpvid.models import StateSpace

DT = 0.05


def arm(inertia: float) -> StateSpace:
    """A hub of that inertia and one flexible mode, with the four sensors of 002."""
    flexible = np.array([[0.0, 1.0], [-60.0 / inertia, -1.5]])
    A = scipy.linalg.block_diag(np.array([[0.0, 1.0], [0.0, -1.0]]), flexible)
    B = np.array([[0.0], [1.0 / inertia], [0.0], [-1.0]])
    C = np.array(
        [[4.0, 0.0, 0.2, 0.0], [0.0, 0.0, 2.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 1.0, 0.0, 0.05]]
    )
    return StateSpace(A, B, C).discretise(DT)


@pytest.fixture(scope="module")
def systems() -> StateSpace:
    """Three random ones, and one like an arm: an integrator and a hardly damped mode."""
    rng = np.random.default_rng(0)
    A = np.concatenate([rng.normal(size=(3, 4, 4)), np.zeros((1, 4, 4))])
    A[3] = scipy.linalg.block_diag([[0.0, 1.0], [0.0, -0.5]], [[0.0, 1.0], [-900.0, -0.1]])
    return StateSpace(A, rng.normal(size=(4, 4, 2)), rng.normal(size=(4, 1, 4)))


Q, R = np.diag([2.0, 1.0, 0.0, 0.5]), np.array([[2.0, 0.3], [0.3, 1.0]])


@pytest.mark.parametrize("dt", [pytest.param(0.0, marks=pytest.mark.slow), DT])
def test_riccati_agrees_with_scipy(systems, dt):
    models = systems.discretise(dt) if dt else systems
    solve = scipy.linalg.solve_discrete_are if dt else scipy.linalg.solve_continuous_are
    regulator, observer = lqr(models, Q, R), kalman(models, Q, 0.3)
    for i in range(4):
        A, B, C = (np.asarray(m[i]) for m in (models.A, models.B, models.C))
        X = solve(A, B, Q, R)
        np.testing.assert_allclose(regulator.cost[i], X, atol=1e-9 * np.abs(X).max())
        P = solve(A.T, C.T, Q, [[0.3]])
        np.testing.assert_allclose(observer.cost[i], P, atol=1e-9 * np.abs(P).max())
        for poles in (
            np.linalg.eigvals(A - B @ regulator.gain[i]),
            np.linalg.eigvals(A - np.asarray(observer.gain[i]) @ C),
        ):
            assert np.all(np.abs(poles) < 1.0 if dt else poles.real < 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("dt", [0.0, DT])
def test_gains_have_derivatives(systems, dt):
    models = systems.discretise(dt) if dt else systems
    direction = np.random.default_rng(1).normal(size=models.A.shape)

    @jax.jit
    def value_and_slope(step):
        def total(step):
            moved = StateSpace(models.A + step * direction, models.B, models.C, dt=dt)
            weight = Q * (1.0 + step)
            return jnp.sum(lqr(moved, weight, R).gain ** 2, axis=(-2, -1))

        return total(step), jax.jacrev(total)(step)

    h = 1e-5
    expected = (value_and_slope(h)[0] - value_and_slope(-h)[0]) / (2 * h)
    np.testing.assert_allclose(value_and_slope(0.0)[1], expected, rtol=1e-5)


@pytest.mark.slow
def test_lqr_is_optimal_and_cross_weights_shift():
    """Any other gain costs more; a cross weight is a change of the input."""
    model = StateSpace([[1.0, DT], [0.0, 1.0]], [[0.0], [DT]], [[1.0, 0.0]], dt=DT)
    found = lqr(model, [1.0, 0.1], 0.5)
    start = np.array([1.0, 0.0])

    def cost(gain):
        closed = np.asarray(model.A) - np.asarray(model.B) @ gain
        weight = np.diag([1.0, 0.1]) + 0.5 * gain.T @ gain
        return start @ scipy.linalg.solve_discrete_lyapunov(closed.T, weight) @ start

    gain = np.asarray(found.gain)
    np.testing.assert_allclose(cost(gain), start @ np.asarray(found.cost) @ start, rtol=1e-9)
    assert all(cost(gain + delta) > cost(gain) for delta in ([[0.1, 0]], [[-0.1, 0]], [[0, 0.1]]))
    # uᵀRu + 2xᵀNu + xᵀQx with Q = Q₀ + N R⁻¹ Nᵀ is Q₀ and R in v = u + R⁻¹ Nᵀ x.
    N = np.array([[0.2], [0.1]])
    crossed = lqr(model, np.diag([1.0, 0.1]) + N @ N.T / 0.5, 0.5, N)
    shifted = StateSpace(model.A - model.B @ N.T / 0.5, model.B, model.C, dt=DT)
    expected = lqr(shifted, [1.0, 0.1], 0.5).gain + N.T / 0.5
    np.testing.assert_allclose(crossed.gain, expected, rtol=1e-9)


def test_lqr_refuses_wrong_weights():
    model = StateSpace(np.eye(2), np.ones((2, 1)), np.ones((1, 2)), dt=1.0)
    for weights, message in (
        (([1.0, 1.0, 1.0], 1.0), "state_weight has shape"),
        (([1.0, -1.0], 1.0), "positive semidefinite"),
        (([1.0, 1.0], 0.0), "input_weight must be positive definite"),
        (([[1.0, 1.0], [0.0, 1.0]], 1.0), "not symmetric"),
    ):
        with pytest.raises(ValueError, match=message):
            lqr(model, *weights)


@pytest.mark.slow
def test_itae_and_its_gradient_through_the_loop():
    model = arm(1.0)
    reference = jnp.ones(80)

    @jax.jit
    def value_and_slope(gains):
        def cost(gains):
            controller = ProportionalIntegral(gains[0], gains[1], dt=DT)
            motion = simulate_closed_loop(model, controller, reference=reference)
            return itae(reference - motion.y[:, 0], DT)

        return cost(gains), jax.grad(cost)(gains)

    gains, h = np.array([0.3, 0.02]), 1e-6
    for axis in np.eye(2):
        numbers = [value_and_slope(gains + sign * h * axis)[0] for sign in (1.0, -1.0)]
        expected = (numbers[0] - numbers[1]) / (2 * h)
        np.testing.assert_allclose(value_and_slope(gains)[1] @ axis, expected, rtol=1e-5)
    y = closed_loop(model, ProportionalIntegral(*gains, dt=DT)).simulate(u=reference)[:, 0]
    time = DT * np.arange(80)
    expected = DT * np.sum(time * np.abs(1.0 - np.asarray(y)))
    np.testing.assert_allclose(value_and_slope(gains)[0], expected, rtol=1e-10)


@pytest.mark.slow
def test_pi_design_finds_the_least_cost():
    """A motor: the grid's best lies no lower than the best start's end, and the bounds hold."""
    motor = StateSpace([[0.0, 1.0], [0.0, -4.0]], [[0.0], [4.0]], [[1.0, 0.0]]).discretise(DT)
    bounds = ((0.1, 1e-4), (3.0, 0.2))
    found = design_pi(motor, starts=((0.3, 0.1), (2.5, 0.01)), bounds=bounds, duration=6.0)
    np.testing.assert_allclose(found.costs[0], found.costs[1], rtol=1e-4)
    assert np.all(np.asarray(found.gains) >= bounds[0])
    assert np.all(np.asarray(found.gains) <= bounds[1])
    assert isinstance(found.controller, ProportionalIntegral)

    @jax.jit
    @jax.vmap
    def cost(gain):
        loop = closed_loop(motor, ProportionalIntegral(gain, 1e-4, dt=DT))
        return itae(3.0 - loop.simulate(u=jnp.full((120, 1), 3.0))[:, 0], DT)

    grid = jnp.linspace(0.1, 3.0, 60)
    assert float(found.cost) <= float(jnp.min(cost(grid))) * (1 + 1e-6)
    with pytest.raises(ValueError, match="leave the bounds"):
        design_pi(motor, starts=((5.0, 0.1),))


@pytest.mark.slow
def test_ilqr_follows_at_rest_and_places_its_poles():
    model = arm(1.0)
    found = design_ilqr(
        model,
        state_weight=model.C.T @ jnp.diag(jnp.array([1.0, 0.0, 0.1, 0.1])) @ model.C,
        input_weight=1.0,
        state_noise=model.B @ model.B.T,
        output_noise=1e-4,
    )
    loop = closed_loop(model, found)
    # Separation: the loop's poles are those of the regulator and of the observer.
    A, B, C = (np.asarray(m) for m in (model.A, model.B, model.C[:1]))
    regulated = A - B @ np.asarray(found.feedback)[None]
    at_rest = C @ np.linalg.solve(np.eye(4) - regulated, B) * float(found.feedforward)
    np.testing.assert_allclose(at_rest, 1.0, rtol=1e-9)
    regulator = np.linalg.eigvals(regulated)
    observer = np.linalg.eigvals(A - np.asarray(found.observer)[:, None] @ C)
    # The integral, with a gain of zero, adds a pole at one that nothing sees.
    expected = np.sort_complex(np.concatenate([regulator, observer, [1.0]]))
    np.testing.assert_allclose(np.sort_complex(np.asarray(loop.poles())), expected, atol=1e-7)


@pytest.mark.slow
def test_pdp_design_meets_a_margin_that_binds(monkeypatch):
    models = [arm(1.0)]
    asked = {
        "starts": ((0.8, 3.0, 0.5),),
        "bounds": ((0.05, 0.05, 0.005), (3.0, 8.0, 1.0)),
        "gain_margin": 1.0,
        "duration": 2.5,
        "max_steps": 10,
    }
    free = design_pdp(models, phase_margin=1.0, **asked)
    least = float(margins(loop_transfer(models[0], free.controller)).phase_margin)
    bound = design_pdp(models, phase_margin=least + 4.0, **asked)
    held = float(margins(loop_transfer(models[0], bound.controller)).phase_margin)
    assert held >= (least + 4.0) * (1 - 1e-3)
    assert float(bound.cost) > float(free.cost)
    monkeypatch.setattr(_design_pdp, "_ROUNDS", 1)
    impossible = design_pdp(models, phase_margin=179.0, **asked)
    assert impossible.status == Status.infeasible and not is_successful(impossible.status)


@pytest.mark.slow
def test_pdp_cost_is_its_definition_and_has_derivatives():
    model, duration = arm(1.0), 4.0

    @jax.jit
    def value_and_slope(gains):
        def both(gains):
            return jnp.stack(pdp_cost(model, PDP(*gains), duration=duration))

        return both(gains), jax.jacfwd(both)(gains)

    gains, h = jnp.array([0.5, 2.0, 0.1]), 1e-6
    y = np.asarray(closed_loop(model, PDP(*gains)).simulate(u=np.ones((80, 1))))
    time = DT * np.arange(80)
    strains = sum(np.abs(y[:, i]) / np.abs(y[:, i]).max() for i in (1, 2))
    expected = [DT * np.sum(time * np.abs(1 - y[:, 0])), DT * np.sum(time * strains)]
    np.testing.assert_allclose(value_and_slope(gains)[0], expected, rtol=1e-10)
    for k, axis in enumerate(jnp.eye(3)):
        change = value_and_slope(gains + h * axis)[0] - value_and_slope(gains - h * axis)[0]
        np.testing.assert_allclose(value_and_slope(gains)[1][:, k], change / (2 * h), rtol=1e-4)
