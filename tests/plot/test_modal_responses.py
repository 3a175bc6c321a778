import numpy as np
import pytest

from lpvid.control import data_matching
from lpvid.data import IOData
from lpvid.models import StateSpace
from lpvid.plot import modal_reduction, modal_responses, validation
from lpvid.reduce import modal_responses as responses_of
from lpvid.reduce import modal_truncation

A = [[0.9, 0.3, 0.0], [-0.3, 0.9, 0.0], [0.0, 0.0, 0.5]]
MODEL = StateSpace(A, [[0.1], [0.0], [1.0]], [[1.0, 0.0, 1.0]], dt=0.1)


@pytest.fixture(scope="module")
def data():
    u = np.random.default_rng(0).standard_normal(60)
    y = np.asarray(responses_of(MODEL, IOData(u=u, y=u, dt=0.1))).sum(axis=0)
    return IOData(u=u, y=y, dt=0.1, names={"y": "angle"}, units={"y": "V"})


def test_the_strongest_modes_are_drawn_and_the_others_summed(data):
    found = np.asarray(responses_of(MODEL, data))
    (panel,) = modal_responses(MODEL, data, most=1)
    lines = {line.get_label(): line.get_ydata() for line in panel.lines}
    assert list(lines) == ["record", "3: 1.1 Hz, real", "the other 1"]
    np.testing.assert_allclose(lines["3: 1.1 Hz, real"], found[1, :, 0])
    np.testing.assert_allclose(lines["the other 1"], found[0, :, 0])
    assert panel.get_ylabel() == "angle (V)"
    with pytest.raises(ValueError, match="most=0"):
        modal_responses(MODEL, data, most=0)


def test_a_reduction_shows_what_is_kept_and_what_is_lost(data):
    reduction = modal_truncation(MODEL, 1, data=data)
    mrm, msv, gains = modal_reduction(reduction)
    shown = {line.get_label(): line for line in mrm.lines}
    assert set(shown) == {"pair, left out", "real, kept"}
    np.testing.assert_allclose(
        shown["real, kept"].get_ydata(), reduction.table.response_magnitude[1]
    )
    assert msv.get_ylabel() == "MSV"
    lines = {line.get_label(): line for line in gains.lines}
    # At the highest frequency z = −1.
    whole, lost = (
        float(np.abs(lines[name].get_ydata()[-1])) for name in ("all modes", "difference")
    )
    pole = 0.9 + 0.3j
    pair = np.real(0.1 / (-1.0 - pole))
    assert lost == pytest.approx(abs(pair))
    assert whole == pytest.approx(abs(pair + 1.0 / -1.5))


def test_a_validation_shows_plant_models_and_the_part_known(data):
    reduced = modal_truncation(MODEL, 1, data=data)
    found = data_matching({"half": lambda known: reduced}, data)
    (panel,) = validation(found)
    plant, model = panel.lines
    np.testing.assert_allclose(plant.get_ydata(), data.y[:, 0])
    np.testing.assert_allclose(model.get_ydata(), found.outputs[0, :, 0])
    assert model.get_label() == f"half: δ = {float(found.relative_error[0, 0]):.3f}"
    assert panel.patches[0].get_width() == pytest.approx(3.0)
