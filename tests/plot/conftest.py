"""Figures are closed after each test; systems with known poles and responses."""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

from lpvid.models import LPVStateSpace, ModalStructure, StateSpace, polynomial_basis


@pytest.fixture(autouse=True)
def close_figures():
    yield
    plt.close("all")


@pytest.fixture(scope="session")
def oscillator() -> StateSpace:
    """Poles at 2π·5 rad/s with damping 0.1; one input, one output, gain 1 at rest."""
    frequency, damping = 2 * np.pi * 5.0, 0.1
    A = [[0.0, frequency], [-frequency, -2 * damping * frequency]]
    return StateSpace(A, [[0.0], [1.0]], [[frequency, 0.0]])


@pytest.fixture(scope="session")
def lpv() -> LPVStateSpace:
    """One mode whose logarithmic frequency is 3 + κ and damping ratio 0.05, for κ in [0, 2]."""
    structure = ModalStructure(n_modes=1, n_inputs=1, n_outputs=1)
    basis = polynomial_basis(np.array([[0.0], [2.0]]), 1)
    coefficients = jnp.array([[4.0, np.log(0.05), 1.0, 2.0], [1.0, 0.0, 0.0, 0.5]])
    return LPVStateSpace(structure, basis, coefficients, jnp.array([0.0]), jnp.array([2.0]))
