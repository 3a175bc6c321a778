"""`lpvid identify` on records of known and of measured systems."""

import json

import numpy as np
import pytest

from lpvid.commands import main
from lpvid.io import load

from .record_files import DAMPINGS, DT, frequencies, simulate, write_table


def identified(capsys, tmp_path, argv, code=0):
    figures = tmp_path / "figures.json"
    assert main(["identify", *argv, "--json", str(figures)]) == code
    text = figures.read_text()
    assert "NaN" not in text and "Infinity" not in text
    return json.loads(text), capsys.readouterr()


def test_poles_of_a_known_system_are_found(capsys, tmp_path, tables):
    model = tmp_path / "model.json"
    argv = [tables["0.0"], "--input", "u", "--output", "y", "--time", "t"]
    content, captured = identified(capsys, tmp_path, [*argv, "--out", str(model)])
    assert content["order"] == 4
    assert content["stable"] is True
    assert content["dt"] == DT
    assert content["warnings"] == []
    assert content["samples"] == {"train": [400], "test": [400]}
    assert content["singular_values"][3] > 10 * content["singular_values"][4]
    upper = [pole for pole in content["poles"] if pole["im"] > 0]
    for pole, frequency, damping in zip(upper, frequencies(0.0), DAMPINGS, strict=True):
        assert pole["frequency_hz"] == pytest.approx(frequency, rel=1e-3)
        assert pole["damping"] == pytest.approx(damping, rel=0.03)
        s = complex(pole["continuous"]["re"], pole["continuous"]["im"])
        assert np.exp(s * DT) == pytest.approx(complex(pole["re"], pole["im"]), rel=1e-9)
    # Offsets of 0.3 and −2 are in the file. The mean of a lightly damped response is not quite
    # its offset; what it leaves is estimated with the model.
    assert min(content["fit"]["train"] + content["fit"]["test"]) > 99.5
    assert content["offsets"]["y"][0][0] == pytest.approx(-2.0, abs=0.05)
    assert "The model is for signals without them." in captured.out
    assert "5" in captured.out and "BFT" in captured.out
    assert captured.err == ""
    saved = load(model)
    poles = sorted(np.abs(np.asarray(saved.poles())))
    assert poles == pytest.approx(sorted(abs(complex(p["re"], p["im"])) for p in content["poles"]))


def test_offsets_are_kept_if_asked(capsys, tmp_path, tables):
    argv = [tables["0.0"], "--input", "u", "--output", "y", "--time", "t", "--order", "4"]
    content, captured = identified(capsys, tmp_path, [*argv, "--keep-offsets"])
    assert content["offsets"] is None
    assert content["fit"]["test"][0] < 99.0
    assert "Offsets" not in captured.out


@pytest.mark.slow
def test_refinement_takes_offsets_out_once(capsys, tmp_path):
    # A slow lag from rest: over the record its mean is far from its offset.
    rng = np.random.default_rng(3)
    u, y = np.repeat(rng.standard_normal(40), 10), np.zeros(400)
    for k in range(399):
        y[k + 1] = 0.995 * y[k] + 0.005 * (u[k] + 1.0)
    table = np.c_[DT * np.arange(400), u, y + 1e-3 * rng.standard_normal(400)]
    file = tmp_path / "slow.csv"
    np.savetxt(file, table, delimiter=",", header="t,u,y", comments="")
    argv = [str(file), "--input", "u", "--output", "y", "--time", "t", "--order", "1"]
    content, _ = identified(capsys, tmp_path, [*argv, "--refine"])
    assert content["fit"]["train"][0] > content["fit_before_refinement"]["train"][0] - 0.1
    assert content["poles"][0]["re"] == pytest.approx(0.995, abs=5e-4)


def slow_lag(path, offset, seed, n=600):
    """A lag of 50 samples, from a start far from rest: the mean of its output is not its offset."""
    rng = np.random.default_rng(seed)
    u, x = np.repeat(rng.standard_normal(n // 10), 10), np.zeros(n)
    x[0] = (-1.0) ** seed
    for k in range(n - 1):
        x[k + 1] = 0.98 * x[k] + 0.02 * u[k]
    table = np.c_[DT * np.arange(n), u, x + offset + 1e-3 * rng.standard_normal(n)]
    np.savetxt(path, table, delimiter=",", header="t,u,y", comments="")
    return str(path)


@pytest.mark.slow
def test_every_file_has_an_offset_of_its_own(capsys, tmp_path):
    offsets = (1.0, -2.0)
    files = [slow_lag(tmp_path / f"{k}.csv", offset, k) for k, offset in enumerate(offsets)]
    argv = [*files, "--input", "u", "--output", "y", "--time", "t", "--order", "1", "--refine"]
    content, _ = identified(capsys, tmp_path, [*argv, "--method", "continuous-moesp"])
    # The means of the inputs are taken out too, and with them what they make of the output.
    found = np.array(content["offsets"]["y"]) - np.array(content["offsets"]["u"])
    np.testing.assert_allclose(found[:, 0], offsets, atol=0.01)
    assert content["poles"][0]["continuous"]["re"] == pytest.approx(np.log(0.98) / DT, rel=0.02)
    # Noise of 1e-3 on an output of more than 0.1.
    assert min(content["fit"]["train"] + content["fit"]["test"]) > 99.0


@pytest.mark.slow
def test_several_files_are_several_records(capsys, tmp_path):
    files = [write_table(tmp_path / f"{k}.csv", np.zeros(n), k) for k, n in enumerate((500, 400))]
    argv = [*files, "--input", "u", "--output", "y", "--dt", "0.01", "--order", "4"]
    content, _ = identified(capsys, tmp_path, [*argv, "--split", "0.6", "--method", "pi-moesp"])
    assert content["samples"] == {"train": [300, 240], "test": [200, 160]}
    assert content["method"] == "pi-moesp"
    assert min(content["fit"]["test"]) > 99.0
    assert len(content["offsets"]["u"]) == 2


@pytest.mark.slow
def test_an_unstable_model_is_warned_of_and_can_be_stabilised(capsys, tmp_path):
    u, _ = simulate(np.zeros(400), 3)
    y = np.zeros(400)
    for t in range(1, 400):
        y[t] = 1.01 * y[t - 1] + u[t - 1]
    file = tmp_path / "grows.csv"
    np.savetxt(file, np.c_[u, y], delimiter=",", header="u,y", comments="")
    argv = [str(file), "--input", "u", "--output", "y", "--dt", "1", "--order", "1"]
    argv += ["--keep-offsets"]
    content, captured = identified(capsys, tmp_path, argv)
    assert content["stable"] is False
    assert len(content["warnings"]) == 1
    assert "--stabilise 0.9999" in content["warnings"][0]
    assert "po-moesp" not in content["warnings"][0]
    assert captured.err == f"lpvid identify: warning: {content['warnings'][0]}\n"
    content, _ = identified(capsys, tmp_path, [*argv, "--method", "pi-moesp"])
    assert content["warnings"][0].endswith(", or use --method po-moesp.")
    content, captured = identified(capsys, tmp_path, [*argv, "--stabilise"])
    assert content["stable"] is True
    assert content["poles_moved"] == 1
    assert content["poles"][0]["re"] == pytest.approx(0.9999)
    assert captured.err == ""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "argv", "least"),
    [
        ("emps/DATA_EMPS.mat", ["--input", "vir", "--output", "qm", "--time", "t"], [90.0]),
        ("daisy/robot_arm.dat", ["--input", "1", "--output", "2", "--dt", "1"], [90.0]),
        pytest.param(
            "daisy/CD_player_arm.dat",
            ["--input", "1,2", "--output", "3,4", "--dt", "1", "--order", "6"],
            [62.9, 76.8],
            marks=pytest.mark.slow,
        ),
    ],
)
def test_measured_records_are_identified(capsys, tmp_path, measured_data, file, argv, least):
    block_rows = ["--block-rows", "15"] if "CD" in file else []
    order = [] if "--order" in argv else ["--order", "4"] if "robot" in file else []
    content, _ = identified(
        capsys, tmp_path, [str(measured_data / file), *argv, *order, *block_rows]
    )
    assert np.all(np.array(content["fit"]["test"]) > np.array(least))
