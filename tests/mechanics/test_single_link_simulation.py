"""The arm in motion: linear limit, friction that sticks, backlash, delay, sensors, control."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
from scipy.signal import dlsim

from lpvid._results import Status
from lpvid.mechanics import (
    ArmEffects,
    Backlash,
    BoundedPosition,
    DryFriction,
    InputDelay,
    OpenLoop,
    ProportionalDerivative,
    Quantisation,
    SampledController,
    reference_single_link_arm,
    simulate_single_link,
)

ARM = reference_single_link_arm()
DT, N = 1 / 300, 300
PUSH = np.where(np.arange(N) % 100 < 40, 1.0, -1.0)
FRICTION = ArmEffects(friction=DryFriction(0.4))


def linear_model(arm=ARM):
    model = arm.linearised().discretise(DT)
    return tuple(np.asarray(m) for m in (model.A, model.B, model.C, model.D))


def relative(error, truth):
    return np.linalg.norm(error, axis=0) / np.linalg.norm(truth, axis=0)


def test_small_motions_follow_the_linearised_model():
    motion = simulate_single_link(ARM, reference=0.01 * PUSH, dt=DT)
    assert motion.status == Status.successful
    expected = dlsim((*linear_model(), DT), 0.01 * PUSH)[1]
    assert relative(motion.y - expected, expected).max() < 2e-4
    tips = np.array([2.0, -2.0, 2.0])
    np.testing.assert_allclose(motion.tip_deflection, motion.positions[:, 1:] @ tips, rtol=1e-9)
    np.testing.assert_array_equal(motion.u[:, 0], 0.01 * PUSH)


def test_friction_holds_the_drive_without_creep():
    # 0.39 A against 0.4 A.
    held = simulate_single_link(ARM, reference=np.full(N, 0.78), dt=DT, effects=FRICTION)
    assert np.abs(held.positions).max() < 1e-15
    # Stopped while the beam swings: it holds as soon as the beam's pull is below the level.
    pushed = simulate_single_link(ARM, reference=3.0 * (np.arange(N) < 30), dt=DT, effects=FRICTION)
    angle, speed = pushed.positions[:, 0], pushed.velocities[:, 0]
    assert angle.max() > 0.05
    assert np.ptp(pushed.y[-50:, 1]) > 0.05
    # Second order in the integrator's step of 0.4 ms: ½ h² times a change of 22 rad/s² at 60 rad/s,
    # to and fro with the clamped beam's 15 rad/s.
    bound = 0.5 * 4.2e-4**2 * 22 * 60
    assert np.abs(speed[-50:]).max() < bound
    assert np.ptp(angle[-50:]) < 2 * bound / 15


def test_sliding_friction_is_a_constant_current():
    # Always in one direction, friction is an offset of the input; a slow start excites no reversal.
    command = 3.2 * np.minimum(np.arange(N) / 200, 1.0)
    rough = simulate_single_link(ARM, reference=command + 0.8, dt=DT, effects=FRICTION)
    smooth = simulate_single_link(ARM, reference=command, dt=DT)
    assert np.all(np.diff(rough.positions[1:, 0]) > 0.0)
    assert rough.positions[-1, 0] > 0.3
    np.testing.assert_allclose(rough.positions, smooth.positions, atol=1e-5)


@pytest.mark.slow
def test_friction_against_a_stiff_solver():
    """A steep smooth law under an implicit variable-step solver, as independent as it gets."""
    steep, friction = 1e-4, DryFriction(0.4, breakaway=0.6, stribeck_speed=0.3)
    rough = ArmEffects(friction=friction)
    command = 2.0 * PUSH
    motion = simulate_single_link(ARM, reference=command, dt=DT, effects=rough, substeps=16)
    dynamics = jax.jit(lambda x, current: ARM.dynamics(x, current))
    jacobian = jax.jit(jax.jacfwd(lambda x, current: ARM.dynamics(x, current)))

    def current(speed, u):
        return 0.5 * u - np.tanh(speed / steep) * (0.4 + 0.2 * np.exp(-((speed / 0.3) ** 2)))

    def right(_, x, u):
        return np.asarray(dynamics(x, current(x[4], u)))

    def gradient(_, x, u):
        along = np.zeros(8)
        along[4] = (current(x[4] + 1e-7, u) - current(x[4] - 1e-7, u)) / 2e-7
        gain = np.asarray(dynamics(x, np.float64(1.0)) - dynamics(x, np.float64(0.0)))
        return np.asarray(jacobian(x, current(x[4], u))) + np.outer(gain, along)

    np.testing.assert_allclose(friction.level(jnp.array([0.0, 5.0])), [0.6, 0.4])
    state, states = np.zeros(8), []
    for u in command[:150]:
        states.append(state)
        state = scipy.integrate.solve_ivp(
            right, (0.0, DT), state, "Radau", jac=gradient, args=(u,), rtol=1e-6, atol=1e-8
        ).y[:, -1]
    states = np.array(states)
    assert np.abs(states[:, 4]).max() > 0.3
    assert np.sum(np.abs(np.diff(np.sign(states[:, 4]))) > 0) >= 3
    assert relative(motion.positions[:150] - states[:, :4], states[:, :4]).max() < 0.01


def test_backlash_lets_the_motor_run_and_then_drives_the_hub():
    loose = ArmEffects(backlash=Backlash(0.02))
    motion = simulate_single_link(ARM, reference=np.ones(N), dt=DT, effects=loose)
    # Until half the gap is closed the hub stands: ½ (0.5 A · 0.3 N·m/A / 0.002 kg·m²) t² = 0.01.
    free = int(np.sqrt(2 * 0.01 / 75.0) / DT)
    assert np.abs(motion.positions[: free + 1, 0]).max() == 0.0
    assert np.abs(motion.positions[free + 3, 0]) > 0.0
    # Without a gap it is a stiff spring in the gear: the rigid arm, but for the mesh's ringing.
    tight = ArmEffects(backlash=Backlash(0.0))
    rigid = simulate_single_link(ARM, reference=np.ones(N), dt=DT)
    closed = simulate_single_link(ARM, reference=np.ones(N), dt=DT, effects=tight)
    error = relative(closed.positions - rigid.positions, rigid.positions)
    assert error[:2].max() < 0.02
    push = Backlash(0.02).torque(
        jnp.array([0.011, 0.011, -0.011, 0.009]), jnp.array([0.0, -9, 9, 9])
    )
    np.testing.assert_allclose(push, [0.5, 0.0, 0.0, 0.0], atol=1e-12)


def test_delay_of_a_fraction_equals_a_whole_one_on_a_finer_grid():
    def positions(u, dt, seconds, substeps):
        effects = ArmEffects(delay=InputDelay(seconds))
        return simulate_single_link(
            ARM, reference=u, dt=dt, effects=effects, substeps=substeps
        ).positions

    late = positions(PUSH[:150], DT, 2.5 * DT, 8)
    fine = np.concatenate([np.zeros(5), np.repeat(PUSH[:150], 2)])[:300]
    expected = simulate_single_link(ARM, reference=fine, dt=DT / 2, substeps=4).positions[::2]
    np.testing.assert_allclose(late, expected, atol=1e-12)
    # A delay within one substep is averaged there: the impulse is kept.
    fraction = positions(PUSH[:150], DT, 0.3 * DT, 8)
    exact = simulate_single_link(
        ARM, reference=np.repeat(PUSH[:30], 10), dt=DT / 10, substeps=1
    ).positions
    shifted = np.concatenate([np.zeros((3, 4)), exact])[:300:10]
    np.testing.assert_allclose(fraction[:30], shifted, atol=2e-6)


def test_sensor_errors_add_up_and_are_quantised():
    effects = ArmEffects(
        current_limit=1.0,
        sensor_offset=0.1,
        sensor_drift=jnp.array([0.0, 0.5, 0.0, -0.5]),
        noise=jnp.array([0.0, 0.02, 0.05, 0.0]),
        quantisation=Quantisation(),
    )
    key = jax.random.key(4)
    motion = simulate_single_link(ARM, reference=4.0 * PUSH, dt=DT, effects=effects, key=key)
    clean = simulate_single_link(ARM, reference=2.0 * PUSH, dt=DT)
    np.testing.assert_allclose(motion.positions, clean.positions, atol=1e-12)
    steps = np.asarray(motion.y) / (20 / 4096)
    np.testing.assert_array_equal(steps, np.round(steps))
    time = DT * np.arange(N)[:, None]
    error = np.asarray(motion.y - clean.y) - 0.1 - time * np.array([0.0, 0.5, 0.0, -0.5])
    assert np.abs(error[:, [0, 3]]).max() <= 10 / 4096 + 1e-12
    np.testing.assert_allclose(error[:, 1:3].std(axis=0), [0.02, 0.05], rtol=0.15)
    np.testing.assert_array_equal(Quantisation()(jnp.array([99.0, -99.0])), [10 - 20 / 4096, -10.0])


def test_closed_loop_equals_its_linear_recursion():
    asked = 0.02 * PUSH
    pd = ProportionalDerivative(1.0, 2.8)
    motion = simulate_single_link(ARM, reference=asked, dt=DT, controller=pd)
    A, B, C, _ = linear_model()
    state, u, y = np.zeros(8), [], []
    for r in asked:
        y.append(C @ state)
        u.append((r - y[-1][0]) - 2.8 * y[-1][3])
        state = A @ state + B[:, 0] * u[-1]
    assert relative(motion.y - np.array(y), np.array(y)).max() < 2e-4
    assert relative(motion.u[:, 0] - np.array(u), np.array(u)) < 2e-4


class Lagging(SampledController):
    """PD with an input of its own memory: a state that is a tuple."""

    gain: jax.Array

    def initial(self):
        return jnp.zeros(1), jnp.zeros((), int)

    def step(self, state, reference, y):
        last, count = state
        command = 0.5 * last + self.gain * (reference - y[:1]) - 1.4 * y[-1:]
        return (command, count + 1), command


@pytest.mark.slow
def test_controllers_batch_over_payloads_set_points_and_noise():
    effects = ArmEffects(friction=DryFriction(0.4), noise=0.01, quantisation=Quantisation())
    payloads, set_points = jnp.array([0.0, 0.2, 0.4]), jnp.array([1.0, 3.0, 5.0])
    keys = jax.random.split(jax.random.key(0), 3)

    def final(payload, set_point, key, controller):
        arm = dataclasses.replace(ARM, payload_mass=payload)
        asked = jnp.full(N, set_point)
        return simulate_single_link(
            arm, reference=asked, dt=DT, controller=controller, effects=effects, key=key
        ).y

    controller = Lagging(jnp.asarray(1.0))
    batch = jax.jit(jax.vmap(final, (0, 0, 0, None)))(payloads, set_points, keys, controller)
    assert batch.shape == (3, N, 4)
    single = final(payloads[1], set_points[1], keys[1], controller)
    np.testing.assert_allclose(batch[1], single, atol=1.5 * 20 / 4096)
    assert np.all(np.asarray(batch)[:, -1, 0] > 0.1)


def tracking_cost(parameters):
    payload, derivative, coulomb = parameters
    motion = simulate_single_link(
        dataclasses.replace(ARM, payload_mass=payload),
        reference=jnp.full(60, 3.0),
        dt=DT,
        controller=ProportionalDerivative(1.0, derivative),
        effects=ArmEffects(friction=DryFriction(coulomb)),
        substeps=4,
    )
    return jnp.mean((3.0 - motion.y[:, 0]) ** 2) + jnp.mean(motion.y[:, 1] ** 2)


POINT = jnp.array([0.1, 2.0, 0.2])


def test_derivatives_through_the_closed_loop():
    direction = jnp.array([0.5, -1.0, 0.7])

    @jax.jit
    def both(at):
        return jax.jvp(tracking_cost, (at,), (direction,))

    slope = both(POINT)[1]
    ahead, behind = (both(POINT + s * 1e-5 * direction)[0] for s in (1, -1))
    np.testing.assert_allclose(slope, (ahead - behind) / 2e-5, rtol=1e-5)


@pytest.mark.slow
def test_reverse_mode_agrees_with_finite_differences():
    both = jax.jit(jax.value_and_grad(tracking_cost))
    gradient = both(POINT)[1]
    for k in range(3):
        step = 1e-5 * jnp.eye(3)[k]
        expected = (both(POINT + step)[0] - both(POINT - step)[0]) / 2e-5
        np.testing.assert_allclose(gradient[k], expected, rtol=1e-4)


def test_bounded_position_turns_at_the_bounds_and_remembers():
    controller = BoundedPosition(3.0)
    state, signs = controller.initial(), []
    for angle in (0.0, 2.9, 3.1, 2.0, -2.9, -3.1, 0.0):
        state, command = controller.step(state, jnp.array([2.0]), jnp.array([angle, 0, 0, 0]))
        signs.append(float(command[0]))
    assert signs == [2.0, 2.0, -2.0, -2.0, -2.0, 2.0, 2.0]
    assert OpenLoop().initial() is None


def test_divergence_is_a_status():
    wild = simulate_single_link(
        reference_single_link_arm(modes=6), reference=PUSH, dt=DT, substeps=1
    )
    assert wild.status == Status.nonfinite


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: simulate_single_link(ARM, reference=np.zeros((2, 2, 2)), dt=DT), "reference"),
        (lambda: simulate_single_link(ARM, reference=PUSH, dt=0.0), "dt"),
        (lambda: simulate_single_link(ARM, reference=PUSH, dt=DT, substeps=0), "substeps"),
        (
            lambda: simulate_single_link(ARM, reference=PUSH, dt=DT, effects=ArmEffects(noise=0.1)),
            "key",
        ),
        (
            lambda: simulate_single_link(
                ARM, reference=PUSH, dt=DT, effects=ArmEffects(delay=InputDelay(1.0))
            ),
            "capacity",
        ),
        (
            lambda: simulate_single_link(
                dataclasses.replace(ARM, rotor_inertia=0.0),
                reference=PUSH,
                dt=DT,
                effects=ArmEffects(backlash=Backlash(0.02)),
            ),
            "rotor_inertia",
        ),
        (lambda: DryFriction(-0.1), "coulomb"),
        (lambda: DryFriction(0.4, stribeck_speed=0.0), "positive"),
        (lambda: Backlash(jnp.ones(2)), "one number"),
        (lambda: Quantisation(bits=0), "bits"),
        (lambda: ArmEffects(noise=-1.0), "noise"),
    ],
)
def test_faults_name_the_argument(call, message):
    with pytest.raises(ValueError, match=message):
        call()
