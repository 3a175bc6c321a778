"""Alignment and averages: exact on similar models, better than single ones on noisy models."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from lpvid.models import (
    AlignedAverage,
    NaiveAverage,
    ResponseAverage,
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


def growing(dt):
    """The flexible model with some of its poles on the unstable side."""
    truth = flexible()
    truth = StateSpace(truth.A + 2.0 * np.eye(6), truth.B, truth.C, truth.D)
    assert not truth.is_stable() and np.min(np.real(truth.poles())) < 0.0
    return truth.discretise(dt) if dt else truth


@pytest.mark.parametrize("dt", [0.0, 0.02])
def test_alignment_takes_unstable_models(dt):
    reference = growing(dt)
    T = np.random.default_rng(0).normal(size=(6, 6))
    aligned = align(reference.transform(T), reference)
    for mine, theirs in zip(matrices(aligned), matrices(reference), strict=True):
        np.testing.assert_allclose(mine, theirs, atol=1e-8 * np.abs(theirs).max())


@pytest.mark.slow
@pytest.mark.parametrize("method", [AlignedAverage, ResponseAverage])
def test_unstable_models_count_when_the_plant_is_unstable(method):
    truth = growing(0.0)
    rng = np.random.default_rng(0)
    systems = []
    for _ in range(20):
        A, B, C, D = (
            m + 2e-3 * np.abs(m).max() * rng.normal(size=m.shape) for m in matrices(truth)
        )
        systems.append(StateSpace(A, B, C, D).transform(rng.normal(size=A.shape)))
    with pytest.raises(ValueError, match="keep_unstable=True"):
        average(systems, method())
    single = np.median([relative_error(system, truth) for system in systems])
    # 1/√20 of a single one's error, and a factor of 1.8 for chance.
    mean = average(systems, method(keep_unstable=True))
    assert relative_error(mean, truth) < 1.8 / np.sqrt(20) * single


@pytest.mark.slow
@pytest.mark.parametrize("method", [AlignedAverage(), ResponseAverage()], ids=["basis", "response"])
def test_averages_gain_with_the_root_of_the_number_of_models(method):
    truth = near_twins()
    errors = {
        runs: np.median(
            [
                relative_error(average(noisy(truth, runs, 3e-4, seed=s), method), truth)
                for s in range(4)
            ]
        )
        for runs in (4, 64)
    }
    # √16 = 4, and what four repetitions leave to chance.
    assert 2.5 < errors[4] / errors[64] < 6.0


@pytest.mark.slow
def test_the_response_average_is_the_least_squares_fit_to_the_mean_response():
    systems = [StateSpace([[-1.0]], [[1.0]], [[1.0]]), StateSpace([[-2.0]], [[3.0]], [[1.0]])]
    omega = np.geomspace(0.05, 20.0, 40)
    weights = np.linspace(1.0, 2.0, 40)
    mean = sum(1.0 * g / (1j * omega + p) for p, g in ((1.0, 1.0), (2.0, 3.0))) / 2.0

    def residual(x):
        error = weights * (x[1] / (1j * omega + x[0]) - mean)
        return np.concatenate([error.real, error.imag])

    wanted = scipy.optimize.least_squares(residual, [1.5, 2.0], xtol=1e-12, ftol=1e-12).x
    model = average(systems, ResponseAverage(omega=omega, weights=weights[:, None, None]))
    np.testing.assert_allclose(-model.A.item(), wanted[0], rtol=1e-4)
    np.testing.assert_allclose((model.C @ model.B).item(), wanted[1], rtol=1e-4)
    assert model.D.item() == 0.0


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
    for method in (
        AlignedAverage(),
        NaiveAverage(),
        AlignedAverage(reference=truth),
        ResponseAverage(),
    ):
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
    with pytest.raises(ValueError, match="frequencies"):
        ResponseAverage(frequencies=0)
    with pytest.raises(ValueError, match="weights: give the frequencies"):
        ResponseAverage(weights=np.ones((3, 2, 2)))
    with pytest.raises(ValueError, match=r"weights: shape \(2, 2, 2\)"):
        average([system], ResponseAverage(omega=[1.0, 2.0], weights=np.ones((3, 2, 2))))


@pytest.mark.slow
def test_a_failed_response_average_is_said():
    # Between two resonances the mean's phase turns backwards: one mode fits it unstably.
    modes = [
        StateSpace([[0.0, w], [-w, -0.02 * w]], [[0.0], [1.0]], [[w, 0.0]]) for w in (1.0, 1.2)
    ]
    with pytest.warns(UserWarning, match="the aligned average is returned"):
        mean = average(modes, ResponseAverage(omega=np.linspace(1.05, 1.15, 9)))
    np.testing.assert_allclose(mean.A, average(modes).A)
