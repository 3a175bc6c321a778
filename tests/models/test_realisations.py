"""Gramians, balanced and modal realisations against python-control and known forms."""

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpvid.models import StateSpace, balance, gramians, modal_form, to_control

from .systems import batch, flexible, matrices

OMEGA = np.array([0.0, 5.0, 30.0])


@pytest.mark.parametrize("dt", [0.0, 0.02])
def test_gramians_agree_with_control(dt):
    systems = batch(2, dt=dt)
    for ours, kind in zip(gramians(systems), "co", strict=True):
        for k in range(2):
            one = to_control(jax.tree.map(lambda leaf, k=k: leaf[k], systems))
            expected = control.gram(one, kind)
            np.testing.assert_allclose(ours[k], expected, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("dt", [0.0, 0.02])
def test_balanced_realisation(dt):
    systems = batch(3, dt=dt)
    balanced, hankel = balance(systems)
    assert np.all(np.diff(hankel, axis=-1) < 0.0)
    for gramian in gramians(balanced):
        for k in range(3):
            np.testing.assert_allclose(gramian[k], np.diag(hankel[k]), atol=1e-9 * hankel[k, 0])
    np.testing.assert_allclose(
        balanced.frequency_response(OMEGA), systems.frequency_response(OMEGA), atol=1e-9
    )
    rows = np.asarray(balanced.B)
    largest = np.take_along_axis(rows, np.abs(rows).argmax(-1)[..., None], -1)
    assert np.all(largest > 0.0)
    first, second = (np.asarray(gramian[1]) for gramian in gramians(systems))
    expected = np.sort(np.sqrt(np.linalg.eigvals(first @ second).real))[::-1]
    np.testing.assert_allclose(hankel[1], expected, rtol=1e-8)


def test_balanced_realisation_does_not_depend_on_the_basis():
    system = flexible()
    T = np.random.default_rng(0).normal(size=(6, 6))
    first, second = balance(system)[0], balance(system.transform(T))[0]
    for mine, theirs in zip(matrices(first), matrices(second), strict=True):
        np.testing.assert_allclose(mine, theirs, atol=1e-8 * np.abs(mine).max())


def test_unstable_models_have_no_balanced_form():
    balanced, hankel = balance(StateSpace([[0.1]], [[1.0]], [[1.0]]))
    assert np.isnan(hankel).all() and np.isnan(balanced.A).all()


def test_hankel_singular_values_differentiate():
    system, step = flexible(modes=1), 1e-6
    change = jnp.asarray(np.random.default_rng(1).normal(size=(2, 2)))

    @jax.jit
    def value(A):
        return balance(StateSpace(A, system.B, system.C))[1]

    _, tangent = jax.jvp(value, (system.A,), (change,))
    expected = (value(system.A + step * change) - value(system.A - step * change)) / (2 * step)
    np.testing.assert_allclose(tangent, expected, rtol=1e-6)


def test_modal_form_has_the_blocks():
    T = np.random.default_rng(2).normal(size=(6, 6))
    system = flexible()
    modal = modal_form(system.transform(T))
    # The test system is block diagonal in this form already, up to the order of its blocks.
    np.testing.assert_allclose(modal.A, modal_form(system).A, atol=1e-9)
    np.testing.assert_allclose(modal.B, modal_form(system).B, atol=1e-9)
    np.testing.assert_allclose(modal.A, system.A, atol=1e-9)
    np.testing.assert_allclose(
        modal.frequency_response(OMEGA), system.frequency_response(OMEGA), atol=1e-10
    )
    for k in range(0, 6, 2):
        row, column = modal.B[k : k + 2], modal.C[:, k : k + 2]
        assert np.linalg.norm(row) == pytest.approx(np.linalg.norm(column))


def test_modal_form_of_real_and_mixed_poles_in_a_batch():
    A = np.stack([[[-1.0, 2.0], [0.0, -3.0]], [[0.0, 1.0], [-5.0, -2.0]]])
    systems = StateSpace(A, [[0.0], [1.0]], [[1.0, 0.0]])
    modal = modal_form(systems)
    np.testing.assert_allclose(modal.A[0], np.diag([-1.0, -3.0]), atol=1e-14)
    np.testing.assert_allclose(modal.A[1], [[-1.0, 2.0], [-2.0, -1.0]], atol=1e-14)
    np.testing.assert_allclose(
        modal.frequency_response(OMEGA), systems.frequency_response(OMEGA), atol=1e-14
    )


def test_modal_form_refuses_defective_and_traced_matrices():
    with pytest.raises(ValueError, match="double integrator"):
        modal_form(StateSpace([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [[1.0, 0.0]]))
    with pytest.raises(ValueError, match="outside jit"):
        jax.jit(modal_form)(flexible())
