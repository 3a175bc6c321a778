import numpy as np
import pytest

from lpvid.data import IOData
from lpvid.plot import compare, records


@pytest.fixture(scope="module")
def data() -> IOData:
    rng = np.random.default_rng(0)
    return IOData(
        u=rng.normal(size=(40, 2)),
        y=rng.normal(size=(40, 1)),
        dt=0.1,
        kappa=np.linspace(0.0, 1.0, 40),
        names={"u": ["torque", "force"], "y": "rate", "kappa": "load"},
        units={"u": ["N m", "N"], "y": "rad/s", "kappa": ""},
    )


@pytest.fixture(scope="module")
def measured(oscillator) -> IOData:
    """Two records of the oscillator, from rest, without noise."""
    rng = np.random.default_rng(1)
    u = [rng.normal(size=(30, 1)), rng.normal(size=(20, 1))]
    y = [np.asarray(oscillator.simulate(u=part, dt=0.01)) for part in u]
    return IOData(u=u, y=y, dt=0.01)


def test_records_show_every_channel(data):
    panels = records(data)
    assert panels.shape == (4,)
    signals = [data.u[:, 0], data.u[:, 1], data.y[:, 0], data.kappa[:, 0]]
    titles = ["input torque", "input force", "output rate", "scheduling load"]
    for panel, signal, title, unit in zip(
        panels, signals, titles, ["N m", "N", "rad/s", ""], strict=True
    ):
        (line,) = panel.lines
        np.testing.assert_allclose(line.get_xdata(), 0.1 * np.arange(40))
        np.testing.assert_array_equal(line.get_ydata(), signal)
        assert panel.get_title(loc="left") == title
        assert panel.get_ylabel() == unit
    assert panels[-1].get_xlabel() == "time (s)"


def test_records_without_scheduling_and_broken_between_records(measured):
    panels = records(measured)
    assert panels.shape == (2,)
    values = panels[1].lines[0].get_ydata()
    assert np.isnan(values[30])
    np.testing.assert_array_equal(np.delete(values, 30), measured.y[:, 0])
    assert len(panels[1].lines) == 2  # the signal and the mark between the records
    assert panels[1].lines[1].get_xdata()[0] == pytest.approx(0.01 * 29.5)


def test_compare_simulates_record_by_record(measured, oscillator):
    half = 0.5 * np.asarray(measured.y)
    panels = compare(measured, {"truth": oscillator, "half": half})
    assert panels.shape == (1, 2)
    main, rest = panels[0]
    truth = np.delete(main.lines[1].get_ydata(), 30)
    np.testing.assert_allclose(truth, measured.y[:, 0], atol=1e-12)
    np.testing.assert_allclose(
        np.delete(rest.lines[1].get_ydata(), 30), measured.y[:, 0] - half[:, 0]
    )
    y = np.asarray(measured.y[:, 0])
    score = 100 * (1 - np.linalg.norm(y - half[:, 0]) / np.linalg.norm(y - y.mean()))
    texts = [text.get_text() for text in main.get_legend().get_texts()]
    assert texts == ["measured", "truth: BFT 100.00 %", f"half: BFT {score:.2f} %"]
    assert rest.get_ylabel() == "residual"


def test_compare_takes_lpv_models_along_the_scheduling(lpv):
    rng = np.random.default_rng(2)
    u, kappa = rng.normal(size=(50, 1)), np.linspace(0.0, 2.0, 50)
    y = lpv.simulate(u=u, kappa=kappa, dt=0.01)
    panels = compare(IOData(u=u, y=y, dt=0.01, kappa=kappa), lpv, "LPV")
    np.testing.assert_allclose(panels[0, 1].lines[0].get_ydata(), 0.0, atol=1e-12)
    with pytest.raises(ValueError, match="needs the scheduling"):
        compare(IOData(u=u, y=y, dt=0.01), lpv)


def test_compare_names_an_output_of_the_wrong_shape(measured):
    with pytest.raises(ValueError, match=r"'model' has outputs of shape \(7, 1\)"):
        compare(measured, np.zeros(7))
