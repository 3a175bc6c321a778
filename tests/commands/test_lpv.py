"""`lpvid lpv` on a two-mode system whose modes move with K."""

import json

import numpy as np
import pytest

from lpvid.commands import _lpv, main
from lpvid.data import read
from lpvid.identify import simulation_fit
from lpvid.io import load
from lpvid.models import LPVStateSpace

from . import record_files
from .record_files import frequencies, write_table

# Each run compiles a search of its own; its parts have their own quick tests.
pytestmark = pytest.mark.slow

COLUMNS = ["--input", "u", "--output", "y", "--time", "t", "--order", "4", "--starts", "2"]


def at(tables):
    return [word for k in ("1.0", "0.0", "0.5") for word in ("--at", k, tables[k])]


@pytest.mark.slow
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
    assert content["stable_over_range"] is True
    for point in content["points"]:
        assert point["stable"] is True
        assert point["status"] == point["fit_status"] == "Successful."
    for part in (*content["points"], frozen):
        assert part["offsets"]["u"][0][0] == pytest.approx(0.3, abs=0.1)
        assert part["offsets"]["y"][0][0] == pytest.approx(-2.0, abs=0.1)
    for words in ("signals without them", "local BFT, fitted", "over its range: stable"):
        assert words in captured.out
    found = np.asarray(saved.at(0.25).modes().frequency)[::2] / (2.0 * np.pi)
    np.testing.assert_allclose(found, frequencies(0.25), rtol=1e-3)


def test_black_boxes_are_coherent_between_the_points_and_refined(capsys, tmp_path, tables):
    figures = tmp_path / "figures.json"
    argv = ["lpv", *at(tables), *COLUMNS, "--degree", "2", "--structure", "black-box"]
    argv += ["--test", "0.5", tables["0.5"], "--test", "0.25", tables["0.25"], "--refine"]
    assert main([*argv, "--json", str(figures)]) == 0
    content = json.loads(figures.read_text())
    at_point, between = content["test"]
    # Three points fix a parabola: at the points the local models come back. (The test record
    # has lost its means; the offset that the fit knows is a little different.)
    fits = [point["fit"] for point in content["points"]]
    assert [point["fit_lpv"][0] for point in content["points"]] == pytest.approx(
        [fit[0] for fit in fits], abs=0.01
    )
    assert at_point["lpv"][0] == pytest.approx(at_point["local"]["0.5"][0], abs=0.01)
    # Squared frequencies go as exp(0.6 K) and exp(-0.4 K): a parabola misses the first by 0.17 %
    # and the second by 0.05 %, under 3 % of its half bandwidth each, 2 * 0.03 and 2 * 0.02.
    assert between["lpv"][0] > 95.0 > max(fit[0] for fit in between["local"].values()) + 20.0
    assert "relative_error" not in content["points"][0]
    assert content["parameter_names"][0] == "A[0,0]"
    refined = content["refined"]
    # That the records do not tell the basis of the states is no reason for advice.
    assert refined["status"] == refined["advice"] == "Successful."
    assert refined["cost"] <= refined["initial_cost"] and refined["kept"] is True
    assert between["refined"][0] > 95.0
    captured = capsys.readouterr()
    assert "Aligning" in captured.err and "LPV refined" in captured.out


def test_refinement_on_all_records_beats_interpolation(capsys, tmp_path, tables):
    noise, samples = 0.05, 800
    points = ("0.0", "0.5", "1.0")
    noisy = {
        k: write_table(tmp_path / f"{k}.csv", np.full(samples, float(k)), 40 + seed, noise)
        for seed, k in enumerate(points)
    }
    clean = [
        write_table(tmp_path / f"t{k}.csv", np.full(samples, k), 50 + seed)
        for seed, k in enumerate((0.25, 0.75))
    ]
    model, figures = tmp_path / "model.json", tmp_path / "figures.json"
    argv = ["lpv", *at(noisy), *COLUMNS, "--degree", "1", "--keep-offsets", "--refine"]
    argv += ["--test", "0.25", clean[0], "--test", "0.75", clean[1], "--test", "k", tables["sweep"]]
    assert main([*argv, "--out", str(model), "--json", str(figures)]) == 0
    content = json.loads(figures.read_text())
    refined = content["refined"]
    assert refined["cost"] < refined["initial_cost"] and refined["kept"] is True
    assert refined["steps"] > 0 and refined["status"] == "Successful."
    before, after = (
        np.array([test[stage][0] for test in content["test"]]) for stage in ("lpv", "refined")
    )
    assert np.mean(after) > np.mean(before)
    # The maximum-likelihood estimate of p coefficients from N samples misses the response by
    # noise * sqrt(p / N), root mean square; thrice that is beyond chance.
    saved = load(model)
    bound = 100.0 * noise * np.sqrt(saved.coefficients.size / (len(points) * samples))
    assert np.all(after[:2] > 100.0 - 3.0 * bound)
    # What is saved is what was scored.
    record = read(clean[0], inputs=["u"], outputs=["y"], time="t")
    again = simulation_fit(saved.at(0.25), record)
    np.testing.assert_allclose(again, after[0], atol=1e-6)
    out = capsys.readouterr().out
    for words in ("refined, fitted (%)", "LPV refined", "Refined on all records at once: cost"):
        assert words in out


def test_extrapolation_is_warned_of(capsys, tables):
    argv = ["lpv", *at(tables), *COLUMNS, "--test", "-0.5", tables["0.25"]]
    assert main(argv) == 0
    error = capsys.readouterr().err
    assert error.count("it extrapolates there") == 1
    assert "lpvid lpv: warning:" in error


def test_an_unstable_local_model_is_named(capsys, tmp_path, tables, monkeypatch):
    monkeypatch.setattr(record_files, "DAMPINGS", (-0.001, 0.02))
    grows = write_table(tmp_path / "grows.csv", np.full(800, 0.5), 1)
    figures = tmp_path / "figures.json"
    argv = ["lpv", *at(tables | {"0.5": grows}), *COLUMNS, "--keep-offsets", "--degree", "2"]
    assert main([*argv, "--json", str(figures)]) == 0
    content = json.loads(figures.read_text())
    captured = capsys.readouterr()
    assert [point["stable"] for point in content["points"]] == [True, False, True]
    assert content["points"][1]["offsets"] is None
    assert content["points"][1]["status"] != "Successful."
    said = [text for text in content["warnings"] if text.startswith("K = 0.5: ")]
    assert "The identified model is unstable" in said[0] and "--stabilise 0.9999" in said[0]
    assert said[1] == f"K = 0.5: restructured, but: {content['points'][1]['status']}"
    assert all(f"lpvid lpv: warning: {text}" in captured.err for text in said)
    assert "NO" in captured.out and "Offsets" not in captured.out


def first_order(folder, poles):
    """Records of y(t+1) = z y(t) + u(t) at each K, as words of the command line."""
    words = []
    for seed, (kappa, z) in enumerate(poles.items()):
        u = np.random.default_rng(seed).standard_normal(300)
        y = np.zeros(300)
        for t in range(1, 300):
            y[t] = z * y[t - 1] + u[t - 1]
        file = folder / f"{kappa}.csv"
        np.savetxt(file, np.c_[u, y], delimiter=",", header="u,y", comments="")
        words += ["--at", str(kappa), str(file)]
    words += ["--input", "u", "--output", "y", "--dt", "0.01", "--order", "1", "--keep-offsets"]
    return ["lpv", *words, "--structure", "black-box"]


def test_stable_points_joined_by_unstable_models_are_told(capsys, tmp_path):
    # The parabola through the poles −10, −0.1, −0.1 1/s is above zero between the last two.
    poles = {kappa: np.exp(0.01 * s) for kappa, s in ((0.0, -10.0), (0.4, -0.1), (0.6, -0.1))}
    figures = tmp_path / "figures.json"
    argv = [*first_order(tmp_path, poles), "--degree", "2", "--json", str(figures)]
    assert main(argv) == 0
    content = json.loads(figures.read_text())
    assert all(point["stable"] for point in content["points"])
    assert content["stable_over_range"] is False
    assert "UNSTABLE at some K" in capsys.readouterr().out
    smooth, unstable = content["warnings"]
    assert "do not form a smooth family" in smooth
    # Roots of the parabola: 0.5 ± 0.087; of 33 points the first beyond is 0.43125.
    assert unstable.startswith("K = 0.43125: the LPV model frozen there is unstable")


def test_a_pole_without_a_logarithm_ends_the_command(capsys, tmp_path):
    assert main(first_order(tmp_path, {0.0: 0.5, 1.0: -0.5})) == 2
    *_, said = capsys.readouterr().err.splitlines()
    for words in ("at K = 1", "negative real axis", "--order", "smaller sample time"):
        assert words in said


def test_modes_that_cannot_be_told_apart_are_aligned_as_a_whole(capsys, tmp_path, monkeypatch):
    def refuses(*_):
        raise ValueError("models: no.")

    argv = [*first_order(tmp_path, {0.0: 0.5, 1.0: 0.6}), "--degree", "1"]
    monkeypatch.setattr(_lpv, "modal_along", refuses)
    figures = tmp_path / "figures.json"
    assert main([*argv, "--json", str(figures)]) == 0
    content = json.loads(figures.read_text())
    assert "cannot be told apart" in content["warnings"][0]
    assert content["refined"] is None and content["points"][0]["fit_refined"] is None
    assert all(point["fit_lpv"][0] > 99.0 for point in content["points"])
    capsys.readouterr()
    monkeypatch.setattr(_lpv, "align_along", refuses)
    assert main(argv) == 2
    assert "ask for --stabilise, or another --order" in capsys.readouterr().err
