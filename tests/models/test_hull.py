"""Convex hulls against SciPy's Delaunay triangulation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import Delaunay

from lpvid.models import FreeStructure, LPVStateSpace, convex_hull, polynomial_basis

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("width", [2, 3])
def test_inside_is_where_a_triangulation_is(width):
    points = RNG.normal(size=(12, width)) * [100.0, 1e-3, 1.0][:width] + 5.0
    reach = RNG.uniform(0.0, 1.5, size=(40, 1))
    asked = points.mean(axis=0) + reach * (points[RNG.integers(12, size=40)] - points.mean(axis=0))
    expected = Delaunay((points - 5.0) / points.std(axis=0)).find_simplex(
        (asked - 5.0) / points.std(axis=0)
    )
    distance = convex_hull(points).distance(asked)
    np.testing.assert_array_equal(np.asarray(distance) == 0.0, expected >= 0)
    assert 5 < np.sum(expected >= 0) < 35
    # The points themselves, to rounding.
    assert np.max(convex_hull(points).distance(points)) < 1e-9


def test_distances_are_in_half_ranges():
    hull = convex_hull([[0.0, 0.0], [4.0, 0.0], [0.0, 2.0], [4.0, 2.0], [1.0, 1.0]])
    assert hull.normals.shape == (4, 2)
    asked = np.array([[2.0, 1.0], [5.0, 1.0], [2.0, -2.0], [4.0, 2.0]])
    np.testing.assert_allclose(hull.distance(asked), [0.0, 0.5, 2.0, 0.0], atol=1e-12)


def test_flat_hulls_are_flat():
    line = convex_hull([[0.0, 0.0], [1.0, 2.0], [2.0, 4.0]])
    distance = np.asarray(line.distance([[0.5, 1.0], [2.0, 4.0], [1.0, 1.0], [3.0, 6.0]]))
    np.testing.assert_allclose(distance[:2], 0.0, atol=1e-12)
    assert np.all(distance[2:] > 0.3)
    plane = convex_hull([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [1.0, 1.0, 1.0]])
    distance = np.asarray(plane.distance([[0.5, 0.5, 1.0], [0.5, 0.5, 1.1]]))
    np.testing.assert_allclose(distance, [0.0, 0.1], atol=1e-12)
    point = convex_hull([[3.0, 4.0], [3.0, 4.0]])
    np.testing.assert_allclose(point.distance([[3.0, 4.0], [4.0, 4.0]]), [0.0, 1.0], atol=1e-12)
    interval = convex_hull([3.0, 1.0, 1.0])
    np.testing.assert_allclose(interval.distance([[0.0], [2.0], [4.0]]), [1.0, 0.0, 1.0])


def test_intersections_are_inside_of_both():
    both = convex_hull([0.0, 2.0]).intersection(convex_hull([1.0, 3.0]))
    np.testing.assert_array_equal(np.asarray(both.distance([[0.5], [1.5], [2.5]])) > 0, [1, 0, 1])


def test_models_tell_what_lies_outside_of_the_hull_but_in_the_box():
    points = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    lpv = LPVStateSpace(
        FreeStructure(1, 1, 1, feedthrough=False),
        polynomial_basis(points, 1),
        -jnp.ones((3, 3)),
        jnp.zeros(2),
        jnp.ones(2),
        convex_hull(points),
    )
    asked = jnp.array([[0.2, 0.2], [0.8, 0.8], [0.5005, 0.5]])
    expected = [True, False, True]
    np.testing.assert_array_equal(lpv.is_inside(asked), expected)
    np.testing.assert_array_equal(jax.jit(lambda k: lpv.is_inside(k))(asked), expected)
    np.testing.assert_array_equal(jax.vmap(lpv.is_inside)(asked), expected)
    with pytest.warns(UserWarning, match="33.3 % of the points lie outside the convex hull"):
        lpv.at(asked)
    slope = jax.grad(lpv.hull.distance)(jnp.array([0.8, 0.8]))
    np.testing.assert_allclose(slope, np.sqrt(2.0), rtol=1e-6)


@pytest.mark.parametrize("points", [[], [np.nan, 1.0], [[[1.0]]]])
def test_impossible_points_are_refused(points):
    with pytest.raises(ValueError, match="points: finite values"):
        convex_hull(points)


def test_a_whole_schedule_may_be_given():
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (20_000, 2))
    hull = convex_hull(points)
    assert np.all(np.asarray(hull.distance(jnp.asarray(points[:50]))) <= 1e-9)
