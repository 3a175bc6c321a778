import os
import subprocess
import sys

import matplotlib
import matplotlib.pyplot as plt
import pytest

import lpvid.plot


def test_matplotlib_is_imported_with_the_first_plot_only():
    code = "import lpvid.plot, lpvid.report, sys; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_settings_are_left_as_they_were(oscillator):
    before = dict(matplotlib.rcParams)
    lpvid.plot.bode(oscillator)
    assert dict(matplotlib.rcParams) == before


def test_settings_are_restored_after_an_error():
    before = dict(matplotlib.rcParams)
    with pytest.raises(ValueError, match="systems"):
        lpvid.plot.bode({})
    assert dict(matplotlib.rcParams) == before


def test_nothing_is_shown(oscillator, monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("shown")

    monkeypatch.setattr(plt, "show", refuse)
    lpvid.plot.poles(oscillator)


def test_given_axes_are_drawn_on(oscillator):
    _, axes = plt.subplots()
    assert lpvid.plot.singular_values(oscillator, axes=axes) is axes
    assert len(axes.lines) == 1
    assert len(plt.get_fignums()) == 1


def test_wrong_number_of_axes(oscillator):
    _, axes = plt.subplots(1, 2)
    with pytest.raises(ValueError, match="axes: 1 x 1 are needed"):
        lpvid.plot.bode(oscillator, axes=axes)


def test_save_figure_writes_at_150_dpi_and_closes(oscillator, tmp_path):
    panel = lpvid.plot.poles(oscillator)
    width, height = panel.figure.get_size_inches()
    path = lpvid.plot.save_figure(panel, tmp_path / "poles.png")
    assert plt.get_fignums() == []
    assert os.listdir(tmp_path) == ["poles.png"]
    image = plt.imread(path)
    assert image.shape[:2] == (round(height * 150), round(width * 150))


def test_save_figure_takes_arrays_and_figures_and_vectors(oscillator, tmp_path):
    path = lpvid.plot.save_figure(lpvid.plot.bode(oscillator), tmp_path / "bode.svg")
    assert b"<svg" in path.read_bytes()
    figure = lpvid.plot.poles(oscillator).figure
    assert lpvid.plot.save_figure(figure, tmp_path / "poles").read_bytes()[1:4] == b"PNG"


def test_save_figure_names_unknown_forms(oscillator, tmp_path):
    with pytest.raises(ValueError, match="no 'xyz' files"):
        lpvid.plot.save_figure(lpvid.plot.poles(oscillator), tmp_path / "poles.xyz")
    with pytest.raises(ValueError, match="axes"):
        lpvid.plot.save_figure("poles", tmp_path / "poles.png")


def test_interrupted_save_leaves_the_old_file(oscillator, tmp_path, monkeypatch):
    path = tmp_path / "poles.png"
    path.write_bytes(b"old")

    def fail(*args):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        lpvid.plot.save_figure(lpvid.plot.poles(oscillator), path)
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["poles.png"]


@pytest.mark.parametrize(
    ("labels", "message"),
    [(["a"], "labels: 1 given for 2"), (["a", "a"], "holds a label twice")],
)
def test_labels_must_fit(oscillator, labels, message):
    with pytest.raises(ValueError, match=message):
        lpvid.plot.poles([oscillator, oscillator], labels)


def test_labels_beside_a_mapping(oscillator):
    with pytest.raises(ValueError, match="has its own"):
        lpvid.plot.poles({"a": oscillator}, ["b"])


def test_settings_made_while_drawing_stay_and_the_style_does_not():
    import matplotlib

    from lpvid.plot._figure import styled

    before = matplotlib.rcParams["interactive"], matplotlib.rcParams["font.size"]

    @styled
    def draw():
        # As a notebook's backend does with its first figure.
        matplotlib.rcParams["interactive"] = not before[0]
        return matplotlib.rcParams["font.size"]

    try:
        assert draw() == 9.0
        assert matplotlib.rcParams["interactive"] is not before[0]
        assert matplotlib.rcParams["font.size"] == before[1]
    finally:
        matplotlib.rcParams["interactive"] = before[0]
