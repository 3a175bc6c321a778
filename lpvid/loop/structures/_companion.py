"""Linear models in modal companion form: which entries are fixed, which are free."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# An eigenvalue counts as real below this share of imaginary part.
_REAL = 1e-9


class CompanionForm(NamedTuple):
    """[A, B, C, D] row by row as offset + linear θ."""

    order: int
    nu: int
    ny: int
    offset: np.ndarray
    linear: np.ndarray

    def matrices(self, thetas: np.ndarray, kappas: np.ndarray) -> tuple[np.ndarray, ...]:
        """For a batch of parameters, the same at each κ."""
        entries = self.offset + thetas @ self.linear.T
        entries = np.repeat(entries[:, None], len(kappas), axis=1)
        return split_entries(entries, self.order, self.nu, self.ny)

    def with_feedthrough(self) -> "CompanionForm":
        """The same with a free D."""
        entries, size = self.linear.shape
        linear = np.zeros((entries, size + self.ny * self.nu))
        linear[:, :size] = self.linear
        linear[-self.ny * self.nu :, size:] = np.eye(self.ny * self.nu)
        return self._replace(linear=linear)

    def names(self, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> tuple[str, ...]:
        """What the parameters are called."""
        pairs, single = divmod(self.order, 2)
        names = []
        for block in range(pairs):
            names += [f"squared frequency {block + 1}", f"damping rate {block + 1}"]
        names += [f"pole rate {pairs + 1}"] * single
        names += [f"B[{i + 1},{j + 1}]" for i in range(self.order) for j in range(self.nu - 1)]
        names += [f"C[{name},{i + 1}]" for name in outputs for i in range(self.order)]
        names += [f"D[{b},{a}]" for b in outputs for a in inputs]
        return tuple(names[: self.linear.shape[1]])


class Gauge(NamedTuple):
    """What fixes the states: scales s (block,) and input directions w (block, input)."""

    scales: Float[np.ndarray, " block"]
    directions: Float[np.ndarray, "block nu"]


def companion_form(gauge: Gauge, order: int, nu: int, ny: int) -> CompanionForm:
    """The form of a gauge: θ = (a, b of each block; rest of B; C by rows)."""
    A, B = np.zeros((order, order)), np.zeros((order, nu))
    free_a, free_b = [], []
    for block, (scale, direction) in enumerate(zip(*gauge, strict=True)):
        first, last = 2 * block, min(2 * block + 1, order - 1)
        if last > first:
            A[first, last] = scale
            free_a += [((last, first), -1.0 / scale), ((last, last), -1.0)]
        else:
            free_a += [((last, last), -1.0)]
        B[last] = scale * direction
        rest = np.linalg.svd(direction[None])[2][1:]
        free_b += [(row, other) for row in range(first, last + 1) for other in rest]
    size = len(free_a) + len(free_b) + ny * order
    offset = np.concatenate([A.ravel(), B.ravel(), np.zeros(ny * order + ny * nu)])
    linear = np.zeros((len(offset), size))
    for column, ((row, entry), slope) in enumerate(free_a):
        linear[row * order + entry, column] = slope
    for column, (row, other) in enumerate(free_b, len(free_a)):
        first = order * order + row * nu
        linear[first : first + nu, column] = other
    first = order * order + order * nu
    linear[first : first + ny * order, size - ny * order :] = np.eye(ny * order)
    return CompanionForm(order, nu, ny, offset, linear)


def gauge_of(A: np.ndarray, B: np.ndarray, C: np.ndarray) -> Gauge | None:
    """Scales by the poles' sizes, directions by what moves each block most; `None` if it fails."""
    parts = _modal(A, B, C)
    if parts is None:
        return None
    scales, directions = [], []
    for values, b, c in parts:
        scales.append(np.sqrt(max(np.max(np.abs(values)) * np.mean(np.abs(values)), 1e-300)))
        weighted = np.linalg.norm(c, axis=0)[:, None] * b
        directions.append(np.linalg.svd(np.concatenate([weighted.real, weighted.imag]))[2][0])
    return Gauge(np.array(scales), np.array(directions))


def in_gauge(A: np.ndarray, B: np.ndarray, C: np.ndarray, gauge: Gauge) -> np.ndarray | None:
    """θ of a model in the form of a gauge; `None` where a block is not moved by its direction."""
    parts = _modal(A, B, C)
    if parts is None:
        return None
    rates, inputs, outputs = [], [], []
    for (values, b, c), scale, direction in zip(parts, *gauge, strict=True):
        pushed = b @ direction
        if len(values) == 1:
            rates.append(-np.real(values))
            change = np.array([scale]) / pushed
            change = change[:, None]
        else:
            square, rate = np.real(np.prod(values)), -np.real(np.sum(values))
            rates.append(np.array([square, rate]))
            modal = np.stack([pushed, values * pushed], axis=1)
            if abs(np.linalg.det(modal)) == 0.0:
                return None
            # Controllability matrices of both: [B w, A B w] with B w = (0, s).
            change = np.array([[0.0, scale**2], [scale, -rate * scale]]) @ np.linalg.inv(modal)
        if not np.all(np.isfinite(change)) or np.linalg.matrix_rank(change) < len(values):
            return None
        rest = np.linalg.svd(direction[None])[2][1:]
        inputs.append(((change @ b).real @ rest.T).ravel())
        outputs.append(np.real(c @ np.linalg.inv(change)))
    theta = np.concatenate([*rates, *inputs, np.concatenate(outputs, axis=1).ravel()])
    return theta if np.all(np.isfinite(theta)) else None


def _modal(A, B, C):
    """Poles, input rows and output columns of each block: pairs, slow first, then a last one."""
    values, vectors = np.linalg.eig(A)
    if not np.all(np.isfinite(values)) or np.linalg.cond(vectors) > 1e12:
        return None
    b, c = np.linalg.solve(vectors, B.astype(complex)), C @ vectors
    real = np.flatnonzero(np.abs(np.imag(values)) <= _REAL * np.abs(values))
    real = real[np.argsort(np.abs(values[real]))]
    upper = np.flatnonzero(np.imag(values) > _REAL * np.abs(values))
    pairs = [list(real[k : k + 2]) for k in range(0, len(real) - 1, 2)]
    for one in upper:
        other = np.argmin(np.abs(values - values[one].conj()))
        pairs.append([one, int(other)])
    pairs.sort(key=lambda pair: np.mean(np.abs(values[pair])))
    if len(real) % 2:
        pairs.append([int(real[-1])])
    return [(values[pair], b[pair], c[:, pair]) for pair in pairs]


def split_entries(entries, n, nu, ny):
    """Matrices from their stacked entries, with leading axes or without."""
    bounds = np.cumsum([0, n * n, n * nu, ny * n, ny * nu])
    shapes = ((n, n), (n, nu), (ny, n), (ny, nu))
    return tuple(
        entries[..., bounds[k] : bounds[k + 1]].reshape(*entries.shape[:-1], *shapes[k])
        for k in range(4)
    )
