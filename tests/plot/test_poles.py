import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpvid.models import StateSpace
from lpvid.plot import mode_frequencies, poles


def test_continuous_poles_in_hertz(oscillator):
    panel = poles(oscillator)
    line = panel.lines[0]
    damped = 5.0 * np.sqrt(1 - 0.1**2)
    np.testing.assert_allclose(line.get_xdata(), [-0.5, -0.5])
    np.testing.assert_allclose(np.sort(line.get_ydata()), [-damped, damped])
    assert panel.get_xlabel() == "real part / 2π (Hz)"
    left, right = panel.get_xlim()
    low, high = panel.get_ylim()
    assert left < -0.5 < 0.0 < right
    assert low < -damped < damped < high


def test_damping_lines_have_their_ratio(oscillator):
    rays = [line for line in poles(oscillator).lines if line.get_label().startswith("_damping")]
    assert len(rays) == 8
    for ray in rays:
        damping = float(ray.get_label().split()[-1])
        x, y = ray.get_xdata()[1], ray.get_ydata()[1]
        assert -x / np.hypot(x, y) == pytest.approx(damping)


def test_limits_hold_unstable_and_real_poles():
    panel = poles(StateSpace(np.diag([3.0, -1.0]), np.ones((2, 1)), np.ones((1, 2))))
    assert panel.get_xlim()[1] > 3.0 / (2 * np.pi)
    assert panel.get_ylim()[0] < 0.0 < panel.get_ylim()[1]


def test_discrete_poles_and_unit_circle(oscillator):
    discrete = oscillator.discretise(0.02)
    panel = poles(discrete)
    z = np.exp(np.linalg.eigvals(np.asarray(oscillator.A)) * 0.02)
    np.testing.assert_allclose(np.sort(panel.lines[0].get_ydata()), np.sort(z.imag))
    circle = panel.lines[1]
    np.testing.assert_allclose(np.hypot(circle.get_xdata(), circle.get_ydata()), 1.0)
    assert panel.get_aspect() == 1.0


def test_a_batch_is_a_cloud(oscillator):
    batch = jax.vmap(
        lambda s: StateSpace(oscillator.A * s, oscillator.B, oscillator.C, oscillator.D)
    )(jnp.linspace(0.9, 1.1, 5))
    panel = poles({"runs": batch, "truth": oscillator})
    assert panel.lines[0].get_xdata().size == 10
    assert [text.get_text() for text in panel.get_legend().get_texts()] == ["runs", "truth"]


def test_planes_are_not_mixed(oscillator):
    with pytest.raises(ValueError, match="do not share a plane"):
        poles([oscillator, oscillator.discretise(0.01)])


def test_mode_frequencies_of_all_kinds(lpv):
    kappas = np.array([0.0, 0.5, 2.0])
    local = [lpv.at(kappa) for kappa in kappas]
    panels = mode_frequencies(
        {"local": local, "LPV": lpv, "physics": lambda kappa: lpv.at(kappa)}, kappas, damping=True
    )
    assert panels.shape == (2,)
    for line, where in zip(
        panels[0].lines, (kappas, np.linspace(0, 2, 101), np.linspace(0, 2, 101)), strict=True
    ):
        np.testing.assert_allclose(line.get_xdata(), where)
        # Undamped frequency of the mode: exp(3 + κ) rad/s.
        np.testing.assert_allclose(line.get_ydata(), np.exp(3 + where) / (2 * np.pi), rtol=1e-9)
    for line in panels[1].lines:
        np.testing.assert_allclose(line.get_ydata(), 0.05, rtol=1e-9)
    assert panels[0].get_ylabel() == "mode frequency (Hz)"
    assert panels[1].get_xlabel() == "κ"


def test_mode_frequencies_leave_real_poles_out(oscillator):
    pair = StateSpace(
        np.block([[np.asarray(oscillator.A), np.zeros((2, 1))], [np.zeros((1, 2)), -np.eye(1)]]),
        np.ones((3, 1)),
        np.ones((1, 3)),
    )
    (real,) = [StateSpace(np.diag([-1.0, -2.0, -3.0]), np.ones((3, 1)), np.ones((1, 3)))]
    (panel,) = mode_frequencies([pair, real, pair.discretise(0.01)], [0.0, 1.0, 2.0], name="load")
    (line,) = panel.lines
    np.testing.assert_allclose(line.get_ydata(), [5.0, np.nan, 5.0])
    assert panel.get_xlabel() == "load"


def test_mode_frequencies_need_the_points(lpv):
    with pytest.raises(ValueError, match="kappas: needed"):
        mode_frequencies([lpv.at(0.0)])
    with pytest.raises(ValueError, match="2 points given for the 1 models"):
        mode_frequencies([lpv.at(0.0)], [0.0, 1.0])
