import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpvid.identify import _simulation_error as se
from lpvid.identify._linear_fit import solve, solve_positive

from .helpers import prbs, respond, three_modes

recorded = jax.jit(se.record_equations, static_argnames="lengths")
solved = jax.jit(solve, static_argnames=("nx", "feedthrough"))


def arrays(*matrices):
    return tuple(jnp.asarray(m) for m in matrices)


def regressors(A, C, u):
    """Filtered sample by sample: for each output (time, (nu + 1) nx), x0 last."""
    nx, nu = A.shape[0], u.shape[1]
    for row in C:
        r, free, out = np.zeros((nu, nx)), row.copy(), []
        for sample in u:
            out.append(np.concatenate([r.ravel(), free]))
            r, free = r @ A + np.outer(sample, row), free @ A
        yield np.array(out)


@pytest.mark.parametrize("n", [5, 12, 313])
def test_normal_equations_are_those_of_the_filtered_regressors(n, monkeypatch):
    # Several chunks, a rest of blocks and a rest of samples at n = 313.
    monkeypatch.setattr(se, "_BLOCKS_AT_ONCE", 10)
    A, _, C, _ = three_modes()
    rng = np.random.default_rng(n)
    u, y = rng.standard_normal((n, 2)), rng.standard_normal((n, 2))
    found = jax.jit(se.normal_equations)(*arrays(A, C, u, y))
    for k, phi in enumerate(regressors(A, C, u)):
        # Entries by channel: nx regressors, then the input; x0 has none.
        parts = [phi[:, :6], u[:, :1], phi[:, 6:12], u[:, 1:], phi[:, 12:], np.zeros((n, 1))]
        whole = np.concatenate(parts, axis=1)
        close = dict(rtol=1e-10, atol=1e-9)
        np.testing.assert_allclose(found.matrix[k], whole.T @ whole, **close)
        np.testing.assert_allclose(found.right[k], whole.T @ y[:, k], **close)
    np.testing.assert_allclose(found.power, np.sum(y**2, axis=0), **close)


@pytest.mark.parametrize("feedthrough", [True, False])
def test_solution_is_the_least_squares_one(feedthrough):
    A, _, C, _ = three_modes()
    lengths = (60, 41, 60)
    rng = np.random.default_rng(3)
    u, y = rng.standard_normal((161, 2)), rng.standard_normal((161, 2))
    equations = recorded(*arrays(A, C, u, y), lengths=lengths)
    found = solved(equations, nx=6, feedthrough=feedthrough)

    columns = 12 + 4 + 18
    blocks, start = [], 0
    for record, length in enumerate(lengths):
        part = u[start : start + length]
        start += length
        for k, phi in enumerate(regressors(A, C, part)):
            block = np.zeros((length, columns))
            block[:, :12] = phi[:, :12]
            block[:, 12 + 2 * k : 14 + 2 * k] = part if feedthrough else 0.0
            block[:, 16 + 6 * record : 22 + 6 * record] = phi[:, 12:]
            blocks.append(block)
    ends = np.cumsum(lengths)[:-1]
    target = np.concatenate([part[:, k] for part in np.split(y, ends) for k in range(2)])
    matrix = np.concatenate(blocks)
    theta = np.linalg.lstsq(matrix, target)[0]
    np.testing.assert_allclose(np.asarray(found.B).T.ravel(), theta[:12], atol=1e-9)
    np.testing.assert_allclose(np.asarray(found.D).ravel(), theta[12:16], atol=1e-9)
    np.testing.assert_allclose(np.asarray(found.x0).ravel(), theta[16:], atol=1e-9)
    rest = np.sum((target - matrix @ theta) ** 2)
    np.testing.assert_allclose(np.sum(found.residual), rest, rtol=1e-10)


def test_recovers_the_system_that_made_the_data():
    A, B, C, D = three_modes()
    u, x0 = prbs(700, 2), np.arange(6.0)
    y = respond((A, B, C, D), u, x0)
    found = solved(recorded(*arrays(A, C, u, y), lengths=(700,)), nx=6, feedthrough=True)
    for value, truth in ((found.B, B), (found.D, D), (found.x0[0], x0)):
        np.testing.assert_allclose(value, truth, atol=1e-11)


def test_singular_systems_get_the_least_norm_solution():
    matrix = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    right = np.array([[2.0], [2.0], [0.0]])
    np.testing.assert_allclose(
        solve_positive(jnp.asarray(matrix), jnp.asarray(right))[:, 0],
        [1.0, 1.0, 0.0],
        atol=1e-12,
    )
