"""Margins against python-control, a dense sweep of the frequencies, and finite differences."""

import functools

import control
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpvid.analysis import h2_norm, hinf_norm
from lpvid.control import PDP, Margins, loop_transfer, margins
from lpvid.mechanics import reference_single_link_arm
from lpvid.models import StateSpace

DT = 0.3


def _peer(loop: StateSpace):
    return control.ss(*map(np.asarray, (loop.A, loop.B, loop.C, loop.D)), loop.dt)


def _servo(gain: float, lag: float) -> StateSpace:
    """gain / (s (s + 1) (lag s + 1)): an integrator, one crossover of each kind."""
    A = [[0.0, 1.0, 0.0], [0.0, -1.0, 1.0], [0.0, 0.0, -1.0 / lag]]
    return StateSpace(A, [[0.0], [0.0], [gain / lag]], [[1.0, 0.0, 0.0]])


# 1 / (s (s + 1)) and 0.5 / (s + 1), with states that nothing reaches.
WITHOUT_PHASE_CROSSOVER = StateSpace(
    [[0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -5.0]], [[0.0], [1.0], [0.0]], [[1.0, 0.0, 0.0]]
)
NOTHING_CROSSED = StateSpace(-np.diag([1.0, 4.0, 5.0]), [[1.0], [0.0], [0.0]], [[0.5, 0.0, 0.0]])


def _member(tree, index: int):
    return jax.tree.map(lambda leaf: leaf[index], tree)


@pytest.fixture(scope="module")
def loops() -> dict[float, StateSpace]:
    """By sample time: three servos, the last one unstable when closed, and two simpler loops."""
    members = [_servo(0.7, 0.2), _servo(1.0, 0.5), _servo(30.0, 0.05)]
    members += [WITHOUT_PHASE_CROSSOVER, NOTHING_CROSSED]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *members)
    return {0.0: batch, DT: batch.discretise(DT)}


@pytest.fixture(scope="module")
def found(loops):
    """Margins by sample time, computed when asked for."""

    @functools.cache
    def at(dt: float) -> Margins:
        return margins(loops[dt])

    return at


@pytest.mark.parametrize("dt", [pytest.param(0.0, marks=pytest.mark.slow), DT])
@pytest.mark.parametrize("i", range(3))
def test_margins_are_those_of_python_control(loops, found, dt, i):
    loop, ours = _member(loops[dt], i), _member(found(dt), i)
    gain, phase, modulus, w_phase, w_gain, _ = control.stability_margins(_peer(loop), method="poly")
    np.testing.assert_allclose(ours.gain_margin, gain, rtol=1e-6)
    np.testing.assert_allclose(ours.phase_margin, phase, rtol=1e-6)
    # Its least distance from −1 is that of the stationary point it finds, sometimes not the least.
    omega = np.geomspace(1e-3, np.pi / DT if dt else 1e3, 40_001)
    response = _peer(loop)(np.exp(1j * omega * dt) if dt else 1j * omega)
    np.testing.assert_allclose(ours.modulus_margin, np.min(np.abs(1 + response)), rtol=1e-6)
    assert ours.modulus_margin <= modulus * (1 + 1e-9)
    np.testing.assert_allclose(ours.phase_crossover, w_phase, rtol=1e-6)
    np.testing.assert_allclose(ours.gain_crossover, w_gain, rtol=1e-6)
    poles = control.feedback(_peer(loop), 1).poles()
    assert ours.stable == np.all(np.abs(poles) < 1 if dt else poles.real < 0)
    assert bool(ours.stable) == (i < 2)
    # One crossover: the delay margin is the phase margin over its frequency.
    turn = np.deg2rad(phase) % (2 * np.pi)
    np.testing.assert_allclose(ours.delay_margin, turn / w_gain, rtol=1e-6)


@pytest.mark.slow
def test_closed_forms(found):
    # |L| = 1 of 1 / (s (s + 1)) at ω² = (√5 − 1)/2; its phase never reaches −180°.
    servo, lag = _member(found(0.0), 3), _member(found(0.0), 4)
    omega = np.sqrt((np.sqrt(5.0) - 1.0) / 2.0)
    np.testing.assert_allclose(servo.gain_crossover, omega, rtol=1e-12)
    np.testing.assert_allclose(servo.phase_margin, 90.0 - np.rad2deg(np.arctan(omega)), rtol=1e-12)
    assert np.isinf(servo.gain_margin) and np.isnan(servo.phase_crossover) and servo.stable
    assert np.isinf(lag.gain_margin) and np.isinf(lag.phase_margin) and np.isinf(lag.delay_margin)
    np.testing.assert_allclose(lag.modulus_margin, 1.0)


@pytest.mark.slow
def test_the_edge_of_stability_is_where_they_say(loops, found):
    """A loop with its gain margin has a pole on the edge; with its delay margin it passes −1."""
    loop, ours = _member(loops[0.0], 0), _member(found(0.0), 0)
    edge = StateSpace(loop.A, ours.gain_margin * loop.B, loop.C)
    poles = control.feedback(_peer(edge), 1).poles()
    assert abs(np.max(poles.real)) < 1e-9
    delayed = np.exp(-1j * float(ours.delay_crossover * ours.delay_margin))
    value = complex(_peer(loop)(1j * float(ours.delay_crossover))) * delayed
    np.testing.assert_allclose(value, -1.0, atol=1e-9)


@pytest.mark.slow
def test_many_crossovers_of_a_flexible_arm():
    """The loop at the arm's input crosses |L| = 1 seven times, on both sides of every resonance."""
    arm = reference_single_link_arm(payload_mass=0.2).linearised().discretise(1 / 300)
    loop = loop_transfer(arm, PDP(0.5, 3.3, 0.07), at="input")
    found = margins(loop)
    omega = np.linspace(1e-3, np.pi * 300, 100_001)
    response = np.asarray(loop.frequency_response(omega))[:, 0, 0]
    cells = np.nonzero(np.diff(np.sign(np.log(np.abs(response)))))[0]
    assert cells.size == 7
    angles = np.rad2deg(np.angle(-response[cells]))
    best = np.argmin(np.abs(angles))
    np.testing.assert_allclose(found.gain_crossover, omega[cells[best]], atol=omega[1] - omega[0])
    np.testing.assert_allclose(found.phase_margin, angles[best], atol=0.5)
    np.testing.assert_allclose(found.modulus_margin, np.min(np.abs(1 + response)), rtol=1e-4)
    real = (np.diff(np.sign(response.imag)) != 0) & (response.real[1:] < 0)
    gains = 1.0 / np.append(np.abs(response[1:][real]), np.abs(response[-1]))
    np.testing.assert_allclose(
        found.gain_margin, gains[np.argmin(np.abs(np.log(gains)))], rtol=1e-3
    )


@pytest.mark.slow
def test_modulus_margin_and_norms(loops, found):
    """1 / ‖S‖∞, and python-control's norms of S and of the closed loop."""
    loop = _member(loops[0.0], 0)
    one = StateSpace(loop.A - loop.B @ loop.C, loop.B, -loop.C, [[1.0]])
    peak = hinf_norm(one).value
    np.testing.assert_allclose(1.0 / found(0.0).modulus_margin[0], peak, rtol=1e-8)
    np.testing.assert_allclose(peak, control.linfnorm(_peer(one))[0], rtol=1e-6)
    closed = StateSpace(one.A, loop.B, loop.C)
    np.testing.assert_allclose(h2_norm(closed), control.norm(_peer(closed), 2), rtol=1e-8)


@pytest.mark.slow
def test_gradients_by_finite_differences(loops):
    batch = loops[DT]

    @jax.jit
    def value_and_slope(scale):
        def numbers(scale):
            A = batch.A + 0.01 * (scale - 1.0) * jnp.eye(3)[None]
            found = _member(margins(StateSpace(A, scale * batch.B, batch.C, dt=DT)), 1)
            return jnp.stack(
                [found.gain_margin, found.phase_margin, found.delay_margin, found.modulus_margin]
                + [found.phase_crossover, found.gain_crossover]
            )

        return numbers(scale), jax.jacrev(numbers)(scale)

    step = 1e-5
    expected = (value_and_slope(1.0 + step)[0] - value_and_slope(1.0 - step)[0]) / (2 * step)
    np.testing.assert_allclose(value_and_slope(1.0)[1], expected, rtol=1e-5)


def test_wrong_use(loops):
    with pytest.raises(ValueError, match="one loop"):
        margins(StateSpace(-np.eye(2), np.eye(2), np.eye(2)))
    with pytest.raises(ValueError, match="not finite"):
        margins(eqx.tree_at(lambda m: m.A, loops[0.0], loops[0.0].A * jnp.nan))
