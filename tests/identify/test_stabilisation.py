"""The stabilisation diagram: known modes in columns, the fit of one order as the oracle."""

import numpy as np
import pytest

from lpvid.data import IOData
from lpvid.identify import N4SID, PastOutputMOESP, identify, stabilisation

from .helpers import common_problem, three_modes

MODES = 2.0 * np.pi * np.array([2.0, 5.0, 11.0])
DAMPINGS = np.array([0.02, 0.015, 0.01])


@pytest.fixture(scope="module")
def data():
    u, _, y = common_problem(2000, seed=21)
    return IOData(u=u, y=y, dt=1 / 50)


@pytest.fixture(scope="module")
def diagram(data):
    return stabilisation(data, PastOutputMOESP(block_rows=12), orders=[4, 6, 8, 10, 12])


def test_an_order_is_that_of_its_own_fit(data, diagram):
    fit = identify(data, PastOutputMOESP(order=6, block_rows=12))
    poles = np.asarray(fit.model.poles())
    s = np.log(poles[poles.imag > 0]) * 50
    s = s[np.argsort(np.abs(s))]
    row = diagram.orders.index(6)
    np.testing.assert_allclose(diagram.frequency[row, :3], np.abs(s), rtol=1e-7)
    np.testing.assert_allclose(diagram.damping[row, :3], -s.real / np.abs(s), rtol=1e-5)
    assert np.all(np.isnan(diagram.frequency[row, 3:]))
    np.testing.assert_allclose(diagram.singular_values, fit.singular_values, rtol=1e-6)


def test_the_modes_are_columns_and_nothing_else_is(diagram):
    stable = np.asarray(diagram.stable)
    frequency, damping = np.asarray(diagram.frequency), np.asarray(diagram.damping)
    for mode, ratio in zip(MODES, DAMPINGS, strict=True):
        for row in range(2, 5):
            near = np.abs(frequency[row] / mode - 1.0) < 0.01
            assert np.sum(near & stable[row]) == 1
            np.testing.assert_allclose(damping[row][near & stable[row]], ratio, rtol=0.15)
    # The first order has none before it.
    assert not np.any(diagram.frequency_stable[0])
    far = np.all(np.abs(frequency[..., None] / MODES - 1.0) > 0.01, axis=-1)
    assert not np.any(np.all((stable & far)[1:].reshape(4, -1), axis=0))


def test_shapes_are_those_of_the_system(diagram):
    A, _, C, _ = three_modes()
    poles, vectors = np.linalg.eig(A)
    for index in np.flatnonzero(poles.imag > 0):
        truth = C @ vectors[:, index]
        size = np.abs(np.log(poles[index])) * 50
        column = int(np.nanargmin(np.abs(np.asarray(diagram.frequency[1]) - size)))
        found = np.asarray(diagram.shapes[1, column])
        assert np.max(np.abs(found)) == pytest.approx(1.0)
        mac = np.abs(truth.conj() @ found) ** 2 / np.sum(np.abs(truth) ** 2)
        assert mac / np.sum(np.abs(found) ** 2) > 0.999


def test_the_spectrum_is_a_density_of_unit_variance(diagram):
    omega, density = np.asarray(diagram.spectrum_omega), np.asarray(diagram.spectrum)
    # Welch's lines start above zero; the mean square of each output is one.
    step = (omega[1] - omega[0]) / (2 * np.pi)
    assert np.sum(density) * step == pytest.approx(1.0, rel=0.25)
    assert omega[-1] == pytest.approx(np.pi * 50)


def test_defaults_other_methods_and_several_records(data):
    split = IOData(u=[data.u[:900], data.u[900:]], y=[data.y[:900], data.y[900:]], dt=data.dt)
    found = stabilisation(split, N4SID(), orders=[6, 8])
    near = np.abs(np.asarray(found.frequency)[1, :, None] / MODES[None] - 1.0) < 0.01
    assert np.all(np.any(near & np.asarray(found.stable)[1][:, None], axis=0))


def test_faults_are_named(data):
    with pytest.raises(ValueError, match="rising"):
        stabilisation(data, orders=[4, 4])
    with pytest.raises(ValueError, match="orders: 30 is more than block_rows=10 carries"):
        stabilisation(data, PastOutputMOESP(block_rows=10), orders=[2, 30])
    with pytest.raises(ValueError, match="samples"):
        stabilisation(data[:100], PastOutputMOESP(block_rows=30), orders=[2])
