"""`lpvid demo`: its files and tables, on a result put together without noise; once for real."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from loop.loop_records import named

from lpvid import commands
from lpvid._results import Status
from lpvid.analysis import bft, vaf
from lpvid.commands import _demo, _demo_figures
from lpvid.commands._demo_loop import Ending
from lpvid.data import IOData
from lpvid.interpolate import interpolate, interpolate_balanced
from lpvid.mechanics import StudyRecords, reference_two_link_arm, two_link_arm_structure
from lpvid.models import Polynomial
from lpvid.restructure import Restructured
from lpvid.study import MODEL_NAMES, StudyResult, Undeclared

PICTURES = (
    "records",
    "local_response",
    "bode",
    "minima",
    "poles",
    "parameters",
    "modes",
    "sweep",
)
NAMES = {"u": ["r1", "r2"], "y": ["v1", "v2"], "kappa": "c"}


def _record(model, seed, kappa):
    u = 0.1 * np.sign(np.random.default_rng(seed).standard_normal((120, 2)))
    y = model.simulate(u=u, dt=1e-3)
    return IOData(u=u, y=y, dt=1e-3, kappa=kappa, names=NAMES)


def _exact(structure, parameters, costs):
    return Restructured(
        structure=structure,
        parameters=parameters,
        error_norm=jnp.asarray(1e-3),
        peak_frequency=jnp.asarray(10.0),
        match_costs=jnp.asarray(costs),
        hits=jnp.asarray(2),
        margin=jnp.asarray(4.0),
        history=jnp.asarray([2e-3, 1e-3]),
        status=Status.successful,
    )


@pytest.fixture(scope="module")
def result():
    """The study's result as it would be with perfect local models, and a broken balanced one."""
    arm = reference_two_link_arm()
    structure = two_link_arm_structure(lengths=(0.35, 0.30))
    theta2 = tuple(k * np.pi / 8.0 for k in (2, 4, 6))
    kappas = np.cos(theta2)
    analytic = [arm.linearised(angle) for angle in theta2]
    restructured = [
        _exact(structure, arm.structured_parameters(angle), [1e-6, 1e-6, 4e-6]) for angle in theta2
    ]
    local = [_record(m, i, k) for i, (m, k) in enumerate(zip(analytic, kappas, strict=True))]
    joined = IOData(
        u=[r.u for r in local], y=[r.y for r in local], dt=1e-3, kappa=kappas, names=NAMES
    )
    sweep = local[1]
    lpv = {
        "restructured": interpolate(restructured, kappas, Polynomial(1)),
        "analytic": interpolate(analytic, kappas, Polynomial(1)),
        "balanced": interpolate_balanced(analytic, kappas, Polynomial(1)),
    }
    outputs = dict.fromkeys(MODEL_NAMES, 0.99 * sweep.y)
    outputs["balanced"] = 1e6 * sweep.y
    return StudyResult(
        arm=arm,
        records=StudyRecords(joined, joined, sweep),
        noisy=joined,
        theta2=theta2,
        black_boxes=analytic,
        restructured=restructured,
        analytic=analytic,
        lpv=lpv,
        sweep_outputs=outputs,
        local_bft=jnp.full((3, 2), 99.0),
        local_vaf=jnp.full((3, 2), 99.9),
        sweep_bft={name: bft(sweep.y, y) for name, y in outputs.items()},
        sweep_vaf={name: vaf(sweep.y, y) for name, y in outputs.items()},
        relative_cost=jnp.array([1e-6, 2e-6, jnp.nan]),
        interpolation_fit={name: {1: 98.0, 2: 99.0} for name in MODEL_NAMES},
        failed_runs=0,
        seconds={"simulate": 1.0, "identify": 2.0},
    )


def test_files_and_tables_are_written(capsys, tmp_path, monkeypatch, result):
    asked = {}

    def study(key, *, runs, report):
        asked.update(key=key, runs=runs)
        report("Simulating")
        return result

    def end(arm, seed):
        asked.update(seed=seed)
        return Ending(Undeclared(result.records.sweep, "coulomb", 2, 0.07, "N·m"), named(100))

    monkeypatch.setattr(_demo, "run_study", study)
    monkeypatch.setattr(_demo, "end", end)
    folder = tmp_path / "new" / "demo"
    assert commands.main(["demo", "--out", str(folder), "--runs", "3", "--seed", "5"]) == 0
    assert asked["runs"] == 3 and asked["seed"] == 5
    assert jnp.array_equal(
        jax.random.key_data(asked["key"]), jax.random.key_data(jax.random.key(5))
    )
    text = (folder / "summary.json").read_text()
    assert "NaN" not in text
    content = json.loads(text)
    study = content["study"]
    for measure in ("bft", "vaf"):
        assert set(study[measure]) == set(MODEL_NAMES)
        assert all(len(values) == 2 for values in study[measure].values())
    assert len(study["relative_cost"]) == 3 and study["relative_cost"][2] is None
    assert study["fit_percent"] == {"1": 98.0, "2": 99.0}
    assert study["seconds"] > 0.0
    assert (content["seed"], content["runs"]) == (5, 3)
    assert {path.name for path in folder.iterdir()} == {
        "summary.json",
        "report.html",
        "loop.html",
        *(f"{name}.png" for name in (*PICTURES, "virtual_forces", "held_out")),
    }
    assert content["loop"]["hidden"]["name"] == content["loop"]["effects"][0]["name"] == "coulomb"
    page = (folder / "report.html").read_text()
    assert page.count("data:image/png;base64,") == len(PICTURES) + 2
    assert "<script" not in page and "http" not in page.replace("http-equiv", "")
    for number in (1, 2, 3, 4):
        assert f"Table {number}." in page
    captured = capsys.readouterr()
    assert "Table 4." in captured.out
    assert captured.out.rstrip().endswith(f"Report: {folder / 'report.html'}")
    assert "[1/7] Simulating" in captured.err
    # 001's figures stand beside: θ2 = 2π/8 in table 1, restructured y1 in table 4.
    assert "91.23" in captured.out and "76.2" in captured.out


def test_a_model_that_runs_away_leaves_the_sweep_readable(result):
    axes = _demo_figures._sweep(result)
    measured = np.asarray(result.records.sweep.y)
    for k, (main, rest) in enumerate(axes):
        width = np.ptp(measured[:, k])
        assert np.ptp(main.get_ylim()) < 4.0 * width
        assert np.ptp(rest.get_ylim()) < 4.0 * width


@pytest.mark.slow
def test_one_run_of_the_whole_study(capsys, tmp_path):
    assert commands.main(["demo", "--out", str(tmp_path), "--runs", "1"]) == 0
    content = json.loads((tmp_path / "summary.json").read_text())
    study = content["study"]
    assert len(study["relative_cost"]) == 7
    assert np.min(study["local_bft"]) > 93.0
    restructured, analytic, balanced = (np.array(study["bft"][name]) for name in MODEL_NAMES)
    assert np.all(restructured > analytic - 1.0)
    assert np.all(restructured > balanced)
    assert content["loop"]["verdict"] == "named"
    assert [effect["name"] for effect in content["loop"]["effects"]] == ["coulomb"]
    assert "Table 4." in capsys.readouterr().out
