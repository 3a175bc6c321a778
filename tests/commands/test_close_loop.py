"""`lpvid close-loop`: what it asks of the engine, what it says and writes, and what it refuses."""

import functools
import json
from types import SimpleNamespace

import numpy as np
import pytest
from loop.loop_records import abstained, named

from lpvid import loop
from lpvid.commands import _close_loop, main
from lpvid.io import save
from lpvid.loop.structures import PortedModel
from lpvid.models import StateSpace
from lpvid.report import _report

from .test_usage import refused

COLUMNS = ["--input", "u", "--output", "y", "--time", "t"]


@pytest.fixture
def engine(monkeypatch):
    """What the engine was asked, which answers at once."""
    asked = SimpleNamespace(found=named(), bases=[])

    def structure_named(name, data, *, order=None):
        asked.bases.append((name, data, order))
        return SimpleNamespace(name=name)

    def close_the_loop(structure, data, **options):
        asked.structure, asked.data, asked.options = structure, data, options
        return asked.found

    # Few dots: pictures are tested elsewhere.
    monkeypatch.setattr(_report, "png_bytes", functools.partial(_report.png_bytes, dpi=10.0))
    monkeypatch.setattr(_close_loop, "structure_named", structure_named)
    monkeypatch.setattr(loop, "close_the_loop", close_the_loop)
    return asked


def test_verdict_effects_and_errors_are_said_and_written(capsys, tmp_path, tables, engine):
    figures, page = tmp_path / "figures.json", tmp_path / "page.html"
    argv = [tables["0.0"], *COLUMNS, "--structure", "servo"]
    assert main(["close-loop", *argv, "--json", str(figures), "--html", str(page)]) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    for words in (
        "Structure servo",
        "Found: coulomb (force at joint) and cubic-stiffness (force at joint).",
        "level = 0.703 ± 0.012 N m",
        "cannot tell it from dahl at joint or stribeck at joint",
        "one step",
        "free run",
        "59.81",
        "98.86",
        f"Report written to {page}",
    ):
        assert words in captured.out
    text = figures.read_text()
    assert "NaN" not in text and "Infinity" not in text
    content = json.loads(text)
    assert content["command"] == "close-loop"
    assert content["verdict"] == "named"
    assert content["inputs"] == ["u"]
    assert page.read_text().startswith("<!DOCTYPE html>")
    ((base, fitted, order),) = engine.bases
    assert (base, order) == ("servo", None)
    # The structure is started from what is fitted to, and from nothing else.
    assert fitted.n_samples == pytest.approx(2 / 3 * engine.data.n_samples, abs=1)
    assert engine.options == {
        "test": None,
        "split": pytest.approx(2 / 3),
        "hold": "zero",
        "progress": False,
    }


def test_files_are_experiments_and_a_test_file_is_held_out(capsys, tables, engine):
    argv = [tables["0.0"], tables["0.5"], *COLUMNS, "--schedule", "k", "--order", "3"]
    assert main(["close-loop", *argv, "--test", tables["1.0"], "--hold", "linear"]) == 0
    assert engine.options["hold"] == "linear"
    assert engine.data.lengths == (800, 800)
    assert engine.data.scheduling_names == ("k",)
    test = engine.options["test"]
    assert np.asarray(test.kappa)[0, 0] == 1.0
    ((base, fitted, order),) = engine.bases
    assert (base, order) == ("black-box", 3)
    assert fitted is engine.data


def test_a_saved_model_is_where_it_starts(capsys, tmp_path, tables, engine):
    file = str(save(tmp_path / "model.json", StateSpace([[0.5]], [[1.0]], [[1.0]], dt=0.01)))
    assert main(["close-loop", tables["0.0"], *COLUMNS, "--model", file, "--split", "0.4"]) == 0
    assert engine.bases == []
    assert isinstance(engine.structure, PortedModel)
    # Half a sample's decay in 0.01 s.
    assert engine.structure.nominal[0] == pytest.approx(np.log(2.0) / 0.01)
    assert engine.options["split"] == 0.4


def test_an_abstention_is_no_fault(capsys, tmp_path, tables, engine):
    engine.found = abstained()
    figures = tmp_path / "figures.json"
    assert main(["close-loop", tables["0.0"], *COLUMNS, "--json", str(figures)]) == 0
    assert "No name" in capsys.readouterr().out
    content = json.loads(figures.read_text())
    assert content["verdict"] == "abstain" and content["effects"] == []
    assert content["error"]["after"]["free_run"] == [None]


def test_the_order_of_a_structure_that_has_its_own_is_refused(capsys, tables):
    argv = [tables["0.0"], *COLUMNS, "--structure", "servo", "--order", "3"]
    refused(capsys, ["close-loop", *argv], "--order 3", "servo", "has an order of its own")


def test_a_model_of_other_channels_is_refused(capsys, tmp_path, tables):
    file = str(save(tmp_path / "model.json", StateSpace([[-1.0]], [[1.0]], [[1.0], [2.0]])))
    argv = [tables["0.0"], *COLUMNS, "--model", file]
    refused(capsys, ["close-loop", *argv], "needs 2 outputs", "the data has 1")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--structure", "robot"], ["--structure", "flexible-joint"]),
        (["--model", "FILE", "--structure", "servo"], ["--model", "--structure"]),
        (["--model", "FILE", "--order", "3"], ["--model", "--order"]),
        (["--model", "gone.json"], ["gone.json"]),
        (["--model", "FILE"], ["FILE"]),
        (["--test", "FILE", "--split", "0.5"], ["--test", "--split"]),
        (["--test", "gone.csv"], ["gone.csv: no such file"]),
        (["--schedule", "y"], ["'y'", "--output and --schedule"]),
        (["--schedule", "level"], ["no column 'level'"]),
        (["--split", "1"], ["--split", "between 0 and 1"]),
        (["--html", "gone/page.html"], ["--html", "does not exist"]),
        (["--test", "FILE", "--html", "FILE"], ["--html", "overwritten"]),
        (["--html", "a", "--json", "a"], ["--json's file too"]),
    ],
)
def test_wrong_use_is_said_in_one_line(
    capsys, tables, tmp_path, monkeypatch, options, words, engine
):
    monkeypatch.chdir(tmp_path)
    swap = {"FILE": tables["0.0"]}
    argv = [swap.get(word, word) for word in options]
    words = [swap.get(word, word) for word in words]
    refused(capsys, ["close-loop", tables["0.5"], *COLUMNS, *argv], *words)
    assert engine.bases == []
