"""Models at hand as bases: the same dynamics, their own parameters, clear words where not."""

import jax.numpy as jnp
import numpy as np
import pytest

from lpvid.data import IOData
from lpvid.loop.structures import PortedModel
from lpvid.models import (
    GrayBoxLPV,
    LPVStateSpace,
    ModalStructure,
    StateSpace,
    StructuredModel,
    polynomial_basis,
)

OMEGA = np.geomspace(0.1, 100.0, 20)


def _data(nu=1, ny=1, nk=0, dt=0.01):
    kappa = np.zeros((9, nk)) if nk else None
    return IOData(u=np.zeros((9, nu)), y=np.zeros((9, ny)), dt=dt, kappa=kappa)


def _response(structure, kappa=()):
    ports = structure.ports(jnp.asarray(structure.nominal), jnp.asarray(kappa, float))
    np.testing.assert_allclose(ports.velocity, ports.C @ ports.A)
    return np.asarray(StateSpace(ports.A, ports.B, ports.C, ports.D).frequency_response(OMEGA))


@pytest.mark.parametrize("feedthrough", [0.0, 0.3])
@pytest.mark.parametrize("discrete", [False, True])
def test_a_black_box_keeps_its_response(feedthrough, discrete):
    rng = np.random.default_rng(5)
    # A pair of poles and a real one, two inputs, two outputs.
    A = np.array([[-1.0, 8.0, 0.5], [-8.0, -1.0, 0.2], [0.0, 0.0, -3.0]])
    B, C = rng.standard_normal((3, 2)), rng.standard_normal((2, 3))
    model = StateSpace(A, B, C, feedthrough * rng.standard_normal((2, 2)))
    given = model.discretise(0.01) if discrete else model
    structure = PortedModel(given, _data(2, 2))
    expected = np.asarray(model.frequency_response(OMEGA))
    np.testing.assert_allclose(_response(structure), expected, rtol=1e-8, atol=1e-10)
    # No more parameters than a transfer matrix of this order has.
    assert len(structure.nominal) == 3 * (2 + 2) + (4 if feedthrough else 0)
    assert len(structure.parameter_names) == len(structure.nominal)


def test_lpv_and_structured_models_keep_theirs():
    structure = ModalStructure(n_modes=1, n_inputs=1, n_outputs=1)
    coefficients = jnp.array([[4.0, np.log(0.05), 1.0, 2.0], [1.0, 0.0, 0.0, 0.5]])
    basis = polynomial_basis(np.array([[0.0], [2.0]]), 1)
    lpv = LPVStateSpace(structure, basis, coefficients, jnp.array([0.0]), jnp.array([2.0]))
    ported = PortedModel(lpv, _data(nk=1))
    expected = np.asarray(lpv.at(0.7).frequency_response(OMEGA))
    np.testing.assert_allclose(_response(ported, [0.7]), expected)
    fixed = PortedModel(StructuredModel(structure, coefficients[0]), _data())
    expected = np.asarray(structure.matrices(coefficients[0]).frequency_response(OMEGA))
    np.testing.assert_allclose(_response(fixed), expected)
    assert fixed.parameter_names == structure.parameter_names

    def spring(p, kappa):
        return StateSpace(
            jnp.array([[0.0, 1.0], [-p[0] * (1.0 + kappa[0]), -p[1]]]),
            jnp.eye(2)[:, 1:],
            jnp.eye(2)[:1],
        )

    gray = GrayBoxLPV(spring, [9.0, 0.5], ["stiffness", "damping"], kappa_low=0.0, kappa_high=1.0)
    ported = PortedModel(gray, _data(nk=1))
    np.testing.assert_array_equal(ported.nominal, [9.0, 0.5])
    expected = np.asarray(gray.at(0.5).frequency_response(OMEGA))
    np.testing.assert_allclose(_response(ported, [0.5]), expected)


def test_faults_are_named():
    lag = StateSpace([[-1.0]], [[1.0]], [[1.0]])
    with pytest.raises(ValueError, match="needs 1 output, the data has 2"):
        PortedModel(lag, _data(ny=2))
    with pytest.raises(ValueError, match="a list is no linear model"):
        PortedModel([1.0], _data())
    still = StateSpace(np.diag([-1.0, -2.0]), [[1.0], [0.0]], [[1.0, 1.0]])
    with pytest.raises(ValueError, match="balanced_truncation"):
        PortedModel(still, _data())
