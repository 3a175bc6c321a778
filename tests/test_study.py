"""The study at a small size, and (slow) its claims at full size."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpvid.analysis import bft, hinf_norm
from lpvid.interpolate import interpolate
from lpvid.study import MODEL_NAMES, MonteCarloResult, run_monte_carlo, run_study, summary

# Squared norm over ‖G_anal‖∞ at the seven points, 001, table 2.
TABLE_2 = [4.03e-3, 2.1e-3, 1.48e-3, 1.25e-3, 1.03e-3, 7.28e-4, 4.79e-4]
THREE_POINTS = (np.pi / 4, np.pi / 2, 3 * np.pi / 4)


RUNS = 2


@pytest.fixture(scope="module")
def monte_carlo(tmp_path_factory):
    stages = []
    result = run_monte_carlo(
        jax.random.key(0),
        runs=RUNS,
        theta2=THREE_POINTS,
        n_samples=6000,
        reference=True,
        checkpoint=tmp_path_factory.mktemp("study") / "runs.npz",
        report=stages.append,
    )
    return result, stages


@pytest.fixture(scope="module")
def small(monte_carlo):
    return monte_carlo[0].study, monte_carlo[1]


@pytest.mark.slow
def test_the_small_study_is_whole(small):
    result, stages = small
    assert len(stages) == 8 and "Identifying 6 noisy records" in stages[1]
    assert set(result.seconds) == {"simulate", "identify", "average", "restructure", "validate"}
    assert result.records.local.lengths == result.noisy.lengths == (600, 600, 600)
    assert set(result.sweep_outputs) == set(result.lpv) == set(MODEL_NAMES)
    for y in result.sweep_outputs.values():
        assert y.shape == result.records.sweep.y.shape and np.all(np.isfinite(y))
    assert result.failed_runs == 0
    assert [model.nx for model in result.black_boxes] == [6, 6, 6]


@pytest.mark.slow
def test_every_run_is_restructured_by_itself(monte_carlo):
    result, _ = monte_carlo
    structure = result.study.restructured[0].structure
    assert result.runs.values.parameters.shape == (3, RUNS, 16)
    assert result.relative_cost.shape == result.runs.kept.shape == (3, RUNS)
    assert result.runs.failed == result.black_boxes.failed == result.sweeps.failed == 0
    for point, analytic in enumerate(result.study.analytic):
        exact = structure.matrices(result.true_parameters[point])
        np.testing.assert_allclose(exact.A, analytic.A, atol=1e-12)
        np.testing.assert_allclose(exact.B, analytic.B, atol=1e-12)
        for run in range(RUNS):
            black_box = jax.tree.map(
                lambda leaf, p=point, r=run: jnp.asarray(leaf[p, r]),
                result.black_boxes.values.model,
            )
            found = structure.matrices(jnp.asarray(result.runs.values.parameters[point, run]))
            norm = hinf_norm(found - black_box).value
            np.testing.assert_allclose(result.runs.values.error_norm[point, run], norm, rtol=1e-6)
            wanted = norm**2 / hinf_norm(analytic).value
            np.testing.assert_allclose(result.relative_cost[point, run], wanted, rtol=1e-6)
    # Another noise realisation, another black box.
    parameters = result.runs.values.parameters
    assert np.all(np.any(parameters[:, 0] != parameters[:, 1], axis=-1))
    assert result.share_optimal() >= 0.95


@pytest.mark.slow
def test_single_runs_are_validated_on_the_sweep(monte_carlo):
    result, _ = monte_carlo
    assert result.sweeps.values.bft.shape == (RUNS, 2)
    kappas = np.cos(THREE_POINTS)
    structure = result.study.restructured[0].structure
    models = [structure.matrices(jnp.asarray(p)) for p in result.runs.values.parameters[:, 1]]
    sweep = result.study.records.sweep
    y = interpolate(models, kappas).simulate(u=sweep.u, kappa=sweep.kappa, dt=sweep.dt)
    np.testing.assert_allclose(result.sweeps.values.bft[1], bft(sweep.y, y), rtol=1e-8)
    np.testing.assert_allclose(
        result.mean_model.at(kappas[1]).A,
        structure.matrices(jnp.mean(result.runs.values.parameters[1], axis=0)).A,
        rtol=1e-8,
        atol=1e-8,
    )


@pytest.mark.slow
def test_noise_is_30_db(small):
    result, _ = small
    clean = np.asarray(result.records.local.y)
    noise = np.asarray(result.noisy.y) - clean
    records = zip(np.split(clean, 3), np.split(noise, 3), strict=True)
    ratios = [10 * np.log10(np.var(y, axis=0) / np.var(e, axis=0)) for y, e in records]
    np.testing.assert_allclose(ratios, 30.0, atol=1.0)


@pytest.mark.slow
def test_even_the_small_study_finds_the_plant(small):
    result, _ = small
    # One noisy record of 0.6 s each: rougher than the full study, but no wrong minimum.
    assert np.all(np.asarray(result.relative_cost) < 1e-3)
    assert np.all(np.asarray(result.local_bft) > 98.0)
    restructured, analytic, balanced = (np.asarray(result.sweep_bft[n]) for n in MODEL_NAMES)
    assert np.all(restructured > analytic - 1.0), (restructured, analytic)
    assert np.all(restructured > balanced), (restructured, balanced)
    for found, black_box in zip(result.restructured, result.black_boxes, strict=True):
        assert found.hits >= 1 and found.error_norm <= found.history[0]
        assert bool(found.model.is_stable()) and bool(black_box.is_stable())


@pytest.mark.slow
def test_relative_cost_is_table_2s(small):
    result, _ = small
    found, analytic = result.restructured[1], result.analytic[1]
    omega = np.concatenate([[0.0], np.geomspace(0.1, 2e4, 20_000)])

    def peak(system):
        return np.linalg.svd(system.frequency_response(omega), compute_uv=False).max()

    expected = peak(found.model - result.black_boxes[1]) ** 2 / peak(analytic)
    np.testing.assert_allclose(result.relative_cost[1], expected, rtol=1e-3)


@pytest.mark.slow
def test_summary_is_json(small):
    result, _ = small
    text = json.dumps(summary(result), allow_nan=False)
    figures = json.loads(text)
    assert set(figures) == {
        "theta2",
        "bft",
        "vaf",
        "local_bft",
        "local_vaf",
        "relative_cost",
        "fit_percent",
        "fit_percent_by_model",
        "hits",
        "margin",
        "failed_runs",
        "seconds",
        "seconds_by_stage",
    }
    assert figures["bft"]["restructured"] == np.asarray(result.sweep_bft["restructured"]).tolist()
    assert set(figures["fit_percent"]) == {"1", "2"}
    assert len(figures["margin"]) == 3


def test_a_study_without_runs_is_refused():
    with pytest.raises(ValueError, match="runs: at least one"):
        run_study(jax.random.key(0), runs=0)


@pytest.mark.slow
def test_the_full_study_keeps_its_promises():
    whole = run_monte_carlo(jax.random.key(0), runs=10, reference=True)
    result = whole.study
    assert result.failed_runs == whole.runs.failed == 0
    restructured, analytic, balanced = (np.asarray(result.sweep_bft[n]) for n in MODEL_NAMES)
    assert np.all(restructured >= analytic - 1.0), (restructured, analytic)
    assert np.all(restructured > balanced), (restructured, balanced)
    assert np.asarray(result.local_bft).min() >= 93.0
    assert np.all(np.asarray(result.relative_cost) < TABLE_2)
    assert np.all(whole.relative_cost < np.array(TABLE_2)[:, None])
    assert whole.share_optimal(0.05) >= 0.95


def test_a_study_without_a_reference_has_nothing_to_compare_with():
    empty = MonteCarloResult.__new__(MonteCarloResult)
    object.__setattr__(empty, "reference", None)
    with pytest.raises(ValueError, match="reference: none; run the study with reference=True"):
        empty.share_optimal()
