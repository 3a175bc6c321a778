"""LPV and nonlinear models, and searches over pieces of a record."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from lpvid._results import Status
from lpvid.data import IOData
from lpvid.models import (
    FunctionStructure,
    LPVStateSpace,
    StateSpace,
    StructuredModel,
    polynomial_basis,
)
from lpvid.refinement import Innovation, OutputError, refine

from .plants import DT, inputs

pytestmark = pytest.mark.slow


class Pendulum(eqx.Module):
    """θ̈ = −(g/ℓ) sin θ − damping θ̇ + gain u, by semi-implicit Euler steps."""

    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    gain: Float[Array, ""]
    n_states: int = eqx.field(static=True, default=2)

    def simulate(self, *, u, dt, x0):
        def step(x, u):
            rate = x[1] + dt * (
                self.gain * u[0] - self.stiffness * jnp.sin(x[0]) - self.damping * x[1]
            )
            return jnp.stack([x[0] + dt * rate, rate]), x[:1]

        return jax.lax.scan(step, x0, u)[1]


def pendulum(values):
    return Pendulum(*(jnp.asarray(float(v)) for v in values))


def test_a_nonlinear_pendulum():
    truth, n = (9.0, 0.5, 4.0), 400
    u = 0.5 * np.sin(np.arange(n) * 0.05)[:, None] + 0.5 * inputs(n)
    states = ([1.5, 0.0], [-0.5, 1.0])
    rng = np.random.default_rng(0)
    ys = [
        np.asarray(pendulum(truth).simulate(u=jnp.asarray(u), dt=0.05, x0=jnp.asarray(x0)))
        + 0.02 * rng.standard_normal((n, 1))
        for x0 in states
    ]
    data = IOData(u=[u, u], y=ys, dt=0.05)
    fit = refine(pendulum((8.0, 0.8, 3.0)), data, predictor=OutputError(shooting=50))
    assert fit.status == Status.successful
    assert fit.parameter_names == ("stiffness", "damping", "gain")
    assert np.max(np.abs(fit.parameters - np.array(truth)) / fit.standard_errors) < 4.0
    assert np.max(np.abs(fit.x0 - np.array(states))) < 0.05
    np.testing.assert_allclose(fit.noise_covariance.item(), 0.02**2, rtol=0.2)
    assert isinstance(fit.model, Pendulum) and fit.model.gain == fit.parameters[2]
    # As refined, the model in time steps says the same as a fit from the truth.
    other = refine(pendulum(truth), data)
    assert np.max(np.abs(fit.parameters - other.parameters) / fit.standard_errors) < 1e-3
    with pytest.raises(ValueError, match="Innovation"):
        refine(pendulum(truth), data, predictor=Innovation())


def test_an_lpv_model_along_its_schedule():
    structure = FunctionStructure(
        lambda p: (jnp.array([[0.0, 1.0], [-p[0], -p[1]]]), jnp.eye(2)[:, 1:], jnp.eye(2)[:1]),
        nominal=[4.0, 0.5],
        names=("stiffness", "damping"),
    )
    basis = polynomial_basis([0.0, 1.0], 1)
    coefficients = jnp.array([[4.0, 0.5], [1.5, 0.2]])
    truth = LPVStateSpace(structure, basis, coefficients, jnp.zeros(1), jnp.ones(1))
    n = 300
    u, kappa = inputs(n, seed=3), 0.5 - 0.5 * np.cos(np.arange(n) * 0.05)
    clean = np.asarray(truth.simulate(u=u, kappa=kappa, dt=DT, x0=[0.3, 0.0]))
    y = clean + 0.02 * np.random.default_rng(1).standard_normal(clean.shape)
    data = IOData(u=u, y=y, dt=DT, kappa=kappa)
    start = eqx.tree_at(lambda m: m.coefficients, truth, 0.9 * coefficients)
    fit = refine(start, data)
    assert fit.status == Status.successful
    assert fit.parameter_names[1] == "coefficients[0,1]"
    missed = np.abs(fit.parameters - np.asarray(coefficients).reshape(-1)) / fit.standard_errors
    assert np.max(missed) < 4.0
    with pytest.raises(ValueError, match="kappa"):
        refine(start, IOData(u=u, y=y, dt=DT))


def test_shooting_reaches_what_a_poor_start_cannot():
    """An unstable plant, 1.02⁴⁰⁰ = 2750, from a start whose simulation overflows."""
    rng = np.random.default_rng(2)

    def toppling(p):
        A, B = jnp.array([[0.0, 1.0], [p[0], p[1]]]), jnp.array([[0.0], [1.0]]) * p[2]
        return A, B, jnp.eye(2)[:1]

    structure = FunctionStructure(
        toppling,
        nominal=[0.04, -0.1, 1.0],
        names=("toppling", "damping", "gain"),
    )
    truth, n = np.array([0.04, -0.1, 1.0]), 400
    u = inputs(n, seed=4)
    clean = np.asarray(structure.matrices(jnp.asarray(truth)).simulate(u=u, dt=DT))
    data = IOData(u=u, y=clean + 0.05 * rng.standard_normal(clean.shape), dt=DT)
    start = StructuredModel(structure, [4.0, 0.0, 0.5])
    with pytest.warns(UserWarning, match="refine: "):
        failed = refine(start, data, throw=False)
    assert failed.status != Status.successful
    fit = refine(start, data, predictor=OutputError(shooting=20))
    assert fit.status == Status.successful
    assert np.max(np.abs(fit.parameters - truth) / fit.standard_errors) < 4.0


def test_a_module_without_numbers():
    class Nothing(eqx.Module):
        def simulate(self, *, u, dt):
            del dt
            return u

    data = IOData(u=inputs(20), y=inputs(20), dt=DT)
    with pytest.raises(ValueError, match="nothing to estimate"):
        refine(Nothing(), data)
    assert isinstance(StateSpace([[0.5]], [[1.0]], [[1.0]], dt=DT), eqx.Module)
