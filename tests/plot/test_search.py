from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from lpvid.plot import fit_over_points, minima, scree


def _texts(panel):
    return [text.get_text() for text in panel.get_legend().get_texts()]


def test_scree_marks_the_order(oscillator):
    values = jnp.array([9.0, 4.0, 0.1, 0.05, 0.0])
    panel = scree(SimpleNamespace(singular_values=values, model=oscillator))
    _, kept, left, gap = panel.lines
    np.testing.assert_array_equal(kept.get_xdata(), [1, 2])
    np.testing.assert_array_equal(kept.get_ydata(), [9.0, 4.0])
    np.testing.assert_array_equal(left.get_xdata(), [3, 4, 5])
    np.testing.assert_array_equal(left.get_ydata(), [0.1, 0.05, np.nan])
    assert list(gap.get_xdata()) == [2.5, 2.5]
    assert panel.get_yscale() == "log"
    assert _texts(panel) == ["kept: order 2", "left out"]


def test_scree_of_plain_values():
    assert _texts(scree(np.array([3.0, 1.0]))) == ["singular values"]
    assert _texts(scree(np.array([3.0, 1.0]), order=1)) == ["kept: order 1", "left out"]
    with pytest.raises(ValueError, match="one row"):
        scree(np.ones((2, 2)))


def test_minima_are_sorted_and_hits_filled():
    first = SimpleNamespace(match_costs=jnp.array([1e-3, 1.0, 1e-3, jnp.inf]), hits=jnp.asarray(2))
    panel = minima({"point 1": first})
    line, hits = panel.lines
    np.testing.assert_array_equal(line.get_ydata(), [1e-3, 1e-3, 1.0, np.nan])
    np.testing.assert_array_equal(hits.get_xdata(), [1, 2])
    assert _texts(panel) == ["point 1: 2 of 4 in the best minimum"]
    assert len(minima([first, first]).lines) == 4


def test_bars_for_points_and_outputs():
    table = {
        "black box": np.array([[99.0, 98.0], [97.0, 96.0], [95.0, 94.0]]),
        "LPV": jnp.array([[90.0, 91.0], [92.0, 93.0], [94.0, 95.0]]),
    }
    panels = fit_over_points(table, points=[0.1, (0.2, 3.0), "third"], output_names=["a", "b"])
    assert panels.shape == (2,)
    black, lpv = panels[1].containers
    np.testing.assert_allclose([bar.get_height() for bar in black], [98.0, 96.0, 94.0])
    np.testing.assert_allclose([bar.get_height() for bar in lpv], [91.0, 93.0, 95.0])
    # Bars of a group stand side by side, around their tick.
    assert black[1].get_x() + black[1].get_width() <= lpv[1].get_x()
    middle = (black[1].get_x() + lpv[1].get_x() + lpv[1].get_width()) / 2
    assert middle == pytest.approx(1.0)
    assert [t.get_text() for t in panels[1].get_xticklabels()] == ["0.1", "0.2, 3", "third"]
    assert panels[1].get_ylabel() == "b: BFT (%)"
    assert _texts(panels[0]) == ["black box", "LPV"]
    assert [text.get_text() for text in panels[1].texts] == [
        *("98.0", "96.0", "94.0", "91.0", "93.0", "95.0")
    ]


def test_one_output_and_faults():
    (panel,) = fit_over_points({"only": [50.0, 60.0]})
    assert [t.get_text() for t in panel.get_xticklabels()] == ["1", "2"]
    with pytest.raises(ValueError, match="one value"):
        fit_over_points({"a": [1.0, 2.0], "b": [1.0]})
    with pytest.raises(ValueError, match="points: 1 given for 2"):
        fit_over_points({"a": [1.0, 2.0]}, points=[0.0])
