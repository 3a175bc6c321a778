"""`lpvid step` on records of a known plant that settle."""

import json
from pathlib import Path

import numpy as np
import pytest

from lpvid.commands import main
from lpvid.io import load
from lpvid.models import StateSpace

DT = 0.02
PLANT = StateSpace(
    [[-2.0, 0.0, 0.0], [0.0, -1.0, 4.0], [0.0, -4.0, -1.0]],
    [[1.0, 0.0], [0.0, 2.0], [1.0, 1.0]],
    [[2.0, 1.0, 0.0], [0.0, 1.0, 1.0]],
)
COLUMNS = ["--input", "u1,u2", "--output", "y1,y2", "--time", "t", "--order", "3"]


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """Two steps of different heights, and a record with both at once to test on."""
    folder, noise = tmp_path_factory.mktemp("steps"), np.random.default_rng(2)
    files = []
    for k, level in enumerate(([1.0, 0.0], [0.0, -2.0], [1.0, 1.0])):
        u = np.tile(level, (800, 1))
        y = np.asarray(PLANT.simulate(u=u, dt=DT)) + 1e-3 * noise.standard_normal((800, 2))
        files.append(str(folder / f"step{k}.csv"))
        columns = np.column_stack([DT * np.arange(800), u, y])
        np.savetxt(files[-1], columns, delimiter=",", header="t,u1,u2,y1,y2", comments="")
    return files


@pytest.mark.slow
def test_the_plant_is_found_and_tested(capsys, tmp_path, tables):
    model, figures = tmp_path / "model.json", tmp_path / "figures.json"
    argv = ["step", *tables[:2], *COLUMNS, "--refine", "--test", tables[2]]
    assert main([*argv, "--out", str(model), "--json", str(figures)]) == 0
    content, printed = json.loads(figures.read_text()), capsys.readouterr().out
    assert content["stable"] is True
    poles = [complex(pole["re"], pole["im"]) for pole in content["poles"]]
    for truth in (-2.0, -1.0 + 4.0j, -1.0 - 4.0j):
        assert min(abs(pole - truth) for pole in poles) < 0.03
    np.testing.assert_allclose(content["dc_gain"], PLANT.dc_gain(), atol=2e-3)
    assert np.min(content["fit"]["refined"]["test"]) > 98.0
    assert np.min(content["fit"]["identified"]["test"]) > 95.0
    assert content["noise_std"] == pytest.approx([1e-3, 1e-3], rel=0.2)
    assert "step2.csv" in printed and "pole (1/s)" in printed
    saved = load(model)
    assert isinstance(saved, StateSpace) and not saved.is_discrete


def test_records_that_do_not_settle_are_refused(capsys, tmp_path, tables):
    short = []
    for k, file in enumerate(tables[:2]):
        lines = Path(file).read_text().splitlines(keepends=True)[:60]
        short.append(str(tmp_path / f"short{k}.csv"))
        Path(short[-1]).write_text("".join(lines))
    assert main(["step", *short, *COLUMNS]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "settled" in error


def test_fewer_records_than_inputs_are_refused(capsys, tables):
    assert main(["step", tables[0], *COLUMNS]) == 2
    assert "2 inputs" in capsys.readouterr().err
