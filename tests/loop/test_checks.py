"""What is refused before any work, and in which words."""

from types import SimpleNamespace

import numpy as np
import pytest

from lpvid.data import IOData
from lpvid.loop import _engine, close_the_loop, structure_named

SAMPLES = 300
RNG = np.random.default_rng(0)


def _data(samples=SAMPLES, nu=1, ny=1, dt=0.01, **more):
    u, y = RNG.standard_normal((samples, nu)), RNG.standard_normal((samples, ny))
    return IOData(u=u, y=y, dt=dt, **more)


DATA = _data()
SERVO = structure_named("servo", DATA)


@pytest.mark.parametrize(
    ("data", "options", "words"),
    [
        (_data(120), {}, "80 samples to estimate and 40 to decide are too short.*100 and 50"),
        (DATA, {"split": 0.25}, "75 samples to estimate"),
        (DATA, {"split": 0.95}, "split=0.95 must lie between 0.2 and 0.9"),
        (DATA, {"test": _data(40)}, "40 to decide"),
        (DATA, {"test": _data(dt=0.02)}, "test has a sample time of 0.02 s and data one of 0.01"),
        (DATA, {"test": _data(kappa=0.5)}, "data and test need a scheduling signal"),
        (DATA, {"horizon": 0}, "horizon=0 must be a number of samples"),
        (DATA, {"horizon": 60}, "horizon=60 is more than half of a held-out record of 100"),
        (DATA, {"test": _data(ny=2)}, "test has 1 inputs and 2 outputs; the structure 'servo'"),
        (_data(nu=2), {}, "data has 2 inputs and 1 outputs; the structure 'servo' has 1 and 1"),
        (DATA.replace(u=np.ones(SAMPLES)), {}, "input 'u1' is constant.*or excite it"),
        (DATA.replace(y=np.zeros(SAMPLES)), {}, "output 'y1' is constant"),
        (DATA, {"most_effects": 4}, "most_effects=4 must be 1 to 3"),
        (DATA, {"hold": "cubic"}, "hold='cubic' is not known"),
        (_data(kappa=RNG.uniform(size=(SAMPLES, 2))), {}, "2 scheduling signals"),
    ],
)
def test_faults_are_named(data, options, words):
    with pytest.raises(ValueError, match=words):
        close_the_loop(SERVO, data, **options)


def test_signals_are_looked_at_before_a_structure_is_made_of_them():
    with pytest.raises(ValueError, match="input 'u1' is constant"):
        close_the_loop("servo", DATA.replace(u=np.ones(SAMPLES)))


def test_a_fit_that_is_no_number_is_said(monkeypatch):
    monkeypatch.setattr(_engine, "fit", lambda *_, **__: _Unfitted())
    with pytest.raises(ValueError, match="'servo' cannot be fitted to these records"):
        close_the_loop(SERVO, DATA)


class _Unfitted:
    searched = SimpleNamespace(log_likelihood=-np.inf)


def test_samples_that_are_no_numbers_never_get_that_far():
    holes = np.zeros(SAMPLES)
    holes[7] = np.nan
    with pytest.raises(ValueError, match="finite"):
        DATA.replace(y=holes)


def test_an_unknown_structure_is_answered_with_the_known_ones():
    with pytest.raises(ValueError, match="'robot' is not known: give one of black-box, servo"):
        structure_named("robot", DATA)


def test_a_name_that_is_no_structure_is_told_the_others():
    with pytest.raises(ValueError, match="structure 'server' is not known: give one of black-box"):
        close_the_loop("server", DATA)
