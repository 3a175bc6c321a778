"""Exchange with python-control and SciPy."""

import builtins

import control
import jax
import numpy as np
import pytest
from scipy import signal

from lpvid.models import from_control, from_scipy, to_control, to_scipy

from .systems import batch, flexible, matrices


@pytest.mark.parametrize("there_and_back", [(to_control, from_control), (to_scipy, from_scipy)])
@pytest.mark.parametrize("dt", [0.0, 0.02])
def test_round_trip(there_and_back, dt):
    there, back = there_and_back
    system = flexible().discretise(dt) if dt else flexible()
    returned = back(there(system))
    assert returned.dt == dt
    for mine, theirs in zip(matrices(returned), matrices(system), strict=True):
        np.testing.assert_array_equal(mine, theirs)


def test_transfer_functions_are_realised():
    omega = np.array([0.5, 2.0])
    expected = 2.0 / (1j * omega + 1.0)
    for system in (
        from_scipy(signal.TransferFunction([2.0], [1.0, 1.0])),
        from_control(control.tf([2.0], [1.0, 1.0])),
    ):
        np.testing.assert_allclose(system.frequency_response(omega)[:, 0, 0], expected)


def test_a_batch_becomes_a_list():
    systems = batch(2, dt=0.02)
    for index, theirs in enumerate(to_control(systems)):
        assert theirs.dt == 0.02
        np.testing.assert_array_equal(theirs.A, systems.A[index])
        np.testing.assert_array_equal(theirs.D, systems.D[index])


def test_faults_are_named(monkeypatch):
    with pytest.raises(ValueError, match="batch axes"):
        to_scipy(batch(2))
    with pytest.raises(ValueError, match="traced"):
        jax.jit(lambda s: s.A + to_scipy(s).A)(flexible())
    with pytest.raises(ValueError, match="dt is True"):
        from_control(control.ss(0.5, 1.0, 1.0, 0.0, True))
    with pytest.raises(ValueError, match="dt is True"):
        from_scipy(signal.dlti([1.0], [1.0, 0.5]))

    genuine = builtins.__import__

    def without_control(name, *arguments, **options):
        if name == "control":
            raise ImportError(name)
        return genuine(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", without_control)
    with pytest.raises(ImportError, match="pip install control"):
        to_control(flexible())
