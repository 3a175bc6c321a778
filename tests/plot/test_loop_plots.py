"""Pictures of a closed loop: what is drawn is what was found, whatever is missing."""

import numpy as np
import pytest
from loop.loop_records import DT, abstained, named, nothing_to_add

from lpvid import plot
from lpvid.loop import VirtualForce

DRAWN = (
    plot.loop_responses,
    plot.loop_residuals,
    plot.loop_spectra,
    plot.virtual_forces,
    plot.error_ladder,
    plot.candidate_ranking,
)


def _labels(panel):
    return panel.get_legend_handles_labels()[1]


def _line(panel, label):
    (line,) = [line for line in panel.lines if line.get_label().startswith(label)]
    return line


def test_responses_show_both_models_and_their_errors():
    found = named()
    ((main, rest),) = plot.loop_responses(found)
    assert _labels(main) == ["measured", "before: BFT 59.81 %", "after: BFT 98.86 %"]
    for name, simulated in (("before", found.series.before), ("after", found.series.after)):
        np.testing.assert_array_equal(_line(main, name).get_ydata(), simulated[:, 0])
        error = (found.series.output - simulated)[:, 0]
        np.testing.assert_array_equal(_line(rest, name).get_ydata(), error)
    assert main.get_ylabel() == "angle (rad)"
    # The record's own clock.
    assert _line(main, "measured").get_xdata()[0] == 5.0


def test_responses_of_a_span_and_of_none():
    ((main, _),) = plot.loop_responses(named(), span=(6.0, 7.0))
    time = _line(main, "measured").get_xdata()
    assert time[0] == pytest.approx(6.0, abs=DT) and time[-1] == pytest.approx(7.0, abs=DT)
    with pytest.raises(ValueError, match="span: no held-out sample"):
        plot.loop_responses(named(), span=(0.0, 1.0))


def test_a_simulation_that_runs_away_leaves_the_measured_one_readable():
    found = named()
    found = found._replace(series=found.series._replace(before=1e6 * found.series.before))
    for panel in plot.loop_responses(found)[0]:
        assert np.ptp(panel.get_ylim()) < 5.0 * np.ptp(found.series.output)


def test_records_follow_one_another_with_a_break():
    found = named(100)
    time = found.series.time.copy()
    time[60:] -= time[60] - time[0]
    panel = plot.loop_residuals(found._replace(series=found.series._replace(time=time)))[0]
    drawn, values = panel.lines[0].get_data()
    assert np.all(np.diff(drawn) >= 0.0)
    assert np.flatnonzero(np.isnan(values)).tolist() == [60]
    assert drawn[-1] == pytest.approx(found.series.time[-1])


def test_residuals_give_their_size():
    panel = plot.loop_residuals(named())[0]
    assert _labels(panel) == ["before: RMS 0.00341 rad", "after: RMS 0.00204 rad"]


def test_white_residuals_lie_at_the_noise_floors_density():
    found = named(4000)
    panel = plot.loop_spectra(found)[0]
    floor = _line(panel, "noise floor").get_ydata()[0]
    after = np.nanmedian(_line(panel, "after").get_ydata())
    assert after == pytest.approx(floor, rel=0.2)
    assert floor == pytest.approx(2.0 * DT * found.noise_floor[0] ** 2)


def test_the_law_is_drawn_through_the_means_of_what_is_lacking():
    found = named(4000)
    panels = plot.virtual_forces(found)
    assert [panel.get_xlabel() for panel in panels] == [
        force.regressor_name for force in found.virtual_forces
    ]
    where, law = _line(panels[1], "law").get_data()
    assert np.all(np.diff(where) >= 0.0)
    places, means = _line(panels[1], "mean").get_data()
    np.testing.assert_allclose(means, np.interp(places, where, law), atol=0.05)


def test_a_law_with_memory_is_drawn_in_the_order_of_time():
    time = np.linspace(0.0, 20.0, 2000)
    regressor, law = np.sin(time * np.pi), np.cos(time * np.pi)
    force = VirtualForce("dahl at joint", "position [rad]", regressor, law, law, "N m")
    panel = plot.virtual_forces(named()._replace(virtual_forces=(force,)))[0]
    np.testing.assert_array_equal(_line(panel, "law").get_xdata(), regressor)


def test_the_ladder_ends_in_the_free_run_and_stands_on_the_floor():
    found = named()
    panel = plot.error_ladder(found)[0]
    assert _labels(panel) == ["before", "after", "noise floor", "free run"]
    np.testing.assert_allclose(_line(panel, "before").get_xdata(), DT * found.ladder.steps)
    dotted = [line.get_ydata() for line in panel.lines if line.get_linestyle() == ":"]
    levels = [values[0] for values in dotted if len(values)]
    assert found.before.free_run[0] in levels and found.after.free_run[0] in levels
    assert panel.get_yscale() == "log"
    # Errors that hardly differ are shown from zero.
    assert plot.error_ladder(nothing_to_add())[0].get_ylim()[0] == 0.0


def test_the_ranking_marks_what_was_found_and_what_looks_like_it():
    found = named()
    panels = plot.candidate_ranking(found, most=3)
    assert [len(panel.patches) for panel in panels] == [3, 2]
    coulomb, dahl, stribeck = panels[0].patches
    assert [bar.get_width() for bar in (coulomb, dahl, stribeck)] == [905.0, 893.0, 600.0]
    assert coulomb.get_hatch() is None and dahl.get_hatch() and stribeck.get_hatch()
    delay = plot.candidate_ranking(found)[0].patches[3]
    assert delay.get_hatch() is None and delay.get_facecolor() != coulomb.get_facecolor()
    assert [text.get_text() for text in panels[0].texts] == ["p < 0.0001"] * 3


@pytest.mark.parametrize("make", [named, nothing_to_add, abstained])
def test_every_verdict_is_drawn_and_on_one_page(make, tmp_path):
    found = make(150)
    counts = [draw(found).size for draw in DRAWN]
    ny = len(found.output_names)
    rounds, forces = len(found.rounds), len(found.virtual_forces)
    assert counts == [2 * ny, ny, ny, forces, ny, rounds]
    page = plot.loop(found)
    titles = [axes.get_title(loc="left") for axes in page.axes]
    assert len([title for title in titles if title.startswith("round")]) == rounds
    assert plot.save_figure(page, tmp_path / "page.png", dpi=40.0).stat().st_size > 1000
