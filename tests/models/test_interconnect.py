"""Connections against python-control, and against simulating one model after the other."""

import control
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpvid.models import (
    FreeStructure,
    LPVStateSpace,
    PolynomialBasis,
    StateSpace,
    convex_hull,
    feedback,
    parallel,
    polynomial_basis,
    series,
    to_control,
)

RNG = np.random.default_rng(0)
OMEGA = np.geomspace(0.1, 10.0, 7)
KAPPA = 0.5 + 0.4 * np.sin(np.arange(20.0))
U = RNG.normal(size=20)


def lpv(seed, degree, points=(0.0, 0.5, 1.0)):
    """Two states, well damped, feedthrough."""
    basis = polynomial_basis(points, degree)
    rng = np.random.default_rng(seed)
    coefficients = 0.1 * rng.normal(size=(basis.size, 9))
    coefficients[0] += [-1.0, 2.0, -2.0, -1.5, 1.0, 0.5, 1.0, -0.3, 0.4]
    ends = jnp.array([min(points)]), jnp.array([max(points)])
    hull = convex_hull(np.array(points))
    return LPVStateSpace(FreeStructure(2, 1, 1), basis, jnp.asarray(coefficients), *ends, hull)


PLANT, OTHER, ALIKE = lpv(1, 2), lpv(2, 1, points=(0.2, 0.9)), lpv(3, 2)
FILTER = StateSpace([[-3.0]], [[1.0]], [[2.0]], [[0.3]])


def frozen(model, kappa):
    return to_control(model if isinstance(model, StateSpace) else model.at(kappa))


@pytest.mark.parametrize(
    ("ours", "theirs"),
    [
        (series, control.series),
        (parallel, control.parallel),
        (lambda a, b: parallel(a, b, -1), lambda a, b: control.parallel(a, -b)),
        (feedback, control.feedback),
        (lambda a, b: feedback(a, b, 1), lambda a, b: control.feedback(a, b, 1)),
    ],
    ids=["series", "parallel", "difference", "negative feedback", "positive feedback"],
)
@pytest.mark.parametrize(
    ("first", "second"),
    [(PLANT, FILTER), (FILTER, PLANT), (PLANT, OTHER), (PLANT, ALIKE), (FILTER, FILTER)],
    ids=["LPV-LTI", "LTI-LPV", "two bases", "one basis", "LTI-LTI"],
)
def test_frozen_connections_are_python_controls(ours, theirs, first, second):
    connected = ours(first, second)
    model = connected if isinstance(connected, StateSpace) else connected.at(0.6)
    expected = theirs(frozen(first, 0.6), frozen(second, 0.6))
    found = to_control(model)
    np.testing.assert_allclose(found(1j * OMEGA), expected(1j * OMEGA), rtol=1e-9)


def test_connected_models_share_a_basis_where_theirs_are_one():
    assert isinstance(series(PLANT, ALIKE).basis, PolynomialBasis)
    assert series(PLANT, FILTER).coefficients.shape == PLANT.coefficients.shape
    both = series(PLANT, OTHER)
    assert both.coefficients.shape == (5, 18)
    assert both.structure.parameter_names[0] == "first A[0,0]"
    assert series(FILTER, PLANT).structure.parameter_names == PLANT.structure.parameter_names
    np.testing.assert_array_equal([both.kappa_low[0], both.kappa_high[0]], [0.2, 0.9])
    np.testing.assert_array_equal(both.is_inside([0.1, 0.5, 0.95]), [False, True, False])
    unbounded = eqx.tree_at(lambda m: m.hull, PLANT, None, is_leaf=lambda x: x is None)
    np.testing.assert_array_equal(
        series(unbounded, OTHER).is_inside([-0.1, 0.5, 0.95]), [False, True, False]
    )


def test_discrete_series_is_one_simulation_after_the_other():
    dt = 0.1
    first, second = PLANT.discretise(dt), FILTER.discretise(dt)
    y = series(first, second).simulate(u=U, kappa=KAPPA)
    expected = second.simulate(u=first.simulate(u=U, kappa=KAPPA))
    np.testing.assert_allclose(y, expected, rtol=1e-10, atol=1e-12)


def test_a_loop_closes_sample_by_sample():
    dt = 0.1
    plant, controller = PLANT.discretise(dt), FILTER.discretise(dt)
    y = feedback(plant, controller).simulate(u=U, kappa=KAPPA)
    frozen = plant.at(KAPPA)
    x, v, expected = np.zeros(2), np.zeros(1), []
    for t in range(len(U)):
        A, B, C, D = (np.asarray(getattr(frozen, name)[t]) for name in "ABCD")
        K, L, M, N = (np.asarray(getattr(controller, name)) for name in "ABCD")
        # y = C x + D (u − M v − N y)
        out = np.linalg.solve(np.eye(1) + D @ N, C @ x + D @ (U[t] - M @ v))
        entering = U[t] - M @ v - N @ out
        x, v = A @ x + B @ entering, K @ v + L @ out
        expected.append(out)
    np.testing.assert_allclose(y, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_loops_compose_with_jit_vmap_and_grad():
    def cost(coefficients, gain):
        plant = eqx.tree_at(lambda m: m.coefficients, PLANT, coefficients)
        controller = eqx.tree_at(lambda m: m.C, FILTER, gain)
        return jnp.sum(feedback(plant, controller).simulate(u=U, kappa=KAPPA, dt=0.1) ** 2)

    arguments = PLANT.coefficients, FILTER.C
    gradients = jax.jit(jax.grad(cost, argnums=(0, 1)))(*arguments)
    value = jax.jit(jax.vmap(cost, in_axes=(None, 0)))
    for index, gradient in enumerate(gradients):
        direction = RNG.normal(size=gradient.shape)
        both = [
            [a + s * 1e-6 * direction if i == index else a for i, a in enumerate(arguments)]
            for s in (1.0, -1.0)
        ]
        ahead, behind = (value(c, g[None])[0] for c, g in both)
        np.testing.assert_allclose(np.sum(gradient * direction), (ahead - behind) / 2e-6, rtol=1e-5)


@pytest.mark.parametrize(
    ("connect", "message"),
    [
        (lambda: series(PLANT, StateSpace([[-1.0]], [[1.0, 1.0]], [[1.0]])), "Cannot connect"),
        (lambda: feedback(PLANT, StateSpace([[-1.0]], [[1.0, 1.0]], [[1.0]])), "close the loop"),
        (lambda: series(PLANT, FILTER.discretise(0.1)), r"dt = 0.0 s and 0.1 s"),
        (lambda: series(PLANT, lpv(0, 1, points=(2.0, 3.0))), "nothing in common"),
        (lambda: parallel(PLANT, FILTER, sign=2), "sign: -1 or 1"),
        (
            lambda: feedback(
                StateSpace([[-1.0]], [[1.0]], [[1.0]], [[1.0]]),
                StateSpace([[-1.0]], [[1.0]], [[1.0]], [[-1.0]]),
            ),
            "singular",
        ),
        (
            lambda: series(PLANT, StateSpace(-np.ones((2, 1, 1)), [[1.0]], [[1.0]])),
            "batch axes",
        ),
    ],
)
def test_impossible_connections_are_refused(connect, message):
    with pytest.raises(ValueError, match=message):
        connect()
