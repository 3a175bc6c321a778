"""Weights of the one subspace method, and the noise model they give."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import block_diag, subspace_angles
from scipy.signal import dlsim

from lpvid._results import Status
from lpvid.data import IOData
from lpvid.identify import CVA, N4SID, ORSE, PastOutputMOESP, identify
from lpvid.identify._factor import Layout, factor_of_triangle
from lpvid.models import StateSpace

from .helpers import (
    common_problem,
    markov,
    prbs,
    respond,
    slicot_moen4,
    sorted_poles,
    three_modes,
)

DT = 1 / 50
WITH_NOISE_MODEL = [PastOutputMOESP, N4SID, CVA]
COVARIANCE = np.array([[0.04, 0.01], [0.01, 0.09]])


def innovations_system():
    """A, B, C, D and K with the poles of A − K C at 0.62 and 0.31 in modulus."""
    A = block_diag([[0.8, 0.4], [-0.4, 0.8]], [[0.5]])
    B = np.array([[1.0, 0.2], [0.3, -1.0], [0.5, 0.7]])
    C = np.array([[1.0, 0.0, 0.6], [0.2, 0.9, -0.4]])
    K = np.array([[0.5, 0.1], [-0.2, 0.4], [0.1, -0.3]])
    return A, B, C, np.array([[0.1, 0.0], [0.0, 0.3]]), K


@functools.cache
def innovations_data(n=20_000, seed=11):
    A, B, C, D, K = innovations_system()
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((n, 2))
    e = rng.standard_normal((n, 2)) @ np.linalg.cholesky(COVARIANCE).T
    y = dlsim((A, np.c_[B, K], C, np.c_[D, np.eye(2)], 1.0), np.c_[u, e])[1]
    return u, y


def noise_markov(A, K, C):
    """C A^i K: what of the gain does not depend on the basis."""
    A, K, C = (np.asarray(m) for m in (A, K, C))
    return np.stack([C @ np.linalg.matrix_power(A, i) @ K for i in range(8)])


def slicot_noise(u, y, order, block_rows):
    import ctrlsys

    (n, nu), ny = u.shape, y.shape[1]
    u, y = np.asfortranarray(u), np.asfortranarray(y)
    factor = ctrlsys.ib01ad("N", "Q", "N", "O", "N", "N", block_rows, nu, ny, u, y, 0.0, -1.0)[1]
    A, C, _, _, _, _, _, K, *_ = ctrlsys.ib01bd(
        "N", "A", "K", block_rows, order, nu, ny, n, factor, 0.0
    )
    return A, K, C


@pytest.mark.parametrize("method", WITH_NOISE_MODEL)
def test_innovation_gain_of_a_known_system(method):
    A, _, C, _, K = innovations_system()
    u, y = innovations_data()
    fit = identify(IOData(u=u, y=y, dt=0.1), method(order=3, block_rows=10))
    assert fit.innovation.status == Status.successful
    gain = np.asarray(fit.innovation_gain)
    truth = noise_markov(A, K, C)
    found = noise_markov(fit.model.A, gain, fit.model.C)
    slicot = noise_markov(*slicot_noise(u, y, 3, 10))
    # Both are estimates from the same samples: nearer to one another than to the truth.
    assert np.linalg.norm(found - slicot) < 0.005 * np.linalg.norm(truth)
    assert np.linalg.norm(found - truth) < 0.05 * np.linalg.norm(truth)
    predictor = np.asarray(fit.model.A) - gain @ np.asarray(fit.model.C)
    assert np.abs(np.linalg.eigvals(predictor)).max() < 1.0
    np.testing.assert_allclose(fit.innovation_covariance, COVARIANCE, atol=0.04 * 0.09)


def test_methods_agree_on_much_data_but_not_to_the_last_digit():
    u, y = innovations_data()
    data = IOData(u=u, y=y, dt=0.1)
    poles = [
        sorted_poles(identify(data, method(order=3, block_rows=10)).model.A)
        for method in WITH_NOISE_MODEL
    ]
    for other in poles[1:]:
        np.testing.assert_allclose(other, poles[0], atol=5e-3)
        assert np.abs(other - poles[0]).max() > 1e-7


def formed_factor(u, y, s):
    """Factor of the formed data matrix by NumPy, and its parts: future, past, outputs."""
    columns = len(u) - 2 * s + 1

    def rows(w, first):
        return np.concatenate([w[i : i + columns].T for i in range(first, first + s)])

    future, past = rows(u, s), np.concatenate([rows(u, 0), rows(y, 0)])
    parts = future, past, rows(y, s)
    whole = np.linalg.qr(np.concatenate(parts).T, mode="r").T
    layout = Layout(s, u.shape[1], y.shape[1], True, True)
    return factor_of_triangle(jnp.asarray(whole), layout).factor, parts


def test_projections_are_those_of_the_papers():
    """Against the formulas with pseudo-inverses."""
    u, _, y = common_problem(120)
    factor, (future, past, outputs) = formed_factor(u, y, 4)
    free = np.eye(future.shape[1]) - np.linalg.pinv(future) @ future
    oblique = outputs @ free @ np.linalg.pinv(past @ free) @ past
    white = np.linalg.cholesky(outputs @ free @ outputs.T)
    for method, weighted in (
        (N4SID, oblique),
        (PastOutputMOESP, oblique @ free),
        (CVA, np.linalg.solve(white, oblique @ free)),
    ):
        matrix, root = method().project(factor)
        # Up to an orthogonal matrix from the right; the root's columns have free signs.
        gram = np.asarray(matrix @ matrix.T)
        if root is not None:
            np.testing.assert_allclose(root @ root.T, white @ white.T, rtol=1e-9)
            gram, weighted = root @ gram @ root.T, white @ weighted
        np.testing.assert_allclose(gram, weighted @ weighted.T, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("method", [N4SID, CVA])
def test_without_noise_the_range_is_that_of_the_observability_matrix(method):
    """The instruments are linearly dependent then, and so are the future outputs."""
    A, B, C, D = three_modes()
    u = prbs(300, 2)
    matrix, root = method().project(formed_factor(u, respond((A, B, C, D), u), 5)[0])
    vectors, values, _ = np.linalg.svd(matrix)
    assert values[6] < 1e-9 * values[5]
    found = vectors[:, :6] if root is None else np.asarray(root) @ vectors[:, :6]
    truth = np.concatenate([C @ np.linalg.matrix_power(A, i) for i in range(5)])
    assert np.max(subspace_angles(found, truth)) < 1e-9
    if method is CVA:
        np.testing.assert_allclose(values[:6], 1.0)


def test_orse_finds_system_and_order_without_noise():
    system = three_modes()
    u = prbs(800, 2)
    y = respond(system, u)
    fit = identify(IOData(u=u, y=y, dt=DT), ORSE(block_rows=8))
    assert fit.order == 6 and fit.status == Status.successful
    found = fit.model.A, fit.model.B, fit.model.C, fit.model.D
    np.testing.assert_allclose(markov(found, 30), markov(system, 30), atol=1e-8)
    slicot = slicot_moen4(u, y, 6, 10, "Q")
    np.testing.assert_allclose(sorted_poles(fit.model.A), sorted_poles(slicot[0]), atol=1e-6)
    assert fit.innovation is None
    assert fit.innovation_gain is None and fit.innovation_covariance is None


def test_orse_is_the_published_matrix():
    """Its root: same left singular vectors, singular values their square roots."""
    rng = np.random.default_rng(0)
    U, Y = rng.standard_normal((6, 90)), rng.standard_normal((9, 90))
    whole = np.linalg.qr(np.concatenate([U, Y]).T, mode="r").T
    factor = factor_of_triangle(jnp.asarray(whole), Layout(3, 2, 3, False, False)).factor
    root, _ = ORSE().project(factor)
    published = Y @ Y.T - Y @ U.T @ np.linalg.pinv(U @ U.T) @ U @ Y.T
    np.testing.assert_allclose(root @ root.T, published, atol=1e-10)


@pytest.mark.slow
def test_no_gain_where_none_is_better_than_none():
    """White output noise on light damping: 20 past samples are too few for a filter."""
    u, clean, y = common_problem(3000)
    fit = identify(IOData(u=u, y=y, dt=DT), PastOutputMOESP(order=6, block_rows=20))
    np.testing.assert_array_equal(fit.innovation_gain, 0.0)
    np.testing.assert_allclose(
        np.diag(fit.innovation_covariance), np.var(y - clean, axis=0), rtol=0.05
    )


def test_a_gain_that_cannot_be_stable_is_a_status():
    """An unstable pole that no output shows: no gain moves it."""
    u, y = innovations_data()
    fit = identify(IOData(u=u, y=y, dt=0.1), PastOutputMOESP(order=3, block_rows=10))
    A, B, C, D, _ = innovations_system()
    A[2, 2], C[:, 2] = 1.2, 0.0
    hidden = eqx.tree_at(lambda fit: fit.model, fit, StateSpace(A, B, C, D, 0.1))
    assert hidden.innovation.status == Status.no_stable_gain
    np.testing.assert_array_equal(hidden.innovation_gain, 0.0)
    assert np.all(np.isfinite(hidden.innovation_covariance))


@pytest.mark.slow
def test_gain_under_jit_and_in_batches():
    u, y = innovations_data()
    data = IOData(u=u[:600], y=y[:600], dt=0.1)
    method = PastOutputMOESP(order=3, block_rows=6)

    @jax.jit
    def traces(ys):
        fits = jax.lax.map(lambda y: identify(data.replace(y=y), method), ys)
        gains = jax.vmap(lambda fit: fit.innovation_gain)(fits)
        return jnp.trace(fits.model.C @ gains, axis1=1, axis2=2)

    found = traces(jnp.stack([data.y, 2.0 * data.y]))
    fit = identify(data, method)
    expected = jnp.trace(fit.model.C @ fit.innovation_gain)
    np.testing.assert_allclose(found, expected, rtol=1e-7)
