"""Residual tests, errors over the horizon and stabilisation diagrams show their results."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpvid.analysis import HorizonErrors, residual_tests
from lpvid.identify import Stabilisation
from lpvid.plot import horizon_errors, stabilisation
from lpvid.plot import residual_tests as draw_tests


def test_residual_tests_colour_what_leaves_the_band():
    rng = np.random.default_rng(0)
    u, e = rng.standard_normal((2, 400, 2))
    e[:, 0] += np.roll(u[:, 1], 2)
    tests = residual_tests(e, u, lags=10, output_names=["tip", "hub"], input_names=["F", "M"])
    panels = draw_tests(tests)
    assert panels.shape == (2, 3)
    panel = panels[0, 2]
    outside = [line for line in panel.lines if line.get_label() == "_outside"]
    assert 2.0 in outside[0].get_xdata()
    inside = [line for line in panel.lines if line.get_label() == "_inside"]
    drawn = np.concatenate([inside[0].get_ydata(), outside[0].get_ydata()])
    np.testing.assert_allclose(np.sort(drawn), np.sort(tests.cross_correlation[:, 0, 1]))
    assert panel.get_title(loc="left") == "with M"
    assert panel.get_title(loc="right").startswith("p < 0.0001")
    assert panels[1, 0].get_ylabel() == "residual of hub"
    assert panels[1, 0].get_xlabel() == "lag (samples); grey: 95 %"
    assert draw_tests(residual_tests(e)).shape == (2, 1)


def test_errors_over_the_horizon_run_into_simulation():
    horizons = jnp.array([1.0, 5.0, np.inf])
    errors = HorizonErrors(horizons, jnp.array([[1.0], [2.0], [3.0]]), jnp.zeros((3, 1)))
    (panel,) = horizon_errors({"one": errors, "two": errors}, dt=0.1, output_units=["mm"])
    np.testing.assert_allclose(panel.lines[0].get_xdata(), [0.1, 0.5])
    np.testing.assert_allclose(panel.lines[0].get_ydata(), [1.0, 2.0])
    assert panel.lines[1].get_ydata()[0] == 3.0
    assert panel.get_xlabel() == "horizon (s)"
    assert panel.get_ylabel() == "y1: RMS error (mm)"
    wide = HorizonErrors(horizons, jnp.zeros((3, 2)), jnp.zeros((3, 2)))
    with pytest.raises(ValueError, match="do not share"):
        horizon_errors([errors, wide])


def test_stabilisation_marks_each_kind():
    frequency = 2 * np.pi * np.array([[1.0, 3.0, np.nan], [1.0, 3.0, 4.0]])
    flags = np.array([[False, False, False], [True, True, False]])
    arrays = dict(
        frequency=frequency,
        damping=np.array([[0.01, 0.01, np.nan], [0.01, -0.01, 0.01]]),
        shapes=np.ones((2, 3, 1), complex),
        frequency_stable=flags,
        damping_stable=flags,
        shape_stable=flags,
        singular_values=np.array([3.0, 2.0, 1e-2, 1e-3]),
        spectrum_omega=2 * np.pi * np.linspace(0.5, 5.0, 10),
        spectrum=np.ones(10),
    )
    diagram = Stabilisation(orders=(2, 4), **jax.tree.map(jnp.asarray, arrays))
    main, below = stabilisation(diagram)
    shown = {line.get_label(): line for line in main.lines}
    np.testing.assert_allclose(shown["+ shape"].get_xdata(), [1.0])
    np.testing.assert_allclose(shown["+ shape"].get_ydata(), [4.0])
    # One order before none, one that grows, one that is new.
    assert shown["new"].get_xdata().size == 4
    assert shown["frequency stable"].get_xdata().size == 0
    assert main.get_xlim() == (0.0, 5.0)
    assert below.get_yscale() == "log"
    assert stabilisation(diagram, frequencies=(2.0, 5.0))[0].lines[0].get_xdata().min() == 3.0
