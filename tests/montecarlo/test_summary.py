"""Statistics over runs against NumPy on what was put in."""

import json

import numpy as np
import pytest

from lpvid.montecarlo import summarise


@pytest.fixture
def samples():
    return np.random.default_rng(0).normal([1.0, -2.0], [0.1, 0.5], (4000, 2))


def test_statistics_of_a_known_normal_variable(samples):
    summary = summarise(
        samples, truth=[1.0, -2.0], bound=[0.1, 0.25], deviation=np.full((4000, 2), [0.1, 0.25])
    )
    assert summary.success == 1.0
    # Four standard errors of 4000 samples.
    np.testing.assert_allclose(summary.std, [0.1, 0.5], rtol=4 / np.sqrt(8000))
    np.testing.assert_allclose(summary.low, np.quantile(samples, 0.05, axis=0))
    np.testing.assert_allclose(summary.high, np.quantile(samples, 0.95, axis=0))
    np.testing.assert_allclose(summary.ratio, [1.0, 2.0], rtol=4 / np.sqrt(8000))
    # Intervals half as wide as they should be hold the truth with P(|x| < 0.98) = 0.673.
    np.testing.assert_allclose(summary.coverage, [0.95, 0.673], atol=0.03)


def test_failed_runs_do_not_count_and_empty_points_are_nan(samples):
    runs = np.stack([samples[:10], samples[10:20]])
    runs[0, 3] = np.nan
    kept = np.ones((2, 10), bool)
    kept[0, 3] = False
    kept[1] = False
    summary = summarise(runs, kept=kept, truth=[1.0, -2.0], deviation=np.ones(runs.shape))
    np.testing.assert_allclose(summary.success, [0.9, 0.0])
    np.testing.assert_allclose(summary.mean[0], np.delete(runs[0], 3, axis=0).mean(axis=0))
    for name in ("mean", "std", "median", "low", "high", "rms", "coverage"):
        assert np.all(np.isfinite(getattr(summary, name)[0])), name
        assert np.all(np.isnan(getattr(summary, name)[1])), name


def test_rows_and_text(samples):
    summary = summarise(samples[None], kept=np.ones((1, 4000), bool), names=["gain", "pole"])
    rows = summary.rows()
    assert [row["name"] for row in rows] == ["gain", "pole"]
    assert json.loads(json.dumps(rows))[1]["mean"] == pytest.approx(-2.0, abs=0.05)
    assert "rms" not in rows[0]
    header, first, second = str(summary).splitlines()
    assert header.split()[:4] == ["point", "name", "success", "mean"]
    assert first.split()[:3] == ["0", "gain", "1"] and second.split()[1] == "pole"
    assert len({len(line) for line in (header, first, second)}) == 1


def test_entries_without_names_are_numbered():
    assert summarise(np.zeros((3, 2, 2))).names == ("[0,0]", "[0,1]", "[1,0]", "[1,1]")
    assert summarise(np.zeros(3)).names == ("value",)


def test_a_data_frame_is_made_of_rows():
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame(summarise(np.array([[1.0, 2.0], [3.0, 4.0]])).rows())
    assert frame["median"].tolist() == [2.0, 3.0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"samples": 1.0}, "samples: an axis of runs"),
        ({"samples": np.zeros((2, 3)), "kept": np.ones((3, 2), bool)}, "samples: their leading"),
        ({"samples": np.zeros(3), "bound": 1.0}, "truth: a bound or deviations"),
        ({"samples": np.zeros((3, 2)), "truth": np.zeros(3)}, "truth: numbers of shape"),
        ({"samples": np.zeros((3, 2)), "names": ["one"]}, "names: 2 are needed"),
    ],
)
def test_what_does_not_fit_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        summarise(**arguments)
