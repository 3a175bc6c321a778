"""A constant in the outputs, estimated with the model."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpvid.data import IOData
from lpvid.identify import PastOutputMOESP, identify, simulation_fit
from lpvid.identify._linear_fit import covariance

from .helpers import common_problem, markov, prbs, respond, sorted_poles, three_modes
from .test_simulation_error import recorded, regressors

DT = 1 / 50


AUTOMATIC = PastOutputMOESP(block_rows=8)
WITH_OFFSET = PastOutputMOESP(block_rows=8, offset=True)


def test_offsets_come_out_without_a_spurious_state():
    """By reflections, since there is no noise; two records, inputs with a mean."""
    system, offset = three_modes(), np.array([5.0, -300.0])
    inputs = [prbs(500, 2, 1) + [0.3, 10.0], prbs(400, 2, 2)]
    outputs = [respond(system, u) + offset for u in inputs]
    method = PastOutputMOESP(order=6, block_rows=8, offset=True)
    fit = identify(IOData(u=inputs, y=outputs, dt=DT), method)
    assert bool(fit.stats["reflections"])
    assert "Householder" in fit.route and fit.route in fit.describe()
    np.testing.assert_allclose(fit.output_offset, offset, rtol=1e-8)
    np.testing.assert_allclose(sorted_poles(fit.model.A), sorted_poles(system[0]), atol=1e-7)
    found = fit.model.A, fit.model.B, fit.model.C, fit.model.D
    np.testing.assert_allclose(markov(found, 20), markov(system, 20), atol=1e-6)


@pytest.mark.slow
def test_centred_short_records_keep_their_order():
    u, clean, y = common_problem(400, seed=5)
    # The mean of the record is not that of the noise-free response to inputs without mean.
    data = IOData(u=u, y=y - y.mean(axis=0) + 30.0, dt=DT)
    with_offset = identify(data, WITH_OFFSET)
    assert with_offset.order == 6
    assert "Gram" in with_offset.route
    truth = 30.0 - y.mean(axis=0)
    deviation = np.abs(np.asarray(with_offset.output_offset) - truth)
    assert np.all(deviation < 4.0 * np.asarray(with_offset.standard_deviations.output_offset))
    # The same records taken for ones without an offset.
    plain = identify(data, AUTOMATIC)
    assert plain.order == 7
    assert np.abs(sorted_poles(plain.model.A) - 1.0).min() < 1e-3
    np.testing.assert_array_equal(plain.output_offset, 0.0)
    np.testing.assert_array_equal(plain.standard_deviations.output_offset, 0.0)
    assert plain.covariance.shape == (18, 18)
    # A fit brings its offset along, a model does not.
    whole = simulation_fit(with_offset, data)
    assert np.all(whole > 95.0)
    assert np.all(simulation_fit(with_offset.model, data) < whole - 20.0)
    residual = np.std(clean - y, axis=0)
    np.testing.assert_allclose(with_offset.stats["residual_std"], residual, rtol=0.2)


def test_covariance_is_that_of_least_squares():
    """(ΦᵀΦ)⁻¹ Φᵀ Σ Φ (ΦᵀΦ)⁻¹ with the regressors formed, records of their own x0."""
    A, _, C, _ = three_modes()
    lengths, variance = (60, 41), np.array([0.3, 2.0])
    rng = np.random.default_rng(3)
    u, y = rng.standard_normal((2, 101, 2))
    used = np.c_[u, np.ones(101)]
    equations = recorded(*(jnp.asarray(x) for x in (A, C, used, y)), lengths=lengths)
    settings = dict(nx=6, feedthrough=True, offset=True)
    found = jax.jit(lambda m, v: covariance(m, v, **settings))(
        equations.matrix, jnp.asarray(variance)
    )
    shared = 12 + 4 + 2
    blocks, weights, start = [], [], 0
    for record, length in enumerate(lengths):
        part = u[start : start + length]
        start += length
        for k, phi in enumerate(regressors(A, C, part)):
            block = np.zeros((length, shared + 12))
            block[:, :12] = phi[:, :12]
            block[:, 12 + 2 * k : 14 + 2 * k] = part
            block[:, 16 + k] = 1.0
            block[:, shared + 6 * record : shared + 6 * record + 6] = phi[:, 12:]
            blocks.append(block)
            weights.append(np.full(length, variance[k]))
    phi, weight = np.concatenate(blocks), np.concatenate(weights)
    bread = np.linalg.inv(phi.T @ phi)
    truth = bread @ (phi.T * weight) @ phi @ bread
    np.testing.assert_allclose(found.shared, truth[:shared, :shared], rtol=1e-6, atol=1e-9)
    for record in range(2):
        part = slice(shared + 6 * record, shared + 6 * record + 6)
        np.testing.assert_allclose(found.x0[record], truth[part, part], rtol=1e-6, atol=1e-9)


def test_standard_deviations_have_the_units_of_their_matrices():
    u, _, y = common_problem(400)
    gains = np.array([1e-6, 1e3]), np.array([1e5, 1e-4])
    one = identify(IOData(u=u, y=y, dt=DT), WITH_OFFSET)
    two = identify(IOData(u=u * gains[0], y=y * gains[1], dt=DT), WITH_OFFSET)
    assert one.order == two.order == 6
    a, b = (jax.tree.map(np.asarray, fit.standard_deviations) for fit in (one, two))
    np.testing.assert_allclose(b.D, a.D * gains[1][:, None] / gains[0], rtol=1e-6)
    np.testing.assert_allclose(b.output_offset, a.output_offset * gains[1], rtol=1e-6)
    np.testing.assert_allclose(b.B, a.B / gains[0], rtol=1e-6)
    np.testing.assert_allclose(np.diag(one.covariance)[-2:], a.output_offset**2)
    # The truth lies within four of them, and they are not idle.
    assert np.all(np.abs(np.asarray(one.model.D) - three_modes()[3]) < 4.0 * a.D)
    assert np.all(a.D < 0.1) and np.all(a.x0 > 0.0)
