"""LPV models against a plain recursion over models discretised one by one."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.signal

from lpvid.models import (
    FreeStructure,
    LinearSchedule,
    LPVStateSpace,
    ModalStructure,
    StateSpace,
    polynomial_basis,
)

DT = 2e-3
LENGTH = 40
RNG = np.random.default_rng(0)
KAPPA = 0.5 + 0.5 * np.sin(np.linspace(0.0, 5.0, LENGTH))
U = RNG.normal(size=(LENGTH, 2))
TARGET = RNG.normal(size=(LENGTH, 2))


def modal_lpv(points, degree=2):
    """Two modes whose frequencies, dampings and shapes depend on κ."""
    structure = ModalStructure(2, n_inputs=2, n_outputs=2, feedthrough=True)
    basis = polynomial_basis(points, degree)
    rng = np.random.default_rng(1)
    coefficients = 0.3 * rng.normal(size=(basis.size, structure.n_parameters))
    per_mode = (structure.n_parameters - 4) // 2
    coefficients[0, [0, per_mode]] = np.log([30.0, 90.0])
    coefficients[0, [1, per_mode + 1]] = np.log(0.05)
    points = np.asarray(points, float)
    points = points[:, None] if points.ndim == 1 else points
    return LPVStateSpace(
        structure,
        basis,
        jnp.asarray(coefficients),
        jnp.asarray(points.min(axis=0)),
        jnp.asarray(points.max(axis=0)),
    )


LPV = modal_lpv([0.0, 0.5, 1.0])


def recursion(lpv, u, kappa, x):
    """The same by SciPy and a loop."""
    outputs = []
    for sample, point in zip(u, kappa, strict=True):
        frozen = lpv.at(point)
        A, B, C, D, _ = scipy.signal.cont2discrete(
            tuple(np.asarray(m) for m in (frozen.A, frozen.B, frozen.C, frozen.D)), DT
        )
        outputs.append(C @ x + D @ sample)
        x = A @ x + B @ sample
    return np.stack(outputs)


def test_freezing_gives_the_model_at_a_point():
    scaled = (0.3 - 0.5) / 0.5
    parameters = np.array([1.0, scaled, scaled**2]) @ np.asarray(LPV.coefficients)
    np.testing.assert_allclose(LPV.parameters(0.3), parameters, rtol=1e-12)
    expected = LPV.structure.matrices(jnp.asarray(parameters))
    for kappa in (0.3, [0.3]):
        frozen = LPV.at(kappa)
        assert isinstance(frozen, StateSpace) and frozen.dt == 0.0
        np.testing.assert_allclose(frozen.A, expected.A, rtol=1e-12)
    assert LPV.parameters(KAPPA).shape == (LENGTH, LPV.structure.n_parameters)


@pytest.mark.parametrize("x0", [None, np.array([0.1, -0.2, 0.3, 0.05])], ids=["rest", "moving"])
def test_simulation_is_the_recursion_over_frozen_models(x0):
    y = LPV.simulate(u=U, kappa=KAPPA, dt=DT, x0=x0)
    expected = recursion(LPV, U, KAPPA, np.zeros(4) if x0 is None else x0)
    np.testing.assert_allclose(y, expected, rtol=1e-9, atol=1e-9)


def test_a_frozen_schedule_is_the_frozen_model():
    y = LPV.simulate(u=U, kappa=np.full(LENGTH, 0.7), dt=DT)
    np.testing.assert_allclose(y, LPV.at(0.7).simulate(u=U, dt=DT), rtol=1e-9, atol=1e-9)


def test_several_scheduling_variables():
    points = [[0.0, 1.0], [1.0, 1.0], [0.0, 2.0], [1.0, 2.0], [0.5, 1.5], [0.2, 1.9]]
    lpv = modal_lpv(points)
    assert lpv.n_scheduling == 2
    kappa = np.stack([KAPPA, 2.0 - KAPPA], axis=1)
    y = lpv.simulate(u=U, kappa=kappa, dt=DT)
    np.testing.assert_allclose(y, recursion(lpv, U, kappa, np.zeros(4)), rtol=1e-9, atol=1e-9)
    with pytest.raises(ValueError, match=r"last axis must hold 2 values, got shape \(\)"):
        lpv.at(0.4)


def test_jit_and_vmap_leave_the_result_alone():
    expected = LPV.simulate(u=U, kappa=KAPPA, dt=DT)
    inputs = jnp.stack([jnp.asarray(U), 2.0 * jnp.asarray(U)])
    batch = jax.jit(jax.vmap(lambda u: LPV.simulate(u=u, kappa=KAPPA, dt=DT)))(inputs)
    np.testing.assert_allclose(batch[0], expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(batch[1], 2.0 * np.asarray(expected), rtol=1e-9, atol=1e-12)
    frozen = jax.vmap(LPV.at)(jnp.linspace(0.0, 1.0, 3)[:, None])
    np.testing.assert_allclose(frozen.A[1], LPV.at(0.5).A, rtol=1e-12)


@pytest.mark.slow
def test_gradients_are_those_of_finite_differences():
    @jax.jit
    def loss(coefficients, x0, kappa):
        lpv = eqx.tree_at(lambda m: m.coefficients, LPV, coefficients)
        return jnp.mean((lpv.simulate(u=U, kappa=kappa, dt=DT, x0=x0) - TARGET) ** 2)

    arguments = LPV.coefficients, jnp.full(4, 0.1), jnp.asarray(KAPPA)
    gradients = jax.jit(jax.grad(loss, argnums=(0, 1, 2)))(*arguments)
    step = 1e-6
    rng = np.random.default_rng(5)
    for index, gradient in enumerate(gradients):
        direction = rng.normal(size=gradient.shape)
        ahead, behind = (
            loss(*(a + s * step * direction if i == index else a for i, a in enumerate(arguments)))
            for s in (1.0, -1.0)
        )
        numeric = (ahead - behind) / (2 * step)
        np.testing.assert_allclose(np.sum(gradient * direction), numeric, rtol=1e-6)


def test_leaving_the_range_is_warned_of():
    with pytest.warns(UserWarning, match=r"100 % of the points lie outside the range \[0.\] to"):
        LPV.at(1.2)
    with pytest.warns(UserWarning, match="50 % of the points"):
        LPV.simulate(u=U[:4], kappa=[0.5, 0.6, 1.4, -0.4], dt=DT)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # A measured schedule may miss the end of its range by a hair; tracers are not looked at.
        LPV.at(1.0005)
        jax.jit(lambda kappa: LPV.at(kappa).A)(jnp.array([3.0]))
    np.testing.assert_array_equal(LPV.is_inside([0.5, 1.2, -0.1]), [True, False, False])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kappa": KAPPA[:-1]}, "kappa: 40 samples of 1 values are needed"),
        ({"kappa": 0.5}, "kappa: 40 samples"),
        ({"u": U[:, :1]}, "u: 2 inputs are needed, got 1"),
        ({"u": U[:, 0]}, "u: 2 inputs are needed, got 1"),
        ({"dt": 0.0}, "the sample time must be a positive number"),
        ({"x0": np.zeros(3)}, "x0"),
    ],
)
def test_signals_that_do_not_fit_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        LPV.simulate(**({"u": U, "kappa": KAPPA, "dt": DT} | options))


def test_many_points_give_a_batch_of_frozen_models():
    points = np.array([[0.1, 0.2, 0.9], [0.4, 0.5, 0.6]])
    frozen = LPV.at(points)
    assert frozen.batch_shape == (2, 3)
    np.testing.assert_allclose(frozen.C[1, 2], LPV.at(0.6).C, rtol=1e-12)
    assert LPV.is_stable(points).shape == (2, 3)
    assert (LPV.nx, LPV.nu, LPV.ny, LPV.dt) == (4, 2, 2, 0.0)


def test_inputs_schedules_and_first_states_may_be_batches():
    schedules = np.stack([KAPPA, KAPPA[::-1], np.full(LENGTH, 0.7)])
    x0 = RNG.normal(size=(3, 4))
    y = LPV.simulate(u=U, kappa=schedules, dt=DT, x0=x0)
    assert y.shape == (3, LENGTH, 2)
    for k in range(3):
        expected = recursion(LPV, U, schedules[k], x0[k])
        np.testing.assert_allclose(y[k], expected, rtol=1e-9, atol=1e-9)
    inputs = np.stack([U, 2.0 * U])[:, None]
    y = LPV.simulate(u=inputs, kappa=schedules, dt=DT)
    assert y.shape == (2, 3, LENGTH, 2)
    np.testing.assert_allclose(y[1], 2.0 * np.asarray(y[0]), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(y[0, 0], LPV.simulate(u=U, kappa=KAPPA, dt=DT), atol=1e-12)


def test_a_discretised_model_is_the_recursion_too():
    discrete = LPV.discretise(DT)
    assert discrete.dt == DT
    np.testing.assert_allclose(discrete.at(0.3).A, LPV.at(0.3).discretise(DT).A, rtol=1e-12)
    y = discrete.simulate(u=U, kappa=KAPPA)
    np.testing.assert_allclose(y, LPV.simulate(u=U, kappa=KAPPA, dt=DT), rtol=1e-9, atol=1e-12)
    with pytest.raises(ValueError, match="in discrete time already"):
        discrete.discretise(DT)
    with pytest.raises(ValueError, match="leave dt out"):
        discrete.simulate(u=U, kappa=KAPPA, dt=2 * DT)
    with pytest.raises(ValueError, match="hold: a discrete-time model"):
        discrete.simulate(u=U, kappa=KAPPA, hold=LinearSchedule())
    with pytest.raises(ValueError, match="give the sample time"):
        LPV.simulate(u=U, kappa=KAPPA)
    with pytest.raises(ValueError, match="substeps: one at least"):
        LinearSchedule(substeps=0)


# Long samples, so that the way κ takes between them matters.
COARSE = 0.05


def integrated(lpv, u, kappa, dt):
    """ẋ = A(κ(t)) x + B(κ(t)) u with κ on straight lines between samples, by SciPy."""
    x, outputs = np.zeros(4), []
    matrices = jax.jit(lambda k: lpv.structure.matrices(lpv.parameters(k)))
    for t in range(len(u)):
        frozen = matrices(kappa[t])
        outputs.append(frozen.C @ x + frozen.D @ u[t])
        step = kappa[t + 1] - kappa[t] if t + 1 < len(u) else 0.0

        def rate(time, x, t=t, step=step):
            frozen = matrices(kappa[t] + step * time / dt)
            return frozen.A @ x + frozen.B @ u[t]

        x = scipy.integrate.solve_ivp(rate, (0.0, dt), x, rtol=1e-10, atol=1e-12).y[:, -1]
    return np.stack(outputs)


@pytest.mark.slow
def test_a_linear_schedule_is_the_differential_equation_to_fourth_order():
    u, kappa = U[:8], KAPPA[:32:4]
    expected = integrated(LPV, u, kappa, COARSE)
    held = LPV.simulate(u=u, kappa=kappa, dt=COARSE)
    one, two, eight = (
        LPV.simulate(u=u, kappa=kappa, dt=COARSE, hold=LinearSchedule(substeps))
        for substeps in (1, 2, 8)
    )
    errors = [np.abs(np.asarray(y) - expected).max() for y in (held, one, two, eight)]
    assert errors[3] < 1e-5 * errors[0]
    # Between one and two substeps an error of fourth order falls by 16.
    assert errors[2] < errors[1] / 8.0


def test_one_dimensional_input_is_one_channel():
    structure = FreeStructure(n_states=1, n_inputs=1, n_outputs=1, feedthrough=False)
    coefficients = jnp.array([[-3.0, 1.0, 1.0], [1.0, 0.0, 0.0]])
    basis = polynomial_basis([0.0, 2.0], 1)
    lpv = LPVStateSpace(structure, basis, coefficients, jnp.zeros(1), jnp.full(1, 2.0))
    y = lpv.simulate(u=np.ones(3), kappa=[1.0, 1.0, 1.0], dt=0.1)
    np.testing.assert_allclose(y[:, 0], (1 - np.exp(-0.3 * np.arange(3))) / 3.0, atol=1e-12)


def test_stable_points_do_not_hide_an_unstable_model_between_them():
    structure = FreeStructure(n_states=1, n_inputs=1, n_outputs=1, feedthrough=False)
    # A(κ) = 0.5 − κ²: stable at the ends only.
    coefficients = jnp.array([[0.5, 1.0, 1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    basis = polynomial_basis([-1.0, 0.0, 1.0], 2)
    lpv = LPVStateSpace(structure, basis, coefficients, -jnp.ones(1), jnp.ones(1))
    np.testing.assert_array_equal(lpv.is_stable([[-1.0], [0.0], [1.0]]), [True, False, True])
    assert lpv.is_stable(1.0).shape == ()
