"""The modes of a real modal form one by one, in complex numbers."""

from typing import NamedTuple

import numpy as np
import scipy  # its parts load when first used

from lpvid.data import IOData


class SingleModes(NamedTuple):
    """η_i⁺ = λ_i η_i + b_i u (or its derivative), y_i = w_i Re(c_i η_i).

    The other pole of a pair is in the weight, 2 for a pair and 1 for a real pole.

    Attributes:
        poles: λ_i, that of a pair with positive imaginary part, (mode,).
        rows: b_i, (mode, nu).
        columns: c_i, (mode, ny).
        weights: w_i, (mode,).
        x0: η_i at the start of each record, (record, mode).
        dt: sample time, s; zero for continuous time.
    """

    poles: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    weights: np.ndarray
    x0: np.ndarray
    dt: float

    def sampled(self, dt: float) -> "SingleModes":
        """The same at a sample time, inputs held; discrete modes as they are."""
        if self.dt:
            return self
        turned = np.exp(self.poles * dt)
        moves = self.poles != 0.0
        held = np.where(moves, (turned - 1.0) / np.where(moves, self.poles, 1.0), dt)
        return self._replace(poles=turned, rows=held[:, None] * self.rows, dt=dt)

    def responses(self, data: IOData) -> np.ndarray:
        """(mode, time, ny), the records one after another; for sampled modes."""
        parts = []
        inputs = np.split(np.asarray(data.u), np.cumsum(data.lengths)[:-1])
        for u, starts in zip(inputs, self.x0, strict=True):
            driving = u @ self.rows.T
            states = np.stack(
                [
                    scipy.signal.lfilter([0.0, 1.0], [1.0, -pole], w, zi=start[None])[0]
                    for pole, w, start in zip(self.poles, driving.T, starts, strict=True)
                ]
            )
            product = states[:, :, None] * self.columns[:, None, :]
            parts.append(self.weights[:, None, None] * np.real(product))
        return np.concatenate(parts, axis=1)

    def pulse_values(self, samples: int | None) -> np.ndarray:
        """MSV over so many samples (`None`: infinitely many); NaN for continuous time."""
        if not self.dt:
            return np.full(self.poles.size, np.nan)
        radius = np.abs(self.poles)
        gain = np.linalg.norm(self.rows, axis=1) * np.linalg.norm(self.columns, axis=1)
        if samples is None:
            lasting = (radius >= 1.0) & (gain > 0.0)
            total = 1.0 / np.where(radius < 1.0, 1.0 - radius, 1.0)
            return np.where(lasting, np.inf, np.sqrt(gain * total))
        growth = np.log(np.maximum(radius, np.finfo(float).tiny))
        still = np.abs(growth) < 1e-14
        terms = np.expm1((samples - 1) * growth) / np.where(still, 1.0, np.expm1(growth))
        return np.sqrt(gain * np.where(still, float(samples - 1), terms))

    def hankel_values(self) -> np.ndarray:
        """Hankel singular values of each mode by itself, (mode, 2); infinite for an unstable one.

        In modal coordinates the Gramians are b_i b_jᴴ / (1 − λ_i λ_j*) and the like.
        """
        inside = np.abs(self.poles) < 1.0 if self.dt else np.real(self.poles) < 0.0
        values = np.full((self.poles.size, 2), np.inf)
        for i in np.flatnonzero(inside):
            poles, rows, columns = self.poles[i], self.rows[i], self.columns[i]
            if self.weights[i] == 1.0:
                poles, rows, columns = poles[None], rows[None], columns[None]
            else:
                poles, rows, columns = (
                    np.stack([part, part.conj()]) for part in (poles, rows, columns)
                )
            if self.dt:
                shared = 1.0 - poles[:, None] * poles.conj()[None]
            else:
                shared = -(poles[:, None] + poles.conj()[None])
            controllability = rows @ rows.conj().T / shared
            observability = columns.conj() @ columns.T / shared.conj()
            squares = np.sort(np.real(np.linalg.eigvals(controllability @ observability)))[::-1]
            values[i] = 0.0
            values[i, : squares.size] = np.sqrt(np.maximum(squares, 0.0))
        return values


def single_modes(
    A: np.ndarray,
    B: np.ndarray,
    C: np.ndarray,
    x0: np.ndarray,
    sizes: tuple[int, ...],
    dt: float,
) -> SingleModes:
    """Of the real modal form that `lpvid.models.modal_form` gives, states in blocks of `sizes`."""
    poles, rows, columns, starts, start = [], [], [], [], 0
    for size in sizes:
        if size == 1:
            poles.append(A[start, start] + 0.0j)
            rows.append(B[start] + 0.0j)
            columns.append(C[:, start] + 0.0j)
            starts.append(x0[:, start] + 0.0j)
        else:
            # [√2 Re v, √2 Im v] are the columns, [√2 Re w, −√2 Im w] the rows.
            root, after = np.sqrt(2.0), start + 1
            poles.append(complex(A[start, start], A[start, after]))
            rows.append((B[start] - 1j * B[after]) / root)
            columns.append((C[:, start] + 1j * C[:, after]) / root)
            starts.append((x0[:, start] - 1j * x0[:, after]) / root)
        start += size
    return SingleModes(
        np.array(poles),
        np.array(rows),
        np.array(columns),
        np.array(sizes, float),
        np.stack(starts, axis=1),
        dt,
    )
