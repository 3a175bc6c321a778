"""Modes and what is left of them, against complex arithmetic, residues and the tables of 002."""

import hypothesis.strategies as st
import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis.extra.numpy import arrays

from lpvid._results import Status
from lpvid.data import IOData
from lpvid.models import StateSpace
from lpvid.reduce import (
    AbstractModeRank,
    KnownFrequencies,
    ModalHankelValue,
    ModalResponseMagnitude,
    ModeSingularValue,
    hankel_singular_values,
    modal_responses,
    modal_table,
    modal_truncation,
)

DT = 0.1
OMEGA = np.linspace(0.05, np.pi / DT, 300)


def built(blocks, seed=0, dt=DT, nu=2, ny=2, **options):
    """A model with the given blocks in a random basis."""
    rng = np.random.default_rng(seed)
    nx = sum(len(b) for b in blocks)
    A, start = np.zeros((nx, nx)), 0
    for block in blocks:
        stop = start + len(block)
        A[start:stop, start:stop] = block
        start = stop
    T = rng.standard_normal((nx, nx)) + 3.0 * np.eye(nx)
    B, C = rng.standard_normal((nx, nu)), rng.standard_normal((ny, nx))
    D = options.get("D", rng.standard_normal((ny, nu)))
    return StateSpace(T @ A @ np.linalg.inv(T), T @ B, C @ np.linalg.inv(T), D, dt=dt)


def pair(radius, angle):
    real, imag = radius * np.cos(angle), radius * np.sin(angle)
    return [[real, imag], [-imag, real]]


@pytest.fixture(scope="module")
def model():
    """Two pairs and two real poles, one of those negative; D."""
    return built([pair(0.97, 0.6), [[0.4]], pair(0.8, 0.2), [[-0.5]]])


@pytest.fixture(scope="module")
def data():
    rng = np.random.default_rng(1)
    u = [rng.standard_normal((n, 2)) for n in (60, 45)]
    return IOData(u=u, y=[np.zeros((len(v), 2)) for v in u], dt=DT)


@pytest.fixture(scope="module")
def x0():
    return np.random.default_rng(2).standard_normal((2, 6))


def residues(model):
    """Poles with Re and Im, and the rank-one residue of each, by NumPy."""
    poles, vectors = np.linalg.eig(np.asarray(model.A))
    rows = np.linalg.solve(vectors, np.asarray(model.B).astype(complex))
    columns = np.asarray(model.C) @ vectors
    return poles, vectors, rows, columns


def brute_force(model, data, x0):
    """Each pole's output by recursion in complex numbers, the records one after another."""
    poles, vectors, rows, columns = residues(model)
    outputs = []
    for record, start in zip(data.records, x0, strict=True):
        eta, found = np.linalg.solve(vectors, start.astype(complex)), []
        for u in np.asarray(record.u):
            found.append(columns * eta[None])
            eta = poles * eta + rows @ u
        outputs += found
    return poles, np.moveaxis(np.array(outputs), 2, 0)


def test_modal_responses_are_those_of_complex_arithmetic_and_sum_to_the_response(model, data, x0):
    table = modal_table(model, data, x0=x0)
    found = np.asarray(modal_responses(model, data, x0=x0))
    poles, single = brute_force(model, data, x0)
    for i, pole in enumerate(np.asarray(table.poles)):
        of_mode = np.isclose(poles, pole) | np.isclose(poles, pole.conj())
        assert of_mode.sum() == table.sizes[i]
        expected = single[of_mode].sum(axis=0)
        np.testing.assert_allclose(expected.imag, 0.0, atol=1e-12)
        np.testing.assert_allclose(found[i], expected.real, atol=1e-11)
        magnitude = np.abs(expected.real).mean(axis=0).max()
        assert float(table.response_magnitude[i]) == pytest.approx(magnitude, rel=1e-10)
    first = data.records[0]
    whole = np.asarray(model.simulate(u=first.u, x0=x0[0]))
    direct = np.asarray(first.u) @ np.asarray(model.D).T
    np.testing.assert_allclose(found[:, :60].sum(axis=0) + direct, whole, atol=1e-11)


def test_measures_and_frequencies_are_those_of_their_formulas(model, data):
    table = modal_table(model, data)
    poles, _, rows, columns = residues(model)
    for i, pole in enumerate(np.asarray(table.poles)):
        k = np.argmin(np.abs(poles - pole))
        powers = np.sum(np.abs(pole) ** np.arange(60 - 1))
        size = np.linalg.norm(columns[:, k]) * powers * np.linalg.norm(rows[k])
        assert float(table.singular_value[i]) == pytest.approx(np.sqrt(size), rel=1e-10)
        s = np.log(complex(pole)) / DT
        assert float(table.frequency[i]) == pytest.approx(abs(s))
        assert float(table.damping[i]) == pytest.approx(-s.real / abs(s))
        alone = modal_truncation(model, table.sizes[i], rank=_Only(i)).model
        expected = np.asarray(hankel_singular_values(alone))
        np.testing.assert_allclose(table.hankel_values[i][: expected.size], expected, rtol=1e-8)
    assert np.all(np.diff(table.frequency) > 0.0)
    assert table.status == Status.successful


class _Only(AbstractModeRank):
    number: int

    def scores(self, table):
        return np.arange(len(table.sizes)) == self.number + 0.0


def response(model):
    A, B, C, D = (np.asarray(getattr(model, name)) for name in "ABCD")
    points = np.exp(1j * OMEGA * DT)[:, None, None]
    return C @ np.linalg.solve(points * np.eye(A.shape[0]) - A, B[None]) + D


@pytest.mark.parametrize("order", [1, 4, 5, 6])
def test_a_truncation_is_the_sum_of_the_strongest_residues(model, data, order):
    reduction = modal_truncation(model, order, data=data)
    poles, _, rows, columns = residues(model)
    magnitudes = np.asarray(reduction.table.response_magnitude)
    left, expected = order, np.tile(np.asarray(model.D).astype(complex), (OMEGA.size, 1, 1))
    for i in np.argsort(-magnitudes):
        if reduction.table.sizes[i] > left:
            continue
        left -= reduction.table.sizes[i]
        pole = complex(reduction.table.poles[i])
        for k in np.flatnonzero(np.isclose(poles, pole) | np.isclose(poles, np.conj(pole))):
            residue = np.outer(columns[:, k], rows[k])
            expected = expected + residue / (np.exp(1j * OMEGA * DT) - poles[k])[:, None, None]
    assert reduction.model.nx == order - left
    found = response(reduction.model)
    np.testing.assert_allclose(found, expected, atol=1e-10)
    gap = np.linalg.norm(found - response(model), 2, axis=(1, 2)).max()
    assert gap <= float(reduction.bound) * (1 + 1e-9) + 1e-10
    if order == model.nx:
        assert float(reduction.bound) == 0.0


def test_a_sampled_continuous_model_has_the_modes_of_the_continuous_one(data):
    blocks = [[[-0.3, 4.0], [-4.0, -0.3]], [[-2.0]]]
    continuous = built(blocks, dt=0.0)
    matrices = tuple(np.asarray(getattr(continuous, name)) for name in "ABCD")
    sampled = StateSpace(*scipy.signal.cont2discrete(matrices, DT)[:4], dt=DT)
    first, second = (modal_table(m, data) for m in (continuous, sampled))
    for name in ("frequency", "damping", "response_magnitude", "singular_value"):
        np.testing.assert_allclose(getattr(first, name), getattr(second, name), rtol=1e-9)
    assert "Hankel" in str(first) and "real" in str(first)
    reduced = modal_truncation(continuous, 2, data=data).model
    assert not reduced.is_discrete
    kept = modal_truncation(sampled, 2, data=data).model
    np.testing.assert_allclose(
        np.sort_complex(np.exp(np.linalg.eigvals(reduced.A) * DT)),
        np.sort_complex(np.linalg.eigvals(kept.A)),
        rtol=1e-10,
    )


def test_unstable_modes_are_refused_kept_or_moved():
    model = built([pair(1.01, 0.3), [[0.5]]])
    with pytest.raises(ValueError, match='unstable="move"'):
        modal_truncation(model, 2, rank=ModalHankelValue())
    kept = modal_truncation(model, 2, rank=ModalHankelValue(), unstable="keep")
    poles = np.linalg.eigvals(kept.model.A)
    np.testing.assert_allclose(np.abs(poles), 1.01, rtol=1e-12)
    moved = modal_truncation(
        model, 3, rank=ModalHankelValue(), unstable="move", radius=0.99, x0=np.ones(3)
    )
    np.testing.assert_allclose(
        np.sort_complex(np.linalg.eigvals(moved.model.A)),
        np.sort_complex([0.5, 0.99 * np.exp(0.3j), 0.99 * np.exp(-0.3j)]),
        rtol=1e-10,
    )
    # The first output is that of the original.
    np.testing.assert_allclose(
        moved.model.C @ moved.x0[0], np.asarray(model.C) @ np.ones(3), rtol=1e-10
    )
    left = modal_truncation(model, 1, rank=_Only(1), unstable="keep")
    assert np.isinf(left.bound)
    with pytest.raises(ValueError, match="radius"):
        modal_truncation(model, 2, rank=ModalHankelValue(), unstable="move", radius=1.0)
    with pytest.raises(ValueError, match="discretise"):
        unstable = StateSpace([[1.0]], [[1.0]], [[1.0]])
        modal_truncation(unstable, 1, rank=ModalHankelValue(), unstable="move")


def test_repeated_poles_are_said():
    jordan = StateSpace([[0.5, 1.0], [0.0, 0.5]], [[0.0], [1.0]], [[1.0, 0.0]], dt=DT)
    with pytest.raises(ValueError, match="balanced_truncation"):
        modal_table(jordan)
    near = StateSpace([[0.5, 1.0], [1e-17, 0.5]], [[0.0], [1.0]], [[1.0, 0.0]], dt=DT)
    assert modal_table(near).status == Status.close_poles
    # Equal poles with their own eigenvectors are no trouble.
    twins = modal_table(StateSpace(np.diag([0.5, 0.5]), np.eye(2), np.eye(2), dt=DT))
    assert twins.status == Status.successful and twins.sizes == (1, 1)


class _Published(AbstractModeRank):
    """Ranks as printed, by frequency in Hz; real modes by their place from the slowest."""

    hertz: tuple
    places: tuple
    real: tuple

    def scores(self, table):
        frequency = np.asarray(table.frequency) / (2 * np.pi)
        real = np.flatnonzero(np.array(table.sizes) == 1)
        found = np.zeros(frequency.size)
        for i, f in enumerate(frequency):
            nearest = np.argmin(np.abs(np.array(self.hertz) - f))
            found[i] = -self.places[nearest]
        found[real] = -np.array(self.real)
        return found


def test_the_ranks_of_table_3_1_choose_the_modes_of_002():
    """Model Ac3_18: MRM, MSV and MRMC rankings give the modes that 002 keeps."""
    hertz = (54.926, 49.6205, 46.0456, 22.8148, 9.0228, 5.577, 1.5207, 0.7677)
    damping = (0.0188, 0.0105, 0.0270, 0.0420, 0.0290, 0.1440, 0.2712, 0.3547)
    dt = 1 / 300
    s = 2 * np.pi * np.array(hertz) * (-np.array(damping) + 1j * np.sqrt(1 - np.square(damping)))
    z = np.exp(s * dt)
    blocks = [[[p.real, p.imag], [-p.imag, p.real]] for p in z]
    model = built([*blocks, [[0.9999]], [[0.99]]], dt=dt)
    # Modes 18 and 17 of 002: the real ones.
    mrm = _Published(hertz, (10, 9, 7, 5, 6, 4, 8, 3), (1, 2))
    msv = _Published(hertz, (5, 4, 3, 6, 2, 8, 10, 9), (7, 1))

    def kept(rank, order):
        reduction = modal_truncation(model, order, rank=rank)
        pairs = np.array(reduction.table.sizes) == 2
        chosen = np.asarray(reduction.kept) & pairs
        found = np.asarray(reduction.table.frequency)[chosen] / (2 * np.pi)
        return set(found.round(3)), int(np.sum(np.asarray(reduction.kept) & ~pairs))

    assert kept(mrm, 10) == ({22.815, 9.023, 5.577, 0.768}, 2)
    assert kept(msv, 11) == ({54.926, 49.62, 46.046, 22.815, 9.023}, 1)
    assert kept(KnownFrequencies((8.0, 24.0, 48.0), rank=mrm), 10) == (
        {46.046, 22.815, 9.023, 0.768},
        2,
    )


def test_what_a_rank_lacks_is_said(model, data):
    with pytest.raises(ValueError, match="data"):
        modal_truncation(model, 2)
    with pytest.raises(ValueError, match="discretise"):
        modal_truncation(StateSpace([[-1.0]], [[1.0]], [[1.0]]), 1, rank=ModeSingularValue())
    with pytest.raises(ValueError, match="order is 7"):
        modal_truncation(model, 7, data=data)
    with pytest.raises(ValueError, match="complex pair"):
        modal_truncation(built([pair(0.9, 0.3)]), 1, rank=ModalHankelValue())
    with pytest.raises(ValueError, match="record's rate"):
        modal_table(built([[[0.5]]], dt=0.2), data)
    with pytest.raises(ValueError, match="x0 has shape"):
        modal_table(model, data, x0=np.zeros(4))
    with pytest.raises(ValueError, match="hertz"):
        KnownFrequencies(())
    assert ModalResponseMagnitude().scores(modal_table(model, data)).shape == (4,)


@settings(max_examples=15, deadline=None)
@given(
    arrays(np.float64, (4, 4), elements=st.floats(-1.0, 1.0, width=16)),
    st.integers(1, 4),
)
def test_the_reduced_model_is_real_and_keeps_pairs_together(A, order):
    rng = np.random.default_rng(0)
    model = StateSpace(
        A + np.diag([0.0, 0.1, 0.2, 0.3]),
        rng.standard_normal((4, 1)),
        rng.standard_normal((1, 4)),
        dt=DT,
    )
    try:
        reduction = modal_truncation(model, order, rank=ModalHankelValue(), unstable="keep")
    except ValueError as error:
        assert "eigenvectors" in str(error) or "complex pair" in str(error)
        return
    assert reduction.model.A.dtype == float and reduction.model.nx <= order
    if float(reduction.table.condition) > 1e4:
        return
    poles = np.linalg.eigvals(np.asarray(model.A))
    kept = np.linalg.eigvals(np.asarray(reduction.model.A))
    np.testing.assert_allclose(np.sort_complex(kept), np.sort_complex(kept.conj()), atol=1e-8)
    for pole in kept:
        assert np.min(np.abs(poles - pole)) < 1e-6
