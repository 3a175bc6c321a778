"""Structures: their matrices by hand, what every parameter value must be, and the way back."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lpvid.models import (
    FreeStructure,
    FunctionStructure,
    MechanicalStructure,
    ModalStructure,
    StateSpace,
)

from .systems import flexible, matrices

OMEGA = np.geomspace(0.1, 200.0, 40)
KEY = jax.random.key(0)


def response(system, omega=OMEGA):
    A, B, C, D = matrices(system)
    eye = np.eye(A.shape[0])
    return np.stack([C @ np.linalg.solve(1j * w * eye - A, B) + D for w in omega])


def same_response(first, second, rtol=1e-9):
    expected = response(second)
    assert np.abs(response(first) - expected).max() < rtol * np.abs(expected).max()


# --- free


def test_free_structure_lays_out_its_entries_row_by_row():
    structure = FreeStructure(n_states=2, n_inputs=1, n_outputs=1)
    model = structure.matrices(jnp.arange(1.0, 10.0))
    A, B, C, D = matrices(model)
    np.testing.assert_array_equal(A, [[1, 2], [3, 4]])
    np.testing.assert_array_equal(B, [[5], [6]])
    np.testing.assert_array_equal(C, [[7, 8]])
    np.testing.assert_array_equal(D, [[9]])
    assert structure.parameter_names[:5] == ("A[0,0]", "A[0,1]", "A[1,0]", "A[1,1]", "B[0,0]")
    np.testing.assert_array_equal(structure.parameters_of(model), np.arange(1.0, 10.0))


def test_free_structure_without_feedthrough():
    structure = FreeStructure(2, 1, 1, feedthrough=False)
    assert structure.n_parameters == 8
    assert structure.matrices(jnp.ones(8)).D.item() == 0.0


def test_free_structure_refuses_models_of_another_size():
    structure = FreeStructure(2, 1, 1)
    with pytest.raises(ValueError, match=r"\(2, 1, 1\) is needed, got \(6, 2, 2\)"):
        structure.parameters_of(flexible())
    with pytest.raises(ValueError, match="dt=0.1"):
        structure.parameters_of(StateSpace(-np.eye(2), np.ones((2, 1)), np.ones((1, 2)), dt=0.1))


def test_starts_of_a_free_structure_are_the_model_itself():
    model = flexible(modes=1, nu=1, ny=1)
    structure = FreeStructure(2, 1, 1)
    starts = structure.starts(KEY, 3, model)
    assert starts.shape == (3, 9)
    np.testing.assert_array_equal(structure.matrices(starts[2]).A, model.A)


# --- functions


def pendulum(p):
    return (jnp.array([[0.0, 1.0], [-p[0], -p[1]]]), jnp.eye(2)[:, 1:], jnp.eye(2)[:1])


def test_function_structure_builds_what_the_function_says():
    structure = FunctionStructure(pendulum, nominal=[9.0, 0.5], names=("stiffness", "damping"))
    np.testing.assert_allclose(
        structure.matrices(jnp.array([4.0, 3.0])).poles(),
        [-1.5 + 7**0.5 / 2 * 1j, -1.5 - 7**0.5 / 2 * 1j],
    )
    assert structure.parameter_names == ("stiffness", "damping")
    lower, upper = structure.bounds()
    assert np.all(np.isneginf(lower)) and np.all(np.isposinf(upper))


def test_starts_of_a_function_structure_scatter_within_the_bounds():
    structure = FunctionStructure(pendulum, nominal=[9.0, -0.5], lower=[5.0, -1.0], upper=10.0)
    starts = np.asarray(structure.starts(KEY, 200, flexible()))
    np.testing.assert_array_equal(starts[0], [9.0, -0.5])
    assert starts[:, 0].min() == 5.0 and starts[:, 0].max() == 10.0
    assert np.all(starts[:, 1] < 0) and starts[:, 1].min() == -1.0
    assert np.unique(starts[:, 1]).size > 100


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"names": ("one",)}, "names: 1 given for 2"),
        ({"lower": [0.0, 0.0, 0.0]}, "lower: shape"),
        ({"upper": [[1.0, 1.0]]}, "upper: shape"),
        ({"lower": [10.0, 0.0]}, "nominal: lies outside"),
        ({"nominal": [[1.0, 2.0]]}, "nominal: a vector"),
    ],
)
def test_impossible_function_structures_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        FunctionStructure(pendulum, **({"nominal": [9.0, 0.5]} | options))


def test_a_structure_may_be_built_inside_of_jit():
    def slowest(nominal):
        structure = FunctionStructure(pendulum, nominal=nominal, lower=0.0)
        return structure.matrices(structure.nominal).A[1, 0]

    assert jax.jit(slowest)(jnp.array([3.0, 1.0])) == -3.0


def test_structures_without_a_start_rule_say_what_to_give():
    from lpvid.mechanics import TwoLinkArmStructure

    with pytest.raises(ValueError, match="TwoLinkArmStructure has no start rule: give `initial=`"):
        TwoLinkArmStructure((1.0, 1.0)).starts(KEY, 2, flexible())


# --- modal


def test_modal_matrices_by_hand():
    structure = ModalStructure(2, n_inputs=2, n_outputs=1, feedthrough=True, reference_input=1)
    first = [np.log(3.0), np.log(0.1), 1.0, 2.0, 5.0, 6.0]
    second = [np.log(7.0), np.log(0.5), 3.0, 4.0, 7.0, 8.0]
    model = structure.matrices(jnp.array([*first, *second, 0.25, 0.5]))
    A, B, C, D = matrices(model)
    expected = [[0, 3, 0, 0], [-3, -0.6, 0, 0], [0, 0, 0, 7], [0, 0, -7, -7]]
    np.testing.assert_allclose(A, expected, atol=1e-12)
    np.testing.assert_allclose(B, [[5, 0], [6, 1], [7, 0], [8, 1]])
    np.testing.assert_allclose(C, [[1, 2, 3, 4]])
    np.testing.assert_allclose(D, [[0.25, 0.5]])
    names = structure.parameter_names
    assert len(names) == 14 and len(set(names)) == 14
    assert names[:4] == (
        "mode 1 log frequency",
        "mode 1 log damping",
        "mode 1 C[0,0]",
        "mode 1 C[0,1]",
    )
    assert names[4:6] == ("mode 1 B[0,0]", "mode 1 B[1,0]")
    assert names[-2:] == ("D[0,0]", "D[0,1]")


def overdamped(seed, nu, ny):
    """Two complex pairs and four real poles, in a random basis."""
    rng = np.random.default_rng(seed)
    A = np.diag([-1.0, -3.0, -20.0, -90.0, 0, 0, 0, 0])
    A[4:6, 4:6] = [[-0.5, 12.0], [-12.0, -0.5]]
    A[6:8, 6:8] = [[-4.0, 45.0], [-45.0, -4.0]]
    T = rng.normal(size=(8, 8)) + 3 * np.eye(8)
    B, C = rng.normal(size=(8, nu)), rng.normal(size=(ny, 8))
    return StateSpace(
        T @ A @ np.linalg.inv(T), T @ B, C @ np.linalg.inv(T), rng.normal(size=(ny, nu))
    )


@pytest.mark.parametrize(("nu", "ny", "reference"), [(1, 1, 0), (2, 3, 0), (3, 2, 2)])
@pytest.mark.parametrize("make", [overdamped, None], ids=["real poles", "flexible"])
def test_modal_parameters_hold_the_transfer_function(make, nu, ny, reference):
    model = flexible(3, modes=4, nu=nu, ny=ny) if make is None else make(5, nu, ny)
    structure = ModalStructure(4, nu, ny, feedthrough=True, reference_input=reference)
    parameters = structure.parameters_of(model)
    assert parameters.shape == (structure.n_parameters,)
    same_response(structure.matrices(parameters), model)
    frequencies = structure.split(parameters)[0]
    assert np.all(np.diff(frequencies) > 0)


def test_modal_parameters_are_their_own_round_trip():
    structure = ModalStructure(3, 2, 2, feedthrough=True)
    parameters = structure.parameters_of(flexible(1))
    again = structure.parameters_of(structure.matrices(parameters))
    np.testing.assert_allclose(again, parameters, rtol=1e-9, atol=1e-9)


def test_modal_structure_drops_a_feedthrough_it_has_not():
    structure = ModalStructure(3, 2, 2)
    model = flexible(1)
    found = structure.matrices(structure.parameters_of(model))
    np.testing.assert_array_equal(found.D, 0.0)
    np.testing.assert_allclose(response(found) + np.asarray(model.D), response(model), atol=1e-9)


def test_modal_starts_take_the_strongest_modes():
    structure = ModalStructure(2, 2, 2, feedthrough=True)
    strong = flexible(2, modes=2)
    weak = StateSpace(
        [[-1.0, 0.0, 0.0], [0.0, -2.0, 90.0], [0.0, -90.0, -2.0]],
        1e-3 * np.ones((3, 2)),
        np.ones((2, 3)),
    )
    starts = structure.starts(KEY, 5, strong + weak)
    assert starts.shape == (5, structure.n_parameters)
    same_response(structure.matrices(starts[0]), strong)
    assert np.all(np.std(starts, axis=0) > 0)


def test_modal_starts_keep_the_strongest_of_real_pairs_too():
    structure = ModalStructure(1, 1, 1)
    slow = StateSpace(np.diag([-1.0, -3.0]), np.ones((2, 1)), [[5.0, -2.0]])
    fast = StateSpace([[-0.5, 80.0], [-80.0, -0.5]], [[0.0], [1.0]], [[1e-4, 0.0]])
    same_response(structure.matrices(structure.starts(KEY, 1, slow + fast)[0]), slow)


def test_an_unstable_mode_becomes_a_stable_one():
    model = StateSpace([[0.2, 5.0], [-5.0, 0.2]], [[0.0], [1.0]], [[1.0, 0.0]])
    structure = ModalStructure(1, 1, 1)
    found = structure.matrices(structure.parameters_of(model))
    assert bool(found.is_stable())
    np.testing.assert_allclose(np.abs(found.poles()), np.hypot(0.2, 5.0))


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (flexible(modes=2), "order 6 is needed, got order 4"),
        (flexible(modes=3).discretise(0.01), "dt=0.01"),
        (flexible(modes=3, nu=1), "2 inputs and 2 outputs are needed, got 1 and 2"),
        (
            StateSpace(np.diag([0.0, -1, -2, -3, -4, -5.0]), np.ones((6, 2)), np.ones((2, 6))),
            "a pole at zero",
        ),
        (
            StateSpace(-np.diag(np.arange(1.0, 7)), np.eye(6)[:, :2], np.ones((2, 6))),
            "input 0 does not excite",
        ),
    ],
)
def test_models_that_are_no_modal_structure_are_refused(model, message):
    with pytest.raises(ValueError, match=message):
        ModalStructure(3, 2, 2).parameters_of(model)


def test_impossible_modal_structures_are_refused():
    with pytest.raises(ValueError, match="n_modes"):
        ModalStructure(0, 1, 1)
    with pytest.raises(ValueError, match="reference_input: 1 is not one of 1"):
        ModalStructure(1, 1, 1, reference_input=1)
    with pytest.raises(ValueError, match="has 1 modes, the structure 2"):
        ModalStructure(2, 2, 2).starts(KEY, 1, flexible(modes=1))


# --- mechanical

numbers = st.lists(st.floats(-2.0, 2.0), min_size=18, max_size=18)


@settings(max_examples=20, deadline=None)
@given(numbers)
def test_mechanical_matrices_are_positive_definite_for_any_parameters(values):
    structure = MechanicalStructure(3)
    parameters = jnp.asarray(values)
    parts = structure.mechanical_matrices(parameters)
    for part in parts:
        np.testing.assert_allclose(part, part.T)
        assert np.linalg.eigvalsh(part).min() > 0
    np.testing.assert_allclose(structure.parameters_of(*parts), parameters, atol=1e-9)
    poles = np.asarray(structure.matrices(parameters).poles())
    assert poles.real.max() < 0


@pytest.mark.parametrize(
    ("measured", "power"), [("displacement", 0), ("velocity", 1), ("acceleration", 2)]
)
def test_mechanical_response_is_the_dynamic_stiffness_inverted(measured, power):
    rng = np.random.default_rng(1)
    mass, damping, stiffness = (
        scale * (part @ part.T + np.eye(3))
        for scale, part in zip((1.0, 2.0, 400.0), rng.normal(size=(3, 3, 3)), strict=True)
    )
    structure = MechanicalStructure(3, measured)
    model = structure.matrices(structure.parameters_of(mass, damping, stiffness))
    expected = np.stack(
        [
            (1j * w) ** power * np.linalg.inv(-(w**2) * mass + 1j * w * damping + stiffness)
            for w in OMEGA
        ]
    )
    np.testing.assert_allclose(response(model), expected, rtol=1e-9, atol=1e-12)


def test_mechanical_starts_have_the_size_of_the_plant():
    mass, damping, stiffness = 2.0, 3.0, 800.0
    for measured in ("displacement", "velocity", "acceleration"):
        structure = MechanicalStructure(1, measured)
        truth = structure.parameters_of(*(jnp.array([[v]]) for v in (mass, damping, stiffness)))
        starts = structure.starts(KEY, 4, structure.matrices(truth))
        assert starts.shape == (4, 3)
        np.testing.assert_allclose(np.exp(2 * starts[0])[[0, 2]], [mass, stiffness], rtol=0.02)


def test_impossible_mechanical_structures_are_refused():
    with pytest.raises(ValueError, match="n_degrees"):
        MechanicalStructure(0)
    with pytest.raises(ValueError, match="'force' is not one of displacement"):
        MechanicalStructure(1, "force")
    with pytest.raises(ValueError, match="damping: it is not positive definite"):
        MechanicalStructure(2).parameters_of(jnp.eye(2), -jnp.eye(2), jnp.eye(2))
