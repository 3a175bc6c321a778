"""Alignment and averages: exact on similar models, better than single ones on noisy models."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpvid.models import (
    AlignedAverage,
    NaiveAverage,
    StateSpace,
    align,
    average,
    balance,
)

from .systems import flexible, matrices

OMEGA = 2 * np.pi * np.linspace(0.0, 12.0, 300)


def relative_error(system, truth):
    response = truth.frequency_response(OMEGA)
    error = jnp.linalg.norm(system.frequency_response(OMEGA) - response, 2, axis=(-2, -1))
    return float(jnp.max(error) / jnp.max(jnp.linalg.norm(response, 2, axis=(-2, -1))))


def near_twins():
    """Two modes with nearly equal Hankel singular values: their balanced basis is undetermined."""
    blocks = np.zeros((4, 4))
    for k, frequency in enumerate((20.0, 30.0)):
        damping = 0.05 * frequency
        blocks[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = [
            [-damping, frequency],
            [-frequency, -damping],
        ]
    B = np.array([[1.0, 0.5], [0.0, 0.3], [1.2, -0.6], [0.1, 0.4]])
    return StateSpace(blocks, B, B.T)


def noisy(truth, count, level, seed=0):
    """Models scattered about the truth, each in a basis of its own."""
    rng = np.random.default_rng(seed)
    reference, _ = balance(truth)
    systems = []
    for _ in range(count):
        A, B, C, D = (
            m + level * np.abs(m).max() * rng.normal(size=m.shape) for m in matrices(reference)
        )
        T = rng.normal(size=A.shape)
        systems.append(StateSpace(A, B, C, D, dt=truth.dt).transform(T))
    return systems


@pytest.mark.parametrize("dt", [0.0, 0.02])
def test_alignment_undoes_any_change_of_basis(dt):
    reference = flexible().discretise(dt) if dt else flexible()
    T = np.random.default_rng(0).normal(size=(6, 6))
    aligned = align(reference.transform(T), reference)
    for mine, theirs in zip(matrices(aligned), matrices(reference), strict=True):
        np.testing.assert_allclose(mine, theirs, atol=1e-8 * np.abs(theirs).max())


@pytest.mark.parametrize("dt", [pytest.param(0.0, marks=pytest.mark.slow), 0.02])
def test_the_aligned_average_beats_single_models_and_the_naive_average(dt):
    truth = near_twins().discretise(dt) if dt else near_twins()
    systems = noisy(truth, 40, 0.003)
    single = np.median([relative_error(system, truth) for system in systems])
    aligned = relative_error(average(systems), truth)
    naive = relative_error(average(systems, NaiveAverage()), truth)
    assert aligned < 0.5 * single
    assert naive > 2.0 * single


def test_a_given_reference_sets_the_basis():
    truth = flexible().discretise(0.02)
    systems = [truth.transform(np.random.default_rng(k).normal(size=(6, 6))) for k in range(3)]
    mean = average(systems, AlignedAverage(reference=truth))
    np.testing.assert_allclose(mean.A, truth.A, atol=1e-8)
    np.testing.assert_allclose(mean.B, truth.B, atol=1e-8)


@pytest.mark.slow
def test_failed_models_are_left_out_and_batches_are_taken():
    truth = flexible().discretise(0.02)
    systems = [truth, truth.transform(-2.0 * np.eye(6))]
    failed = jax.tree.map(lambda leaf: jnp.nan * leaf, truth)
    unstable = StateSpace(1.2 * truth.A, truth.B, truth.C, dt=0.02)
    stacked = jax.tree.map(lambda *m: jnp.stack(m), failed, *systems, unstable)
    for method in (AlignedAverage(), NaiveAverage(), AlignedAverage(reference=truth)):
        assert relative_error(average(stacked, method), truth) < 1e-8
    inside = jax.jit(average)(stacked)
    assert relative_error(inside, truth) < 1e-8
    with pytest.raises(ValueError, match="None of the models"):
        average([failed, unstable])
    assert np.isnan(jax.jit(average)([failed, unstable]).A).all()


def test_faults_are_named():
    system = flexible()
    with pytest.raises(ValueError, match="empty"):
        average([])
    with pytest.raises(ValueError, match="single model"):
        average(system)
    with pytest.raises(ValueError, match="must agree"):
        average([system, flexible(modes=2)])
    with pytest.raises(ValueError, match="must agree"):
        align(system, system.discretise(0.1))
    with pytest.raises(ValueError, match="rounds"):
        AlignedAverage(rounds=0)
