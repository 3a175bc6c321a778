"""`lpvid gray-box` on a record of known masses, dampers and springs."""

import json

import jax
import numpy as np
import pytest

from lpvid.commands import main
from lpvid.io import load
from lpvid.mechanics import MassSpringDamper, random_steps
from lpvid.models import StructuredModel

DT = 0.02
TRUTH = MassSpringDamper(
    [[2.0, -0.3], [-0.3, 1.0]], [[2.0, 0.1], [0.1, 1.0]], [[90.0, -5.0], [-5.0, 40.0]]
)
COLUMNS = ["--input", "f1,f2", "--output", "d1,d2", "--time", "t", "--tau", "0.1"]


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    u = np.asarray(random_steps(jax.random.key(0), 3000, 2, dt=DT))
    y = np.asarray(TRUTH.state_space().simulate(u=u, dt=DT))
    y = y + 1e-4 * np.random.default_rng(1).standard_normal(y.shape)
    path = tmp_path_factory.mktemp("forces") / "run.csv"
    columns = np.column_stack([DT * np.arange(3000), u, y])
    np.savetxt(path, columns, delimiter=",", header="t,f1,f2,d1,d2", comments="")
    return str(path)


@pytest.mark.slow
def test_matrices_and_modes_come_with_intervals_that_hold_the_truth(capsys, tmp_path, table):
    model, figures = tmp_path / "model.json", tmp_path / "figures.json"
    argv = ["gray-box", table, *COLUMNS, "--block-rows", "5"]
    assert main([*argv, "--out", str(model), "--json", str(figures)]) == 0
    content, printed = json.loads(figures.read_text()), capsys.readouterr().out
    modes = TRUTH.modes()
    truths = {
        "mass": TRUTH.mass,
        "damping": TRUTH.damping,
        "stiffness": TRUTH.stiffness,
        "frequency_hz": modes.frequencies / (2.0 * np.pi),
        "damping_ratio": modes.damping_ratios,
    }
    for name, truth in truths.items():
        value, std = (np.array(content[name][key]) for key in ("value", "std"))
        # Four standard deviations: a chance of 1e-4 for each of these entries.
        assert np.all(np.abs(value - np.asarray(truth)) < 4.0 * std), name
        assert np.all(std < 0.02 * np.abs(np.asarray(truth)).max()), name
        low, high = np.moveaxis(np.array(content[name]["interval95"]), -1, 0)
        np.testing.assert_allclose(high - low, 2 * 1.96 * std, rtol=1e-3)
    assert content["samples"] == {"train": [2250], "test": [750]}
    assert content["noise_std"] == pytest.approx([1e-4, 1e-4], rel=0.1)
    assert content["warnings"] == []
    assert "M[1,2]" in printed and "±" in printed and "frequency (Hz)" in printed
    saved = load(model)
    assert isinstance(saved, StructuredModel)
    mass = saved.structure.mechanical_matrices(saved.parameters)[0]
    np.testing.assert_array_equal(mass, content["mass"]["value"])


@pytest.mark.slow
def test_removed_offsets_are_estimated_with_the_model(capsys, tmp_path):
    # Hardly damped: over 5 s the mean of the motion is far from the sensor's zero.
    system = MassSpringDamper([[2.0]], [[0.4]], [[8.0]])
    rng, zero = np.random.default_rng(2), 0.7
    u = np.asarray(random_steps(jax.random.key(3), 300, 1, dt=DT))
    y = np.asarray(system.state_space().simulate(u=u, dt=DT, x0=np.array([0.5, 0.0])))
    path, figures = tmp_path / "run.csv", tmp_path / "figures.json"
    table = np.column_stack([u, y + zero + 1e-3 * rng.standard_normal(y.shape)])
    np.savetxt(path, table, delimiter=",", header="f,d", comments="")
    argv = ["gray-box", str(path), "--input", "f", "--output", "d", "--dt", str(DT), "--tau", "0.2"]
    argv += ["--block-rows", "5", "--remove-offsets", "--json", str(figures)]
    assert main(argv) == 0
    content = json.loads(figures.read_text())
    for name, truth in (("mass", 2.0), ("damping", 0.4), ("stiffness", 8.0)):
        value, std = (np.array(content[name][key]).item() for key in ("value", "std"))
        assert abs(value - truth) < 4.0 * std < 0.1 * truth, name
    # At rest under the mean force, the mass is as far from its sensor's zero as the spring gives.
    rest = content["offsets"]["y"][0][0] - content["offsets"]["u"][0][0] / 8.0
    assert rest == pytest.approx(zero, abs=2e-3)
    assert content["noise_std"] == pytest.approx([1e-3], rel=0.2)
    assert content["unidentified"] == [False, False, False]
    assert min(content["fit"]["refined"]["train"] + content["fit"]["refined"]["test"]) > 97.0


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--input", "f1", "--output", "d1,d2", "--dt", "0.02"], ["one force", "same order"]),
        ([*COLUMNS, "--tau", "-1"], ["--tau", "positive"]),
        ([*COLUMNS, "--split", "1.5"], ["--split"]),
    ],
)
def test_wrong_use_is_one_line(capsys, table, argv, words):
    assert main(["gray-box", table, *argv]) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert all(word in captured.err for word in words)
