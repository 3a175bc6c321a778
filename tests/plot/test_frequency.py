import control
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

from lpvid.models import StateSpace
from lpvid.plot import bode, singular_values

OMEGA = np.geomspace(1.0, 300.0, 25)


@pytest.fixture(scope="module")
def plant() -> StateSpace:
    """Three outputs, two inputs; the first output does not feel the second input."""
    A = np.diag([-1.0, -20.0])
    B = np.eye(2)
    C = np.array([[1.0, 0.0], [0.5, 2.0], [0.0, -3.0]])
    return StateSpace(A, B, C)


def _peer(system: StateSpace, omega) -> np.ndarray:
    """Response by python-control, shape (ny, nu, frequency)."""
    peer = control.ss(*map(np.asarray, (system.A, system.B, system.C, system.D)), system.dt)
    return peer(np.exp(1j * omega * system.dt) if system.dt else 1j * omega, squeeze=False)


def test_bode_draws_decibels_over_hertz(plant):
    panels = bode(plant, OMEGA)
    assert panels.shape == (3, 2)
    expected = _peer(plant, OMEGA)
    for (k, j), panel in np.ndenumerate(panels):
        (line,) = panel.lines
        np.testing.assert_allclose(line.get_xdata(), OMEGA / (2 * np.pi))
        if np.any(expected[k, j]):
            wanted = 20 * np.log10(np.abs(expected[k, j]))
            np.testing.assert_allclose(line.get_ydata(), wanted, atol=1e-9)
        else:
            assert np.all(np.isnan(line.get_ydata()))
        assert panel.get_title(loc="left") == f"y{k + 1} from u{j + 1}"
        assert panel.get_xscale() == "log"
    assert panels[2, 0].get_xlabel() == "frequency (Hz)"
    assert panels[0, 0].get_ylabel() == "magnitude (dB)"


def test_bode_magnitude_and_names(plant):
    panels = bode(
        plant, OMEGA, decibels=False, input_names=["torque", "force"], output_names=["a", "b", "c"]
    )
    assert panels[1, 1].get_title(loc="left") == "b from force"
    assert panels[0, 0].get_yscale() == "log"
    np.testing.assert_allclose(
        panels[2, 1].lines[0].get_ydata(), np.abs(_peer(plant, OMEGA)[2, 1]), rtol=1e-9
    )


def test_bode_phase_is_unwrapped(oscillator):
    panels = bode(oscillator, OMEGA, phase=True)
    assert panels.shape == (2, 1)
    expected = np.rad2deg(np.unwrap(np.angle(_peer(oscillator, OMEGA)[0, 0])))
    np.testing.assert_allclose(panels[1, 0].lines[0].get_ydata(), expected, atol=1e-8)
    assert panels[1, 0].get_ylabel() == "phase (deg)"


def test_bode_finds_its_range_and_resolves_the_peak():
    # Damping 1e-4: a plain logarithmic grid would miss the peak by several decibels.
    frequency, damping = 2 * np.pi * 5.0, 1e-4
    A = [[0.0, frequency], [-frequency, -2 * damping * frequency]]
    sharp = StateSpace(A, [[0.0], [1.0]], [[frequency, 0.0]])
    line = bode(sharp)[0, 0].lines[0]
    hertz = line.get_xdata()
    assert hertz[0] == pytest.approx(0.5)
    assert hertz[-1] == pytest.approx(50.0)
    assert np.all(np.diff(hertz) > 0)
    peak = 20 * np.log10(1 / (2 * damping * np.sqrt(1 - damping**2)))
    assert np.max(line.get_ydata()) == pytest.approx(peak, abs=1e-3)


def test_discrete_models_end_at_their_nyquist_frequency(oscillator):
    discrete = oscillator.discretise(0.02)
    panels = bode({"continuous": oscillator, "discrete": discrete})
    continuous_line, discrete_line = panels[0, 0].lines
    assert discrete_line.get_xdata()[-1] == pytest.approx(25.0)
    assert continuous_line.get_xdata()[-1] == pytest.approx(50.0)
    hertz = discrete_line.get_xdata()
    expected = 20 * np.log10(np.abs(_peer(discrete, 2 * np.pi * hertz)[0, 0]))
    np.testing.assert_allclose(discrete_line.get_ydata(), expected, atol=1e-7)
    texts = [text.get_text() for text in panels[0, 0].get_legend().get_texts()]
    assert texts == ["continuous", "discrete"]


def test_integrators_and_static_gains_have_a_range():
    integrator = StateSpace([[0.0, 0.0], [0.0, -2.0]], [[1.0], [1.0]], [[1.0, 1.0]])
    hertz = bode(integrator)[0, 0].lines[0].get_xdata()
    np.testing.assert_allclose([hertz[0], hertz[-1]], [0.2 / (2 * np.pi), 20 / (2 * np.pi)])
    deadbeat = StateSpace([[0.0]], [[1.0]], [[1.0]], dt=0.1)
    line = bode(deadbeat)[0, 0].lines[0]
    assert line.get_xdata()[-1] == pytest.approx(5.0)
    np.testing.assert_allclose(line.get_ydata(), 0.0, atol=1e-9)


def test_a_batch_is_one_colour_and_one_legend_entry(oscillator):
    scale = jnp.linspace(0.9, 1.1, 4)
    batch = jax.vmap(
        lambda s: StateSpace(oscillator.A * s, oscillator.B, oscillator.C, oscillator.D)
    )(scale)
    panel = bode([batch, oscillator], OMEGA, labels=["runs", "truth"])[0, 0]
    assert len(panel.lines) == 5
    assert len({line.get_color() for line in panel.lines[:4]}) == 1
    assert [text.get_text() for text in panel.get_legend().get_texts()] == ["runs", "truth"]
    third = StateSpace(oscillator.A * scale[2], oscillator.B, oscillator.C, oscillator.D)
    expected = 20 * np.log10(np.abs(_peer(third, OMEGA)[0, 0]))
    np.testing.assert_allclose(panel.lines[2].get_ydata(), expected, atol=1e-9)


def test_singular_values_are_those_of_the_response(plant, oscillator):
    panel = singular_values({"plant": plant, "oscillator": oscillator}, OMEGA)
    assert len(panel.lines) == 3
    response = np.moveaxis(_peer(plant, OMEGA), -1, 0)
    values = np.sqrt(np.linalg.eigvalsh(np.conj(response.transpose(0, 2, 1)) @ response))[:, ::-1]
    for order in range(2):
        np.testing.assert_allclose(
            panel.lines[order].get_ydata(), 20 * np.log10(values[:, order]), atol=1e-7
        )
    assert panel.get_ylabel() == "singular values (dB)"
    assert len(panel.get_legend().get_texts()) == 2


def test_a_result_with_a_model_is_taken_for_its_model(oscillator):
    class Result:
        model = oscillator

    line = bode(Result(), OMEGA)[0, 0].lines[0]
    np.testing.assert_array_equal(
        line.get_ydata(), bode(oscillator, OMEGA)[0, 0].lines[0].get_ydata()
    )


def test_faults_are_named(plant, oscillator, lpv):
    with pytest.raises(ValueError, match="outputs x inputs differ"):
        bode([plant, oscillator])
    with pytest.raises(ValueError, match=r"lpv\.at\(kappa\)"):
        bode(lpv)
    with pytest.raises(ValueError, match="omega"):
        bode(oscillator, [-1.0])
    with pytest.raises(ValueError, match="Nyquist"):
        bode(oscillator.discretise(0.1), [40.0])
    with pytest.raises(ValueError, match="input_names: 1 given for 2"):
        bode(plant, OMEGA, input_names=["u"])
    assert plt.get_fignums() == []
