"""Bounds and both minimisers against known minima and SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads

from lpvid._results import Status, is_successful
from lpvid._solve import Bounds, least_squares, minimise

# Free, lower, upper, both, and fixed.
LOWER = np.array([-np.inf, 2.0, -np.inf, -1.0, 3.0])
UPPER = np.array([np.inf, np.inf, -5.0, 4.0, 3.0])
BOUNDS = Bounds(jnp.asarray(LOWER), jnp.asarray(UPPER))
to_free = jax.jit(lambda x: BOUNDS.free(x))
to_bounded = jax.jit(lambda x: BOUNDS.bounded(x))
values = st.floats(-1e3, 1e3)


@settings(max_examples=50, deadline=None)
@given(values, st.floats(1e-6, 1e3), st.floats(1e-6, 1e3), st.floats(1e-4, 1 - 1e-4))
def test_bounds_round_trip(free, above, below, share):
    point = np.array([free, 2.0 + above, -5.0 - below, -1.0 + 5.0 * share, 3.0])
    np.testing.assert_allclose(
        to_bounded(to_free(jnp.asarray(point))), point, rtol=1e-9, atol=1e-12
    )


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-600.0, 600.0), min_size=5, max_size=5))
def test_bounds_always_hold(free):
    point = np.asarray(to_bounded(jnp.asarray(free)))
    assert np.all(np.isfinite(point))
    assert np.all(point >= LOWER) and np.all(point <= UPPER)


def test_points_outside_are_moved_just_inside():
    outside = jnp.array([7.0, 1.0, 0.0, 10.0, 99.0])
    np.testing.assert_allclose(to_bounded(to_free(outside)), [7, 2, -5, 4, 3], atol=2e-7)
    assert np.all(np.isfinite(to_free(outside)))


def test_a_point_close_to_its_only_bound_stays():
    bounds = Bounds(jnp.zeros(1), jnp.full(1, jnp.inf))
    np.testing.assert_allclose(bounds.bounded(bounds.free(jnp.array([1e-12]))), 1e-12, rtol=1e-9)


@pytest.mark.slow
def test_bounds_have_the_right_gradients():
    start = jnp.array([0.3, -1.0, 0.5, 1.2, 0.0])
    check_grads(lambda x: BOUNDS.bounded(jnp.asarray(x)), (start,), order=1, rtol=1e-6)
    inside = jnp.array([0.3, 2.5, -7.0, 1.0, 3.0])
    check_grads(lambda x: BOUNDS.free(jnp.asarray(x)), (inside,), order=1, rtol=1e-6)


def test_unused_branches_do_not_poison_gradients():
    steep = jax.grad(lambda x: jnp.sum(BOUNDS.bounded(x)))(jnp.array([800.0, 1.0, 1.0, 800.0, 800]))
    assert np.all(np.isfinite(steep))


def rosenbrock(x):
    return jnp.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]])


TIMES = np.linspace(0.0, 3.0, 25)
NOISE = 0.05 * np.random.default_rng(3).normal(size=TIMES.size)
DECAY = 2.0 * np.exp(-1.3 * TIMES) + 0.4 + NOISE


def decay(x):
    return x[0] * jnp.exp(-x[1] * TIMES) + x[2] - DECAY


@pytest.mark.parametrize(
    ("residual", "start"), [(rosenbrock, [-1.2, 1.0]), (decay, [1.0, 0.3, 0.0])]
)
def test_least_squares_finds_what_scipy_finds(residual, start):
    found = least_squares(residual, jnp.array(start), max_steps=200)
    expected = scipy.optimize.least_squares(
        lambda x: np.asarray(residual(jnp.asarray(x))), start, xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    assert is_successful(found.status)
    np.testing.assert_allclose(found.value, expected.x, rtol=1e-6)
    np.testing.assert_allclose(found.cost, expected.cost, rtol=1e-9, atol=1e-15)
    assert 0 < int(found.steps) < 200


@pytest.mark.parametrize("solve", ["least_squares", "minimise"])
def test_a_start_that_is_not_finite_is_a_status(solve):
    start = jnp.array([-1.0, 2.0])
    if solve == "least_squares":
        found = least_squares(lambda x: jnp.sqrt(x), start)
    else:
        found = minimise(lambda x: jnp.sum(jnp.sqrt(x)), start)
    assert found.status == Status.nonfinite
    assert np.isposinf(found.cost)
    np.testing.assert_array_equal(found.value, start)


def test_a_search_that_meets_nan_on_its_way_keeps_the_best_point():
    # The root at 0.01 lies next to where log ends: full steps land beyond.
    found = least_squares(lambda x: jnp.log(x) - jnp.log(0.01), jnp.array([5.0]), max_steps=200)
    assert is_successful(found.status)
    np.testing.assert_allclose(found.value, 0.01, rtol=1e-6)


def test_too_few_steps_are_a_status():
    start = jnp.array([-1.2, 1.0])
    found = least_squares(rosenbrock, start, max_steps=3)
    assert found.status == Status.max_steps
    assert found.cost < 0.5 * jnp.sum(rosenbrock(start) ** 2)
    found = minimise(lambda x: jnp.sum(rosenbrock(x) ** 2), start, max_steps=3)
    assert found.status == Status.max_steps
    assert found.cost < jnp.sum(rosenbrock(start) ** 2)


def test_several_starts_in_one_batch():
    starts = jnp.array([[-1.2, 1.0], [3.0, 3.0], [0.0, -2.0], [jnp.nan, 0.0]])
    found = jax.jit(jax.vmap(lambda x: least_squares(rosenbrock, x, max_steps=200)))(starts)
    np.testing.assert_allclose(found.value[:3], 1.0, atol=1e-6)
    np.testing.assert_array_equal(found.status == Status.successful, [True] * 3 + [False])
    assert np.isposinf(found.cost[3])


def test_the_minimum_has_a_derivative():
    def minimum(target):
        return least_squares(lambda x: jnp.array([x[0] ** 3 - target]), jnp.ones(1)).value[0]

    np.testing.assert_allclose(jax.grad(minimum)(8.0), 1.0 / 12.0, rtol=1e-5)


HESSIAN = np.diag([1.0, 30.0, 1000.0]) + 0.5
LINEAR = np.array([1.0, -2.0, 3.0])


def test_minimise_solves_a_quadratic():
    found = minimise(lambda x: 0.5 * x @ (HESSIAN @ x) - LINEAR @ x, jnp.zeros(3), tolerance=1e-10)
    assert is_successful(found.status)
    np.testing.assert_allclose(found.value, np.linalg.solve(HESSIAN, LINEAR), rtol=1e-8)


def chained_rosenbrock(x):
    return jnp.sum(100.0 * (x[1:] - x[:-1] ** 2) ** 2 + (1.0 - x[:-1]) ** 2)


def test_minimise_finds_what_scipy_finds():
    found = minimise(chained_rosenbrock, jnp.array([1.3, 0.7, 0.8, 1.9]), max_steps=200)
    expected = scipy.optimize.minimize(
        scipy.optimize.rosen, [1.3, 0.7, 0.8, 1.9], jac=scipy.optimize.rosen_der, tol=1e-12
    )
    assert is_successful(found.status)
    np.testing.assert_allclose(found.value, expected.x, atol=1e-6)
