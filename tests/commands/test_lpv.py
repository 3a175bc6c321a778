"""`lpvid lpv` on a two-mode system whose modes move with K."""

import json

import numpy as np
import pytest

from lpvid.commands import main
from lpvid.io import load
from lpvid.models import LPVStateSpace

from .record_files import frequencies

COLUMNS = ["--input", "u", "--output", "y", "--time", "t", "--order", "4", "--starts", "2"]


def at(tables):
    return [word for k in ("1.0", "0.0", "0.5") for word in ("--at", k, tables[k])]


def test_the_model_between_the_points_is_found(capsys, tmp_path, tables):
    model, figures = tmp_path / "model.json", tmp_path / "figures.json"
    argv = ["lpv", *at(tables), *COLUMNS, "--degree", "1"]
    argv += ["--test", "0.25", tables["0.25"], "--test", "k", tables["sweep"]]
    assert main([*argv, "--out", str(model), "--json", str(figures)]) == 0
    content = json.loads(figures.read_text())
    captured = capsys.readouterr()
    assert [point["kappa"] for point in content["points"]] == [[0.0], [0.5], [1.0]]
    assert content["degree"] == 1
    assert set(content["leave_one_out"]) == {"0", "1"}
    assert min(point["fit"][0] for point in content["points"]) > 99.0
    frozen, sweep = content["test"]
    assert frozen["kappa"] == [0.25] and sweep["kappa"] == "k"
    assert set(frozen["local"]) == {"0", "0.5", "1"}
    saved = load(model)
    assert isinstance(saved, LPVStateSpace)
    assert content["warnings"] == []
    assert "Polynomial of degree 1" in captured.out
    best_single = max(fit[0] for fit in frozen["local"].values())
    assert frozen["lpv"][0] > best_single + 20.0
    # The logarithms of the frequencies are affine in K: degree 1 is exact.
    assert frozen["lpv"][0] > 98.0
    assert sweep["lpv"][0] > 95.0
    assert max(point["relative_error"] for point in content["points"]) < 1e-6
    found = np.asarray(saved.at(0.25).modes().frequency)[::2] / (2.0 * np.pi)
    np.testing.assert_allclose(found, frequencies(0.25), rtol=1e-3)


def test_black_boxes_are_interpolated_entry_by_entry(capsys, tmp_path, tables):
    figures = tmp_path / "figures.json"
    argv = ["lpv", *at(tables), *COLUMNS, "--degree", "2", "--structure", "black-box"]
    assert main([*argv, "--test", "0.5", tables["0.5"], "--json", str(figures)]) == 0
    content = json.loads(figures.read_text())
    # Three points fix a parabola: at the points the local models come back.
    assert content["test"][0]["lpv"][0] == pytest.approx(content["points"][1]["fit"][0], abs=0.01)
    assert "relative_error" not in content["points"][0]
    assert content["parameter_names"][0] == "A[0,0]"
    assert "Aligning" in capsys.readouterr().err


def test_extrapolation_is_warned_of(capsys, tables):
    argv = ["lpv", *at(tables), *COLUMNS, "--test", "-0.5", tables["0.25"]]
    assert main(argv) == 0
    error = capsys.readouterr().err
    assert error.count("it extrapolates there") == 1
    assert "lpvid lpv: warning:" in error
