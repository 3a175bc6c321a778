"""Controllers and closed loops against loops computed by hand and against the arm's simulator."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from lpvid._results import Status
from lpvid.control import (
    ILQR,
    PDP,
    PDPC,
    ProportionalIntegral,
    closed_loop,
    controller_model,
    loop_transfer,
    simulate_closed_loop,
)
from lpvid.mechanics import (
    ArmEffects,
    DryFriction,
    InputDelay,
    ProportionalDerivative,
    Quantisation,
    reference_single_link_arm,
    simulate_single_link,
)
from lpvid.models import StateSpace

DT = 0.1
LAG = StateSpace([[-1.0]], [[2.0]], [[1.0]])
GAINS = (0.8, 1.5)


def by_hand(samples, *, limit=np.inf, late=0.0, clamp=False):
    """PI on ẏ = −y + 2u, sample by sample; `late` is the delay as a share of the sample."""
    x, total, before, y, u = 0.0, 0.0, 0.0, [], []
    first, rest = np.exp(-late * DT), np.exp(-(1 - late) * DT)
    for _ in range(samples):
        error = 1.0 - x
        command = GAINS[0] * error + GAINS[1] * (total + DT * error)
        # Clamped, the integral stands still while the error drives a cut command further out.
        if not (clamp and abs(command) > limit and error * command > 0.0):
            total += DT * error
        command = GAINS[0] * error + GAINS[1] * total
        command = np.clip(command, -limit, limit) if clamp else command
        y.append(x)
        u.append(command)
        acting = np.clip(command, -limit, limit)
        x = first * x + 2 * (1 - first) * before
        x = rest * x + 2 * (1 - rest) * acting
        before = acting
    return np.array(y), np.array(u)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, {}),
        pytest.param({"saturation": 0.6}, {"limit": 0.6}, marks=pytest.mark.slow),
        ({"saturation": 0.6, "delay": InputDelay(0.03)}, {"limit": 0.6, "late": 0.3}),
        pytest.param({"delay": InputDelay(0.1)}, {"late": 1.0}, marks=pytest.mark.slow),
    ],
)
def test_pi_loop_is_the_one_computed_by_hand(options, expected):
    controller = ProportionalIntegral(*GAINS, dt=DT)
    found = simulate_closed_loop(LAG, controller, reference=np.ones(40), dt=DT, **options)
    y, u = by_hand(40, **expected)
    np.testing.assert_allclose(found.y[:, 0], y, atol=1e-12)
    np.testing.assert_allclose(found.u[:, 0], u, atol=1e-12)
    assert found.status == Status.successful
    if not options:
        loop = closed_loop(LAG, controller, dt=DT)
        np.testing.assert_allclose(loop.simulate(u=np.ones(40))[:, 0], y, atol=1e-12)


@pytest.mark.slow
def test_quantised_noisy_batches_of_gains_and_keys():
    quantisation = Quantisation(bits=8, full_scale=2.0)
    keys = jax.random.split(jax.random.key(0), 3)

    def one(gain, key):
        return simulate_closed_loop(
            LAG,
            ProportionalIntegral(gain, 1.0, dt=DT),
            reference=jnp.ones(30),
            dt=DT,
            quantisation=quantisation,
            noise=0.05,
            key=key,
        )

    found = jax.vmap(one)(jnp.array([0.5, 0.5, 0.8]), keys)
    steps = np.asarray(found.y) / quantisation.step
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    assert np.any(found.y[0] != found.y[1])
    error = np.asarray(found.y[..., 0]) - np.asarray(found.states[..., 0])
    assert 0.03 < error.std() < 0.08


@pytest.mark.slow
def test_a_batch_of_models_and_growth_beyond_bounds():
    batch = StateSpace([[[0.5]], [[2.0]]], [[1.0]], [[1.0]], dt=DT)
    found = simulate_closed_loop(
        batch, ProportionalIntegral(0.1, 0.0, dt=DT), reference=jnp.ones(60)
    )
    assert found.y.shape == (2, 60, 1)
    assert np.all(np.isfinite(found.y))
    assert np.asarray(found.status == Status.overflow).tolist() == [False, True]


@pytest.mark.slow
def test_the_arm_is_that_of_the_simulator():
    arm = reference_single_link_arm(modes=1)
    controller, reference = ProportionalDerivative(1.0, 2.8), 3.0 * jnp.ones(40)
    effects = ArmEffects(friction=DryFriction(0.4))
    found = simulate_closed_loop(
        arm,
        controller,
        reference=reference,
        dt=1 / 300,
        saturation=2.0,
        quantisation=Quantisation(),
        effects=effects,
    )
    whole = ArmEffects(
        friction=DryFriction(0.4), quantisation=Quantisation(), current_limit=2.0 * arm.current_gain
    )
    expected = simulate_single_link(
        arm, reference=reference, dt=1 / 300, controller=controller, effects=whole
    )
    np.testing.assert_array_equal(found.y, expected.y)
    np.testing.assert_array_equal(found.u, expected.u)
    with pytest.raises(ValueError, match="quantisation is given twice"):
        simulate_closed_loop(
            arm,
            controller,
            reference=reference,
            dt=1 / 300,
            quantisation=Quantisation(),
            effects=whole,
        )


def test_anti_windup_clamps_the_integral():
    limited = ProportionalIntegral(*GAINS, dt=DT, limit=0.6)
    found = simulate_closed_loop(LAG, limited, reference=np.ones(40), dt=DT)
    y, u = by_hand(40, limit=0.6, clamp=True)
    np.testing.assert_allclose(found.y[:, 0], y, atol=1e-12)
    np.testing.assert_allclose(found.u[:, 0], u, atol=1e-12)
    assert np.any(np.abs(u) == 0.6)
    assert y.max() < by_hand(40, limit=0.6)[0].max() - 0.02
    # An integral that returns from beyond the limit is let go.
    error, beyond = jnp.array([-0.1]), jnp.array([1.0])
    total, command = limited.step(beyond, error, jnp.zeros(4))
    np.testing.assert_allclose(total, [0.99], atol=1e-12)
    assert command == 0.6
    with pytest.raises(ValueError, match="limit=0.0 must be positive"):
        ProportionalIntegral(*GAINS, dt=DT, limit=0.0)


def test_ilqr_observes_the_command_within_its_limit():
    drift = StateSpace([[1.0]], [[1.0]], [[1.0]], dt=DT)
    gains = {"feedback": [0.6], "observer": [0.5], "feedforward": 0.6, "integral": 1.0}
    free, limited = ILQR(drift, **gains), ILQR(drift, **gains, limit=0.25)
    start = jnp.array([0.2]), jnp.array([0.05])
    for reference, clamps in ((0.1, False), (2.0, True), (-2.0, True)):
        asked, y = jnp.array([reference]), jnp.array([0.3])
        (x, total), command = limited.step(start, asked, y)
        (_, summed), plain = free.step(start, asked, y)
        kept = 0.05 if clamps else float(summed[0])
        expected = np.clip(0.6 * reference + kept - 0.6 * 0.2, -0.25, 0.25)
        if reference == 0.1:
            np.testing.assert_allclose(plain, expected, atol=1e-12)
        np.testing.assert_allclose(command, expected, atol=1e-12)
        np.testing.assert_allclose(total, kept, atol=1e-12)
        np.testing.assert_allclose(x, 0.2 + expected + 0.5 * (0.3 - 0.2), atol=1e-12)


def test_pdp_and_pdpc_laws():
    pdp = PDP(0.5, 3.0, 0.1)
    y = jnp.array([2.0, 9.0, 0.4, 0.1])
    effort = 0.5 * (3.0 - 2.0) - 3.0 * 0.1 - 0.1 * 0.4
    np.testing.assert_allclose(pdp.step(None, jnp.array([3.0]), y)[1], [effort])
    pdpc, always = PDPC(pdp), PDPC(pdp, rule="always")

    def added(controller, error, speed, strain=0.0):
        y = jnp.array([3.0 - error, 0.0, strain, speed])
        reference = jnp.array([3.0])
        command = controller.step(None, reference, y)[1] - pdp.step(None, reference, y)[1]
        return round(float(command[0]), 9)

    # Far away, moving, both: on, with the sign of the effort, which speed and strain can turn.
    assert added(pdpc, 0.2, 0.0) == 0.7
    assert added(pdpc, -0.2, 0.0) == -0.7
    assert added(pdpc, 0.2, 0.1) == -0.7
    assert added(pdpc, 0.2, 0.0, strain=2.0) == -0.7
    assert added(pdpc, 0.01, -0.06) == 0.7
    # At rest near the set-point: off; without the condition it stays on.
    assert added(pdpc, 0.04, 0.04) == 0.0
    assert added(pdpc, -0.04, -0.04) == 0.0
    assert added(always, 0.04, 0.04) == -0.7
    assert added(always, 0.0, 0.0) == 0.7
    # The edge of the band belongs to the compensation.
    exact = PDPC(pdp, band=0.25)
    assert added(exact, 0.25, 0.0) == 0.7
    assert added(exact, 0.2499, 0.0) == 0.0


def test_precise_compensation_goes_by_the_error_that_is_left():
    pdp, step = PDP(0.5, 3.0, 0.1), 0.01
    precise = PDPC(pdp, 0.8, rule="precise", resolution=step, averaging=4.0)
    errors = step * np.repeat([2.0, 0.8, 0.6, 0.4, -0.9, -1.2, -0.7, 0.0], 30)
    speeds = np.tile([0.0, 0.02], errors.size // 2)

    def one(state, now):
        error, speed = now
        y = jnp.stack([3.0 - error, 0.0, 0.0, speed])
        state, command = precise.step(state, jnp.array([3.0]), y)
        return state, command[0] - pdp.step(None, jnp.array([3.0]), y)[1][0]

    _, added = jax.lax.scan(one, precise.initial(), (jnp.asarray(errors), jnp.asarray(speeds)))
    # Whatever speed and strain do: on from one step of the low-passed error, off at half of one.
    at_end = np.asarray(added).reshape(8, 30)[:, -1]
    np.testing.assert_allclose(at_end, 0.8 * np.array([1, 1, 1, 0, 0, -1, -1, 0]), atol=1e-9)
    # Late by the low-pass: 2 steps (1 - 0.75^k) reach one step at k = 3.
    np.testing.assert_allclose(np.asarray(added)[:4], [0.0, 0.0, 0.8, 0.8], atol=1e-9)
    # Far away and moving it is the conditional law.
    for y in ([2.0, 0.0, 0.0, 0.0], [3.1, 0.0, 0.0, 0.0], [3.0, 0.0, 0.0, 0.2]):
        _, command = precise.step(precise.initial(), jnp.array([3.0]), jnp.array(y))
        expected = PDPC(pdp, 0.8).step(None, jnp.array([3.0]), jnp.array(y))[1]
        np.testing.assert_allclose(command, expected)
    with pytest.raises(ValueError, match="at least one sample"):
        PDPC(pdp, averaging=0.5)


@pytest.mark.slow
def test_precise_compensation_ends_within_a_quantisation_step_and_the_published_does_not():
    arm, step = reference_single_link_arm(payload_mass=0.3, modes=1), Quantisation().step
    effects = ArmEffects(friction=DryFriction(0.4), noise=0.005, quantisation=Quantisation())
    left = {}
    for rule in ("precise", "conditional"):
        found = simulate_closed_loop(
            arm,
            PDPC(PDP(0.594, 4.266, 0.254), 0.8, rule=rule),
            reference=2.0 * jnp.ones(7200),
            dt=1 / 300,
            effects=effects,
            key=jax.random.key(5),
            substeps=4,
        )
        angle = float(arm.angle_gain) * np.asarray(found.states)[-600:, 0]
        left[rule] = abs(2.0 - angle.mean()) / step
        # At rest there.
        assert np.ptp(angle) < 0.1 * step
    assert left["precise"] < 1.0
    assert left["conditional"] > 2.0


@pytest.mark.slow
def test_linear_parts_and_loops_opened_at_two_places():
    rng = np.random.default_rng(0)
    A = scipy.linalg.block_diag(0.9, [[0.7, 0.4], [-0.4, 0.7]])
    plant = StateSpace(A, rng.normal(size=(3, 1)), rng.normal(size=(4, 3)), dt=DT)
    gains = (0.05, 0.03, 0.02)
    pdp = PDP(*gains)
    assert jnp.array_equal(
        controller_model(PDPC(pdp), ny=4, dt=DT).D, controller_model(pdp, ny=4, dt=DT).D
    )
    omega = np.array([0.5, 3.0, 20.0])
    G = np.asarray(plant.frequency_response(omega))[:, :, 0]
    inner = 1.0 + gains[2] * G[:, 2] + gains[1] * G[:, 3]
    at_error = loop_transfer(plant, pdp).frequency_response(omega)[:, 0, 0]
    np.testing.assert_allclose(at_error, gains[0] * G[:, 0] / inner, rtol=1e-9)
    at_input = loop_transfer(plant, pdp, at="input").frequency_response(omega)[:, 0, 0]
    np.testing.assert_allclose(at_input, gains[0] * G[:, 0] + inner - 1.0, rtol=1e-9)
    loop = closed_loop(plant, pdp).frequency_response(omega)[:, 0, 0]
    np.testing.assert_allclose(loop, at_error / (1.0 + at_error), rtol=1e-9)


def test_wrong_use():
    pi = ProportionalIntegral(1.0, 0.1, dt=DT)
    through = StateSpace([[0.5]], [[1.0]], [[1.0]], [[1.0]], dt=DT)
    with pytest.raises(ValueError, match="feedthrough"):
        simulate_closed_loop(through, pi, reference=np.ones(4))
    with pytest.raises(ValueError, match="sample time"):
        simulate_closed_loop(LAG, pi, reference=np.ones(4))
    with pytest.raises(ValueError, match="reference has shape"):
        simulate_closed_loop(LAG, pi, reference=np.ones((2, 4, 1)), dt=DT)
    with pytest.raises(ValueError, match="random key"):
        simulate_closed_loop(LAG, pi, reference=np.ones(4), dt=DT, noise=0.1)
    with pytest.raises(ValueError, match="raise its capacity"):
        simulate_closed_loop(LAG, pi, reference=np.ones(4), dt=DT, delay=InputDelay(5.0))
    with pytest.raises(ValueError, match="belong to the arm"):
        simulate_closed_loop(LAG, pi, reference=np.ones(4), dt=DT, effects=ArmEffects())
