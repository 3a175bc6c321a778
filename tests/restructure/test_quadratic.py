"""The bundle's quadratic programs against SciPy, and by their optimality conditions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from lpvid.restructure._quadratic import Rows, join_rows, minimise_level

solve = jax.jit(minimise_level)
N, CUTS = 5, 8


@pytest.fixture(params=range(6))
def program(request):
    """A metric (down to nearly singular), cuts (two of them equal) and bounds on the step."""
    rng = np.random.default_rng(request.param)
    factor = rng.normal(size=(N, N))
    metric = factor @ factor.T * 10.0 ** -rng.integers(0, 3) + 1e-6 * np.eye(N)
    slopes = rng.normal(size=(CUTS, N)) * 10.0 ** rng.integers(-1, 2)
    gaps = rng.exponential(size=CUTS) * 0.1
    gaps[0] = 0.0
    slopes[3], gaps[3] = slopes[2], gaps[2]
    room = np.abs(rng.normal(size=N)) * 0.1
    cuts = Rows(jnp.asarray(slopes), jnp.ones(CUTS), jnp.asarray(gaps))
    bounds = Rows(jnp.eye(N), jnp.zeros(N), jnp.asarray(room))
    kept = jnp.arange(N) < 3
    return jnp.asarray(metric), join_rows(cuts, bounds.only(kept))


def test_the_optimality_conditions_hold(program):
    metric, rows = program
    found = solve(metric, rows)
    x, y = np.asarray(found.x), np.asarray(found.multipliers)
    slopes, lifted, limits = (np.asarray(part) for part in rows)
    assert np.all(y >= 0.0)
    np.testing.assert_allclose(y @ lifted, 1.0, rtol=1e-9)
    np.testing.assert_allclose(np.asarray(metric) @ x, -slopes.T @ y, atol=1e-8)
    room = limits - slopes @ x + lifted * float(found.level)
    assert room.min() > -1e-9
    np.testing.assert_allclose(room * y, 0.0, atol=1e-9)


def test_scipy_finds_nothing_lower(program):
    metric, rows = program
    metric = np.asarray(metric)
    found = solve(*program)
    slopes, lifted, limits = (np.asarray(part) for part in rows)
    matrix = np.concatenate([slopes, -lifted[:, None]], axis=1)
    expected = scipy.optimize.minimize(
        lambda z: 0.5 * z[:-1] @ metric @ z[:-1] + z[-1],
        np.zeros(N + 1),
        jac=lambda z: np.append(metric @ z[:-1], 1.0),
        constraints={
            "type": "ineq",
            "fun": lambda z: limits - matrix @ z,
            "jac": lambda z: -matrix,
        },
        method="SLSQP",
        options={"ftol": 1e-14, "maxiter": 500},
    )
    x = np.asarray(found.x)
    value = 0.5 * x @ metric @ x + float(found.level)
    assert value <= expected.fun + 1e-7
