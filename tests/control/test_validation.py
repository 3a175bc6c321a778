"""The two validations of 002, against what is known without simulating."""

import numpy as np
import pytest
import scipy.signal

from lpvid.control import data_matching, set_point_following, simulate_closed_loop
from lpvid.data import IOData
from lpvid.mechanics import ProportionalDerivative
from lpvid.models import StateSpace

DT = 0.05
# Angle and speed of a motor.
MOTOR = StateSpace([[1.0, DT], [0.0, 0.9]], [[0.0], [0.1]], np.eye(2), dt=DT)


@pytest.fixture(scope="module")
def data():
    u = np.random.default_rng(0).standard_normal(80)
    y = scipy.signal.dlsim(tuple(np.asarray(getattr(MOTOR, n)) for n in "ABCD") + (DT,), u)[1]
    return IOData(u=u, y=y, dt=DT, names={"y": ("angle", "speed")})


class _Result:
    """What a fit looks like."""

    def __init__(self, model, x0, output_offset=None):
        self.model, self.x0, self.output_offset = model, x0, output_offset


def test_data_matching_is_the_error_of_the_whole_record(data):
    low = StateSpace(MOTOR.A, 0.5 * MOTOR.B, MOTOR.C, dt=DT)
    seen = []

    def learned(known):
        seen.append(known.n_samples)
        return _Result(MOTOR, np.zeros((1, 2)), np.array([0.1, 0.0]))

    rest = np.zeros((1, 2))
    models = {"half": _Result(low, rest), "true": _Result(MOTOR, rest), "learned": learned}
    found = data_matching(models, data, fraction=0.25)
    assert seen == [20] and found.identified == (20,)
    rms = np.sqrt(np.mean(np.asarray(data.y)[:, 0] ** 2))
    expected = [[0.5, 0.5], [0.0, 0.0], [0.1 / rms, 0.0]]
    np.testing.assert_allclose(found.relative_error, expected, atol=1e-9)
    np.testing.assert_allclose(found.mean, np.mean(expected, axis=1), atol=1e-9)
    header, first, *_ = str(found).splitlines()
    assert header.split() == ["δ,", "data", "matching", "angle", "speed", "mean"]
    assert first.split() == ["half", "0.5000", "0.5000", "0.5000"]
    assert found.rows()[2]["speed"] == pytest.approx(0.0, abs=1e-9)


def test_set_points_are_followed_under_the_controller_of_002():
    """The loop by hand: u = 0.5 (R − y1) − 1.4 y2 is a state feedback."""
    reference = np.where(np.arange(60) < 30, 1.0, -1.0)
    gains = np.array([0.5, 1.4])
    loop = np.asarray(MOTOR.A) - np.asarray(MOTOR.B) @ gains[None]
    states = scipy.signal.dlsim(
        (loop, 0.5 * np.asarray(MOTOR.B), np.eye(2), np.zeros((2, 1)), DT), reference
    )[1]
    pd = ProportionalDerivative(*gains)
    motion = simulate_closed_loop(MOTOR, pd, reference=reference)
    models = {"motor": MOTOR, "simulated": motion, "nothing": np.zeros((60, 2))}
    for plant, options in (
        (motion, {}),
        (IOData(u=np.zeros(60), y=states, dt=DT), {"reference": reference}),
    ):
        found = set_point_following(models, plant, **options)
        np.testing.assert_allclose(found.relative_error, [[0, 0], [0, 0], [1, 1]], atol=1e-12)
    other = set_point_following(MOTOR, motion, ProportionalDerivative(0.4, 1.4))
    assert np.all(other.relative_error > 0.01) and other.labels == ("model",)


def test_faults_are_named(data):
    with pytest.raises(ValueError, match="reference"):
        set_point_following(MOTOR, data)
    with pytest.raises(ValueError, match="80 samples"):
        set_point_following(MOTOR, data, reference=np.ones(3))
    with pytest.raises(ValueError, match="offset"):
        set_point_following(_Result(MOTOR, None, np.ones(2)), data, reference=np.ones(80))
    with pytest.raises(ValueError, match="'model' has outputs"):
        set_point_following(np.zeros((4, 2)), data, reference=np.ones(80))
    with pytest.raises(ValueError, match="one at a time"):
        twice = IOData(u=[data.u, data.u], y=[data.y, data.y], dt=DT)
        set_point_following(MOTOR, twice, reference=np.ones(160))
    with pytest.raises(ValueError, match="none given"):
        data_matching({}, data)
    with pytest.raises(ValueError, match="data.select"):
        other = StateSpace(MOTOR.A, MOTOR.B, MOTOR.C[:1], dt=DT)
        data_matching(_Result(other, np.zeros((1, 2))), data)
