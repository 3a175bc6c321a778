"""Second-order sections of models: found, matched, and written in coherent bases."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import scipy  # its parts load when first used

from lpvid.models import StateSpace

# A basis worse conditioned than this stands for modes that cannot be told apart.
_CONDITION = 1e10
_WORST_BASIS = 1e8
# Poles closer to zero than this, of z or as a share of the fastest, have no frequency.
_DELAY, _INTEGRATOR = 1e-7, 1e-10


@dataclasses.dataclass
class Section:
    """One mode of one model: two states, or one.

    Attributes:
        A: state matrix in any basis of the mode.
        B: input matrix.
        C: output matrix.
        poles: eigenvalues of A in continuous time, rad/s.
        shape: response at the mode's own frequency, (ny, nu).
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    poles: np.ndarray
    shape: np.ndarray

    @property
    def frequency(self) -> float:
        """Geometric mean of the poles' sizes."""
        return float(np.exp(np.mean(np.log(np.abs(self.poles) + np.finfo(float).tiny))))

    @property
    def damping(self) -> float:
        """Mean real part over the frequency, negative for a stable mode."""
        return float(np.mean(np.real(self.poles)) / self.frequency)


def sections_of(model: StateSpace, neighbour: list[Section] | None, point: int) -> list[Section]:
    """The sections of a model, those of two states by rising frequency, a single state last.

    Args:
        model: numbers, one model.
        neighbour: sections of a neighbouring point, that tell which real pole to leave single.
        point: named in messages.

    Raises:
        ValueError: the modes cannot be told apart (equal poles in different modes), or one has no
            frequency: an integrator, a delay.
    """
    A, B, C = (np.asarray(matrix) for matrix in (model.A, model.B, model.C))
    poles, vectors = np.linalg.eig(A)
    _check_frequencies(model, poles, point)
    moved = np.log(poles.astype(complex)) / model.dt if model.is_discrete else poles
    groups = _groups(poles, moved, neighbour)
    basis = np.concatenate([_plane(poles[g], vectors[:, g], A) for g in groups], axis=1)
    if not np.linalg.cond(basis) < _CONDITION:
        raise ValueError(
            f"models: the modes at point {point} cannot be told apart (equal poles in different "
            "modes, or more states than the model needs); take another order, or align_along."
        )
    inverse = np.linalg.inv(basis)
    sections, start = [], 0
    for group in groups:
        stop = start + len(group)
        rows, columns = inverse[start:stop], basis[:, start:stop]
        block, inputs, outputs = rows @ A @ columns, rows @ B, C @ columns
        size = np.exp(np.mean(np.log(np.abs(moved[group]) + np.finfo(float).tiny)))
        at = np.exp(1j * size * model.dt) if model.is_discrete else 1j * size
        shape = outputs @ np.linalg.solve(at * np.eye(len(group)) - block, inputs)
        sections.append(Section(block, inputs, outputs, np.asarray(moved[group]), shape))
        start = stop
    return sections


def _check_frequencies(model: StateSpace, poles: np.ndarray, point: int) -> None:
    """Modes are matched and scaled by their frequencies."""
    if model.is_discrete and np.min(np.abs(poles)) < _DELAY:
        raise ValueError(
            f"models: a pole at z = 0 at point {point} (a delay of whole samples) has no "
            "frequency; shift the input by the delay and identify again, or take align_along."
        )
    distance = np.abs(poles - 1.0) / model.dt if model.is_discrete else np.abs(poles)
    if np.min(distance) <= _INTEGRATOR * np.max(distance):
        raise ValueError(
            f"models: a pole at zero at point {point} (an integrator) has no frequency; leave it "
            "out of the models (difference the output), or take align_along."
        )


def _groups(
    poles: np.ndarray, moved: np.ndarray, neighbour: list[Section] | None
) -> list[np.ndarray]:
    """Indices of the poles of each section."""
    real = [int(k) for k in np.flatnonzero(np.imag(poles) == 0)]
    real.sort(key=lambda k: abs(moved[k]))
    single = []
    if len(real) % 2:
        chosen = real[-1]
        if neighbour is not None:
            goal = neighbour[-1].poles[0]
            chosen = min(real, key=lambda k: abs(moved[k] - goal))
        real.remove(chosen)
        single = [np.array([chosen])]
    pairs = [np.array(real[k : k + 2]) for k in range(0, len(real), 2)]
    for k in np.flatnonzero(np.imag(poles) > 0):
        partner = int(np.argmin(np.abs(poles - np.conj(poles[k]))))
        pairs.append(np.array([int(k), partner]))
    pairs.sort(key=lambda pair: np.prod(np.abs(moved[pair])))
    return pairs + single


def _plane(poles: np.ndarray, vectors: np.ndarray, A: np.ndarray) -> np.ndarray:
    """An orthonormal real basis of the poles' invariant subspace."""
    if len(poles) == 2 and poles[0].imag == 0:
        # Close poles have nearly parallel vectors; the null space of the product keeps its plane.
        identity = np.eye(len(A))
        product = (A - poles[0].real * identity) @ (A - poles[1].real * identity)
        return np.linalg.svd(product)[2][-2:].T
    parts = [np.real(vectors[:, 0]), np.imag(vectors[:, 0])][: len(poles)]
    return np.linalg.qr(np.stack(parts, axis=1))[0]


def matched(sections: list[Section], neighbour: list[Section]) -> list[Section]:
    """The sections in the order of a neighbour's: by frequency, damping and shape."""
    pairs = [s for s in sections if len(s.A) == 2]
    others = [s for s in neighbour if len(s.A) == 2]
    cost = [[_apart(mine, theirs) for mine in pairs] for theirs in others]
    _, order = scipy.optimize.linear_sum_assignment(np.reshape(cost, (len(others), len(pairs))))
    return [pairs[k] for k in order] + [s for s in sections if len(s.A) == 1]


def _apart(first: Section, second: Section) -> float:
    size = np.linalg.norm(first.shape) + np.linalg.norm(second.shape) + np.finfo(float).tiny
    return float(
        abs(np.log(first.frequency / second.frequency))
        + 0.1 * abs(first.damping - second.damping)
        + np.linalg.norm(first.shape - second.shape) / size
    )


def coherent_bases(mode: list[Section], first: int, path: list[tuple[int, int]]) -> None:
    """Write one mode of all points, in place, with blocks [[0, w], [−a0/w, −a1]].

    T with T A = F T has the rows t and t A / w, any t: the first point's is chosen for inputs and
    outputs of one size, the others' to minimise ‖T B − B_n‖² + ‖C − C_n T‖² for the neighbour n.

    Args:
        mode: the section of each point.
        first: where to begin.
        path: (point, neighbour already done).

    Raises:
        ValueError: a mode has two equal real poles with a state each, which no such block has.
    """
    width = float(np.exp(np.mean([np.log(_size(section)) for section in mode])))
    _write(mode[first], _first_row(mode[first], width), width, first)
    for index, neighbour in path:
        _write(mode[index], _nearest_row(mode[index], mode[neighbour], width), width, index)


def _size(section: Section) -> float:
    """Geometric mean of the eigenvalues' sizes."""
    return float(np.abs(np.linalg.det(section.A)) ** (1 / len(section.A))) or 1.0


def _basis(section: Section, row: np.ndarray, width: float) -> np.ndarray:
    return row[None] if len(row) == 1 else np.stack([row, row @ section.A / width])


def _first_row(section: Section, width: float) -> np.ndarray:
    left, _, _ = np.linalg.svd(section.C)
    candidates = [left[:, 0] @ section.C, np.ones(len(section.A)), np.eye(len(section.A))[0]]
    row = min(candidates, key=lambda row: np.linalg.cond(_basis(section, row, width)))
    preferred = candidates[0]
    if np.linalg.cond(_basis(section, preferred, width)) < 1e3:
        row = preferred
    T = _basis(section, row, width)
    if not np.linalg.cond(T) < _WORST_BASIS:
        return row
    sizes = np.linalg.norm(T @ section.B), np.linalg.norm(section.C @ np.linalg.inv(T))
    return row * np.sqrt(sizes[1] / sizes[0]) if min(sizes) > 0 else row


def _nearest_row(section: Section, neighbour: Section, width: float) -> np.ndarray:
    states = len(section.A)
    # Columns: what each entry of t changes.
    each = [_basis(section, row, width) for row in np.eye(states)]
    left = [np.concatenate([(T @ section.B).ravel(), (neighbour.C @ T).ravel()]) for T in each]
    right = np.concatenate([neighbour.B.ravel(), section.C.ravel()])
    row = np.linalg.lstsq(np.stack(left, axis=1), right, rcond=None)[0]
    if not np.linalg.cond(_basis(section, row, width)) < _WORST_BASIS:
        return _first_row(section, width)
    return row


def _write(section: Section, row: np.ndarray, width: float, point: int) -> None:
    T = _basis(section, row, width)
    if not np.linalg.cond(T) < _WORST_BASIS:
        raise ValueError(
            f"models: two equal real poles ({np.mean(np.real(section.poles)):.4g} rad/s) at point "
            f"{point} are no mode of two states; lower the order, or take align_along."
        )
    inverse = np.linalg.inv(T)
    section.A = T @ section.A @ inverse
    if len(row) == 2:
        section.A[0] = [0.0, width]
    section.B, section.C = T @ section.B, section.C @ inverse


def assemble(sections: list[Section], model: StateSpace) -> StateSpace:
    """The block-diagonal model of the sections, with the feedthrough and sample time of `model`."""
    A = scipy.linalg.block_diag(*(section.A for section in sections))
    B = np.concatenate([section.B for section in sections])
    C = np.concatenate([section.C for section in sections], axis=1)
    return StateSpace(jnp.asarray(A), B, C, model.D, dt=model.dt)
