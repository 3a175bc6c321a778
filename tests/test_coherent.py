"""Black boxes in random bases, made coherent along κ and interpolated between the points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpvid.interpolate import align_along, interpolate, modal_along
from lpvid.interpolate._coherent import walk
from lpvid.models import Polynomial, Spline, StateSpace

OMEGA = np.geomspace(2.0, 100.0, 100)


def two_states(kappa):
    """A known A(κ): one lightly damped mode, its stiffness affine in κ."""
    A = [[0.0, 1.0], [-(100.0 + 60.0 * kappa), -0.3 - 0.1 * kappa]]
    return StateSpace(A, [[0.0], [1.0 + 0.2 * kappa]], [[1.0, 0.0], [0.0, 0.1]])


def real_or_not(kappa):
    """Poles that are complex for κ < 0.5 and real beyond, and a single fast one."""
    A = np.diag([0.0, 0.0, -30.0])
    A[:2, :2] = [[0.0, 1.0], [-100.0, -10.0 - 20.0 * kappa]]
    return StateSpace(A, [[0.0], [1.0], [1.0 + kappa]], [[100.0, 0.0, 2.0]])


def crossing(kappa):
    """Two uncoupled modes that change places, seen by two outputs."""
    A = np.zeros((4, 4))
    for k, stiffness in enumerate((100.0 + 300.0 * kappa, 300.0 - 150.0 * kappa)):
        A[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = [[0.0, 1.0], [-stiffness, -0.4]]
    return StateSpace(A, [[0.0], [1.0], [0.0], [1.0]], [[1.0, 0, 0, 0], [0, 0, 1.0, 0.1]])


def damped(kappa):
    """Real poles close together: no distinct modes."""
    A = [[-1.0, 1.0, 0.0], [-kappa, -2.0, 1.0], [0.0, -1.0, -3.0 - kappa]]
    return StateSpace(A, [[1.0], [0.0], [1.0]], [[1.0, 0.0, 1.0], [0.0, 1.0, -1.0]])


def black_boxes(family, kappas):
    """The family in a random basis at each point."""
    boxes = []
    for seed, kappa in enumerate(kappas):
        model = family(kappa)
        basis = np.random.default_rng(seed).normal(size=(model.nx, model.nx))
        boxes.append(model.transform(basis + 2.0 * np.eye(model.nx)))
    return boxes


def furthest(lpv, family, kappas, dt=None):
    """Largest relative error of a frozen response."""
    errors = []
    for kappa in kappas:
        truth = family(kappa) if dt is None else family(kappa).discretise(dt)
        response = np.asarray(truth.frequency_response(OMEGA))
        error = np.asarray(lpv.at(kappa).frequency_response(OMEGA)) - response
        errors.append(np.linalg.norm(error) / np.linalg.norm(response))
    return max(errors)


KAPPAS = np.linspace(0.0, 1.0, 5)
BETWEEN = (KAPPAS[1:] + KAPPAS[:-1]) / 2.0


@pytest.mark.parametrize(
    "family",
    [
        two_states,
        pytest.param(real_or_not, marks=pytest.mark.slow),
        pytest.param(crossing, marks=pytest.mark.slow),
    ],
)
def test_modes_are_right_between_the_points(family):
    boxes = black_boxes(family, KAPPAS)
    local = modal_along(boxes, KAPPAS)
    for box, model in zip(boxes, local, strict=True):
        np.testing.assert_allclose(
            model.frequency_response(OMEGA), box.frequency_response(OMEGA), rtol=1e-6, atol=1e-9
        )
    lpv = interpolate(local, KAPPAS, Polynomial(3))
    assert furthest(lpv, family, BETWEEN) < 0.01
    assert np.all(lpv.is_stable(np.linspace(0.0, 1.0, 21)))


def test_discrete_modes_are_right_between_the_points():
    boxes = [box.discretise(0.02) for box in black_boxes(two_states, KAPPAS)]
    lpv = interpolate(modal_along(boxes, KAPPAS), KAPPAS, Polynomial(3))
    assert lpv.dt == 0.02
    assert furthest(lpv, two_states, BETWEEN, dt=0.02) < 0.01


@pytest.mark.slow
def test_two_scheduling_variables_in_any_order():
    grid = np.stack(np.meshgrid([0.0, 0.5, 1.0], [0.0, 1.0]), axis=-1).reshape(6, 2)
    points = grid[np.random.default_rng(0).permutation(6)]
    boxes = black_boxes(lambda point: two_states(point[0] + 0.3 * point[1]), points)
    lpv = interpolate(modal_along(boxes, points), points, Polynomial(1))
    for point in ([0.25, 0.5], [0.75, 0.2]):
        expected = two_states(point[0] + 0.3 * point[1]).modes()
        np.testing.assert_allclose(lpv.at(point).modes().frequency, expected.frequency, rtol=1e-3)


@pytest.mark.slow
def test_models_without_distinct_modes_are_aligned():
    boxes = black_boxes(damped, KAPPAS)
    local = align_along(boxes, KAPPAS)
    np.testing.assert_allclose(
        local[0].frequency_response(OMEGA), boxes[0].frequency_response(OMEGA), rtol=1e-6
    )
    lpv = interpolate(local, KAPPAS, Spline())
    assert furthest(lpv, damped, BETWEEN) < 0.01
    naive = interpolate(boxes, KAPPAS, Spline())
    assert furthest(naive, damped, BETWEEN) > 0.1


@pytest.mark.slow
def test_alignment_differentiates_and_takes_slightly_unstable_and_discrete_models():
    boxes = black_boxes(damped, KAPPAS[:3])

    def corner(gain):
        moved = [StateSpace(m.A, gain * m.B, m.C, m.D) for m in boxes]
        return align_along(moved, KAPPAS[:3])[2].A[0, 1]

    ahead, behind = corner(1.0 + 1e-5), corner(1.0 - 1e-5)
    slope = jax.jit(jax.grad(corner))(1.0)
    np.testing.assert_allclose(slope, (ahead - behind) / 2e-5, rtol=1e-5, atol=1e-8)
    unstable = [StateSpace(m.A + 1.2 * jnp.eye(3), m.B, m.C) for m in boxes]
    for model, box in zip(align_along(unstable, KAPPAS[:3]), unstable, strict=True):
        np.testing.assert_allclose(np.sort(model.poles()), np.sort(box.poles()), rtol=1e-6)
    discrete = [box.discretise(0.05) for box in boxes]
    lpv = interpolate(align_along(discrete, KAPPAS[:3]), KAPPAS[:3], Spline())
    assert furthest(lpv, damped, [0.125, 0.375], dt=0.05) < 0.01


def test_the_walk_starts_in_the_middle_and_goes_to_neighbours():
    first, path = walk(np.array([[3.0], [0.0], [2.0], [1.0], [4.0]]))
    assert first == 2
    assert {index: neighbour for index, neighbour in path} == {0: 2, 3: 2, 1: 3, 4: 0}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: modal_along([two_states(0.0), damped(0.0)], [0, 1]), "of one size"),
        (lambda: modal_along([two_states(0.0)], [0, 1]), "kappas: one row"),
        (lambda: jax.jit(lambda m: modal_along([m, m], [0, 1]))(damped(0.0)), "needs numbers"),
        (lambda: modal_along([JORDAN, JORDAN], [0, 1]), "point 0 cannot be told apart"),
        (lambda: modal_along([TWINS, TWINS], [0, 1]), r"equal real poles \(-2 rad/s\) at point 0"),
        (lambda: modal_along([DELAY, DELAY], [0, 1]), "at point 0 .a delay of whole samples"),
        (lambda: modal_along([INTEGRATOR] * 2, [0, 1]), "a pole at zero at point 0"),
        (
            lambda: align_along([damped(0.0), StateSpace(40 * np.eye(3), *FULL)], [0, 1]),
            r"too unstable at point\(s\) \[1\]",
        ),
    ],
)
def test_impossible_families_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


FULL = np.ones((3, 1)), np.ones((2, 3))
TWINS = StateSpace(np.diag([-2.0, -2.0, -5.0]), *FULL)
DELAY = StateSpace(np.diag([0.5, 0.2, 0.0]), *FULL, dt=0.1)
INTEGRATOR = StateSpace(np.diag([0.0, -1.0, -5.0]), *FULL)
JORDAN = StateSpace(-np.eye(4) + np.eye(4, k=1), np.ones((4, 1)), np.ones((1, 4)))
