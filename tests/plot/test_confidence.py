"""Bands and regions have the sizes that the delta method and the levels give."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from uncertain_models import TwoModes

from lpvid.analysis import frequency_response_covariance, pole_covariance
from lpvid.plot import bode, parameter_intervals, poles, profile_likelihood

OMEGA = 2.0 * np.pi * np.array([0.3, 1.9, 4.0, 20.0])


@pytest.fixture(scope="module")
def refined():
    return TwoModes()


@pytest.fixture(scope="module")
def known(refined):
    # As many frequencies as the plot asks for, so that one compilation serves both.
    padded = np.pad(OMEGA, (0, 256 - OMEGA.size), mode="edge")
    return frequency_response_covariance(
        refined.model_at, refined.parameters, refined.covariance, padded
    )


def edges(panel):
    """Lower and upper edge of a panel's band."""
    (band,) = panel.collections
    outline = band.get_paths()[0].vertices
    x = np.unique(outline[:, 0])
    return tuple(
        np.array([pick(outline[outline[:, 0] == at, 1]) for at in x]) for pick in (np.min, np.max)
    )


def test_bode_draws_bands_of_magnitude_and_phase(refined, known):
    panels = bode({"refined": refined, "start": refined.model}, OMEGA, phase=True)
    size = np.abs(np.asarray(known.response))[:4, 0, 0]
    spread = 1.959964 * np.asarray(known.magnitude_std)[:4, 0, 0]
    low, high = edges(panels[0, 0])
    np.testing.assert_allclose(low, 20 * np.log10(size - spread), rtol=1e-6)
    np.testing.assert_allclose(high, 20 * np.log10(size + spread), rtol=1e-6)
    low, high = edges(panels[1, 0])
    turn = np.rad2deg(1.959964 * np.asarray(known.phase_std)[:4, 0, 0])
    np.testing.assert_allclose(0.5 * (high - low), turn, rtol=1e-6)
    np.testing.assert_allclose(
        0.5 * (high + low), panels[1, 0].lines[0].get_ydata(), rtol=1e-9, atol=1e-9
    )
    texts = [text.get_text() for text in panels[0, 0].get_legend().get_texts()]
    assert texts == ["refined", "95 % band", "start"]


def test_bands_can_be_left_out_and_a_level_is_checked(refined):
    assert not bode(refined, OMEGA, level=None)[0, 0].collections
    with pytest.raises(ValueError, match="level"):
        bode(refined, OMEGA, level=95.0)


def test_a_band_that_reaches_zero_does_not_stretch_the_axis():
    vague = TwoModes(spread=(0.3, 0.3, 0.02, 0.02, 3.0))
    plain = bode(vague, OMEGA, level=None)[0, 0].get_ylim()
    banded = bode(vague, OMEGA)[0, 0].get_ylim()
    assert banded[0] > plain[0] - 10.0


@pytest.mark.parametrize("dt", [0.0, 0.002])
def test_pole_regions_hold_their_share(dt):
    model = TwoModes(dt)
    panel = poles(model, level=0.9)
    scale = 1.0 if dt else 2.0 * np.pi
    found = pole_covariance(model.model_at, model.parameters, model.covariance)
    regions = [line for line in panel.lines if line.get_label() in ("90 % region", "_region")]
    assert len(regions) == 5
    for line, pole, covariance in zip(regions, found.poles, found.covariance, strict=True):
        x, y = np.asarray(line.get_xdata()), np.asarray(line.get_ydata())
        pole, covariance = complex(pole) / scale, np.asarray(covariance) / scale**2
        if abs(pole.imag) < 1e-9:
            half = 1.644854 * np.sqrt(covariance[0, 0])
            np.testing.assert_allclose(x, [pole.real - half, pole.real + half], rtol=1e-6)
            continue
        offset = np.stack([x - pole.real, y - pole.imag])
        distance = np.sum(offset * np.linalg.solve(covariance, offset), axis=0)
        # Quantile of χ² with two degrees of freedom.
        np.testing.assert_allclose(distance, -2.0 * np.log(0.1), rtol=1e-6)


def test_parameter_intervals_are_relative_to_the_reference(refined):
    truth = np.asarray(refined.parameters) * 1.02
    panel = parameter_intervals({"fit": refined}, reference=truth)
    bars: Any = panel.containers[0]
    ends = np.array([segment[:, 0] for segment in bars.lines[2][0].get_segments()])
    wanted = np.asarray(refined.parameters), 1.959964 * np.array([0.01, 0.02, 0.002, 0.002, 0.2])
    expected = 100 * (
        np.stack([wanted[0] - wanted[1], wanted[0] + wanted[1]], 1) / truth[:, None] - 1
    )
    np.testing.assert_allclose(ends, expected, rtol=1e-6)
    assert [tick.get_text() for tick in panel.get_yticklabels()] == list(refined.parameter_names)
    wide = parameter_intervals(refined, robust=True, which=[1])
    bars: Any = wide.containers[0]
    (segment,) = bars.lines[2][0].get_segments()
    np.testing.assert_allclose(np.ptp(segment[:, 0]), 2 * 2 * 1.959964 * 0.02 / 5 * 100, rtol=1e-6)


def test_parameters_nobody_knows_and_zero_references():
    class Blind:
        parameters = np.array([1.0, 2.0])
        parameter_names = ("seen", "unseen")

        def confidence_intervals(self, level, *, robust):
            del level, robust
            return np.array([[0.9, 1.1], [-np.inf, np.inf]])

    panel = parameter_intervals(Blind(), reference=[0.0, 2.0])
    assert panel.get_xlabel() == "parameter"
    assert [line.get_linestyle() for line in panel.lines].count(":") == 1
    with pytest.raises(ValueError, match="reference"):
        parameter_intervals(Blind(), reference=[1.0])
    with pytest.raises(ValueError, match="do not share"):
        parameter_intervals([Blind(), ([1.0], [[0.1]])])


def test_the_profile_is_drawn_as_a_likelihood_ratio():
    mass = np.linspace(1.0, 3.0, 21)
    profile = SimpleNamespace(
        name="mass",
        estimate=2.0,
        values=mass,
        increase=20.0 * np.log(mass / 2.0) ** 2,
        standard_error=0.3,
        interval=lambda level: (1.5, np.inf),
    )
    panel: Any = profile_likelihood(profile)
    np.testing.assert_allclose(panel.lines[0].get_ydata(), 40.0 * np.log(mass / 2.0) ** 2)
    assert panel.lines[2].get_ydata()[0] == pytest.approx(3.841459, rel=1e-6)
    verticals = [line.get_xdata()[0] for line in panel.lines[3:]]
    assert verticals == [1.5, 2.0]
    assert panel.get_xlabel() == "mass"
