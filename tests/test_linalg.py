"""Matrix equations and functions against SciPy."""

import jax
import jax.numpy as jnp
import jax.test_util
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

from lpvid import _linalg


def stable_continuous(rng, n):
    A = rng.normal(size=(n, n))
    A -= np.eye(n) * (np.linalg.eigvals(A).real.max() + 0.3)
    scale = 10.0 ** rng.uniform(-1, 1, n)
    return scale[:, None] * A / scale[None]


@pytest.mark.parametrize("n", [1, 6, 20])
def test_discrete_lyapunov_agrees_with_scipy(n):
    rng = np.random.default_rng(n)
    A = rng.normal(size=(n, n))
    A *= 0.999 / np.abs(np.linalg.eigvals(A)).max()
    Q = rng.normal(size=(n, n))
    X = _linalg.discrete_lyapunov(jnp.asarray(A), jnp.asarray(Q))
    np.testing.assert_allclose(A @ X @ A.T + Q, X, atol=1e-12 * np.abs(X).max())
    expected = scipy.linalg.solve_discrete_lyapunov(A, Q)
    np.testing.assert_allclose(X, expected, atol=1e-9 * np.abs(X).max())


@pytest.mark.parametrize("n", [1, 6, 20])
def test_continuous_lyapunov_agrees_with_scipy(n):
    rng = np.random.default_rng(n)
    A, Q = stable_continuous(rng, n), rng.normal(size=(n, n))
    X = _linalg.continuous_lyapunov(jnp.asarray(A), jnp.asarray(Q))
    residual = A @ X + X @ A.T + Q
    assert np.abs(residual).max() < 1e-13 * np.abs(A).max() * np.abs(X).max()
    expected = scipy.linalg.solve_continuous_lyapunov(A, -Q)
    np.testing.assert_allclose(X, expected, atol=1e-9 * np.abs(X).max())


def test_sylvester_and_stein_take_rectangular_and_batched_constants():
    rng = np.random.default_rng(0)
    F = np.stack([stable_continuous(rng, 4) for _ in range(3)])
    G, Q = stable_continuous(rng, 2), rng.normal(size=(3, 4, 2))
    X = np.asarray(_linalg.continuous_sylvester(*map(jnp.asarray, (F, G, Q))))
    for k in range(3):
        np.testing.assert_allclose(X[k], scipy.linalg.solve_sylvester(F[k], G, -Q[k]), rtol=1e-9)
    discrete = [scipy.linalg.expm(0.1 * M) for M in (F[0], G)]
    X = np.asarray(_linalg.stein(*map(jnp.asarray, (*discrete, Q))))
    np.testing.assert_allclose(discrete[0] @ X @ discrete[1] + Q, X, rtol=1e-9)


def test_unstable_matrices_give_nan():
    unstable, Q = jnp.asarray([[1.0, 0.2], [0.0, 0.5]]), jnp.eye(2)
    assert np.all(np.isnan(_linalg.discrete_lyapunov(unstable, Q)))
    assert np.all(np.isnan(_linalg.discrete_lyapunov(3.0 * unstable, Q)))
    assert np.all(np.isnan(_linalg.continuous_lyapunov(unstable - 0.7 * jnp.eye(2), Q)))


@pytest.mark.slow
@pytest.mark.parametrize("solve", [_linalg.discrete_lyapunov, _linalg.continuous_lyapunov])
def test_lyapunov_derivatives(solve):
    rng = np.random.default_rng(1)
    A = 0.3 * rng.normal(size=(3, 3)) - np.eye(3)
    A = jnp.asarray(scipy.linalg.expm(A) if solve is _linalg.discrete_lyapunov else A)
    B = jnp.asarray(rng.normal(size=(3, 3)))

    def value(A, B):
        A, B = jnp.asarray(A), jnp.asarray(B)
        return jnp.sum(solve(A, B @ B.mT) ** 2)

    jax.test_util.check_grads(jax.jit(value), (A, B), order=1, modes=("fwd", "rev"), rtol=1e-6)
    gradient = jax.jit(jax.grad(value))
    E, step = jnp.asarray(rng.normal(size=(3, 3))), 1e-5
    curvature = jax.jvp(lambda A: gradient(A, B), (A,), (E,))[1]
    expected = (gradient(A + step * E, B) - gradient(A - step * E, B)) / (2 * step)
    np.testing.assert_allclose(curvature, expected, rtol=1e-6)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**31), size=st.floats(-8, 2), spread=st.floats(0, 2))
def test_expm_agrees_with_scipy(seed, size, spread):
    rng = np.random.default_rng(seed)
    A = 10.0**size * (rng.normal(size=(3, 6, 6)) / 6 - np.eye(6))
    scale = 10.0 ** rng.uniform(-spread, spread, (3, 6, 1))
    expected = scipy.linalg.expm(A) * scale / scale.mT
    ours = np.asarray(_linalg.expm(jnp.asarray(A * scale / scale.mT)))
    # The error in the balanced basis, where SciPy's answer is the accurate one.
    error = (ours - expected) / scale * scale.mT
    bound = 1e-13 * (1 + 10.0**size) * np.linalg.norm(scipy.linalg.expm(A), axis=(-2, -1))
    assert np.all(np.linalg.norm(error, axis=(-2, -1)) <= bound * 10 ** (2 * spread))


def test_expm_derivative_and_limits():
    rng = np.random.default_rng(6)
    A, E = rng.normal(size=(2, 4, 4))
    for scale in (0.1, 3.0):
        _, expected = scipy.linalg.expm_frechet(scale * A, E)
        _, tangent = jax.jvp(_linalg.expm, (jnp.asarray(scale * A),), (jnp.asarray(E),))
        np.testing.assert_allclose(tangent, expected, atol=1e-12 * np.abs(expected).max())
    _, pullback = jax.vjp(_linalg.expm, jnp.asarray(scale * A))
    _, expected = scipy.linalg.expm_frechet(scale * A.T, E)
    np.testing.assert_allclose(pullback(jnp.asarray(E))[0], expected, rtol=1e-10)
    np.testing.assert_array_equal(_linalg.expm(jnp.zeros((2, 3, 3)))[1], np.eye(3))
    assert np.all(np.isnan(_linalg.expm(jnp.asarray([[-1e9]]))))


@pytest.mark.parametrize("function", ["logm", "sqrtm"])
@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    n=st.sampled_from([2, 6]),
    size=st.floats(-6, 0.3),
)
def test_logarithm_and_root_undo_the_exponential(function, seed, n, size):
    X = np.random.default_rng(seed).normal(size=(n, n))
    # The principal logarithm needs eigenvalues within ±π.
    X *= min(10.0**size / np.linalg.norm(X), 3.0 / np.abs(np.linalg.eigvals(X).imag).max(initial=1))
    exponential = scipy.linalg.expm(X)
    condition = np.linalg.cond(exponential)
    if function == "logm":
        # The exponential itself was rounded: an absolute error of eps, more if ill-conditioned.
        np.testing.assert_allclose(
            _linalg.logm(jnp.asarray(exponential)), X, atol=3e-15 * condition
        )
    else:
        root = np.asarray(_linalg.sqrtm(jnp.asarray(exponential)))
        expected = scipy.linalg.expm(X / 2)
        np.testing.assert_allclose(root, expected, atol=1e-14 * condition)


def test_logm_agrees_with_scipy():
    rng = np.random.default_rng(3)
    for n in (2, 6, 8):
        A = scipy.linalg.expm(0.5 * rng.normal(size=(n, n)))
        expected = scipy.linalg.logm(A)
        error = np.linalg.norm(_linalg.logm(jnp.asarray(A)) - expected)
        assert error < 1e-12 * np.linalg.norm(expected)


def test_logm_of_slow_fast_and_nearly_negative_eigenvalues():
    angle = np.pi - 1e-3
    rotation = 0.9 * np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    A = scipy.linalg.block_diag(rotation, 1e-8, 1.0)
    log = np.asarray(_linalg.logm(jnp.asarray(A)))
    expected = scipy.linalg.block_diag(
        [[np.log(0.9), angle], [-angle, np.log(0.9)]], np.log(1e-8), 0.0
    )
    np.testing.assert_allclose(log, expected, atol=1e-10)


def test_logm_is_nan_where_there_is_none():
    assert np.all(np.isnan(_linalg.logm(jnp.diag(jnp.asarray([0.5, -0.5])))))
    assert np.all(np.isnan(_linalg.logm(jnp.diag(jnp.asarray([0.5, 0.0])))))


def test_logm_derivatives_match_the_frechet_derivative():
    rng = np.random.default_rng(4)
    X, E = rng.normal(size=(2, 4, 4))
    for scale in (1e-3, 0.3):  # without and with square roots
        exponential, change = scipy.linalg.expm_frechet(scale * X, E)
        # The logarithm's derivative is the inverse of the exponential's.
        _, tangent = jax.jvp(_linalg.logm, (jnp.asarray(exponential),), (jnp.asarray(change),))
        np.testing.assert_allclose(tangent, E, atol=1e-11)
    _, pullback = jax.vjp(_linalg.logm, jnp.asarray(exponential))
    np.testing.assert_allclose(np.sum(pullback(jnp.asarray(E))[0] * change), np.sum(E * E))


@pytest.mark.parametrize("radius", [0.5, 0.99, 1.2])
def test_riccati_against_scipy(radius):
    rng = np.random.default_rng(4)
    A = rng.standard_normal((6, 6))
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    C, root = rng.standard_normal((2, 6)), rng.standard_normal((8, 8))
    joint = root @ root.T
    Q, S, R = joint[:6, :6], joint[:6, 6:], joint[6:, 6:]
    P = np.asarray(_linalg.discrete_riccati(A, C, Q, R, S))
    truth = scipy.linalg.solve_discrete_are(A.T, C.T, Q, R, s=S)
    np.testing.assert_allclose(P, truth, rtol=1e-8, atol=1e-9 * np.abs(truth).max())
    K = np.linalg.solve(C @ P @ C.T + R, (A @ P @ C.T + S).T).T
    assert np.abs(np.linalg.eigvals(A - K @ C)).max() < 1.0


def test_riccati_gradient_batch_and_failure():
    rng = np.random.default_rng(5)
    A, C, root = 0.4 * rng.standard_normal((3, 3)), rng.standard_normal((1, 3)), np.eye(3)

    def corner(A):
        return _linalg.discrete_riccati(A, C, root, np.eye(1), np.zeros((3, 1)))[..., 0, 1]

    step = rng.standard_normal((3, 3))
    slope = np.sum(jax.grad(corner)(A) * step)
    difference = (corner(A + 1e-6 * step) - corner(A - 1e-6 * step)) / 2e-6
    np.testing.assert_allclose(slope, difference, rtol=1e-7)
    both = corner(np.stack([A, 0.5 * A]))
    np.testing.assert_allclose(both, [corner(A), corner(0.5 * A)], rtol=1e-12)
    # An unstable state that the output does not show.
    hidden, unseen = np.diag([0.5, 0.5, 1.1]), np.array([[1.0, 1.0, 0.0]])
    P = _linalg.discrete_riccati(hidden, unseen, root, np.eye(1), np.zeros((3, 1)))
    assert np.all(np.isnan(P))
