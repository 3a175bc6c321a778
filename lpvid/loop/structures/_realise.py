"""State-space models from the factor of windows: subspace, in continuous time by the logarithm."""

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from lpvid.loop.structures._search import window_maps
from lpvid.loop.structures._windows import Windows

# What is left of an eigenvalue that has no logarithm, in steps.
_FASTEST = 1e-3
# Resonances that are tried, and their damping ratio.
_FREQUENCIES = 10
_DAMPING = 0.03

Model: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray]


def realise(windows: Windows, nu: int, ny: int, orders: Sequence[int]) -> list[Model]:
    """Models (A, B, C) of several orders, in continuous time, without feedthrough.

    The range of the observability matrix by past inputs and outputs as instruments (PO-MOESP,
    Verhaegen 1994), the window's first half being the past; B by least squares, every window's
    first state and constant inputs left open.

    Args:
        windows: of one length, all bins taken together.
        nu: number of inputs.
        ny: number of outputs.
        orders: numbers of states.
    """
    if windows.number < windows.samples * (nu + ny):
        return []
    past = windows.samples // 2
    outputs = np.concatenate(windows.outputs, axis=-1)
    inputs = np.concatenate(windows.inputs, axis=-1).reshape(windows.samples, 2 * nu, -1)
    if not np.any(inputs[:, nu:]):
        inputs = inputs[:, :nu]
    scale = np.maximum(
        np.linalg.norm(outputs.reshape(windows.samples, ny, -1), axis=(0, 2)), 1e-300
    )
    outputs = outputs.reshape(windows.samples, ny, -1) / scale[None, :, None]
    flat = [
        part.reshape(-1, part.shape[-1])
        for part in (inputs[past:], inputs[:past], outputs[:past], outputs[past:])
    ]
    # What is constant over the record, an offset or a bias, counts as one more future input.
    constant = windows.constant.reshape(1, -1)
    lower = np.transpose(np.linalg.qr(np.concatenate([constant, *flat]).T, mode="r"))
    first = 1 + len(flat[0])
    last = len(lower) - len(flat[3])
    left, _, _ = np.linalg.svd(lower[last:, first:last], full_matrices=False)
    models = []
    for order in orders:
        if order > left.shape[1] - ny or order > (windows.samples - past - 1) * ny:
            continue
        observability = left[:, :order]
        C = observability[:ny] * scale[:, None]
        shifted = np.linalg.lstsq(observability[:-ny], observability[ny:], rcond=None)[0]
        A = _continuous(shifted, windows.step)
        models.append((A, _inputs(A, C, windows, nu), C))
    return models


def _continuous(transition: np.ndarray, step: float) -> np.ndarray:
    values, vectors = np.linalg.eig(transition)
    # Eigenvalues on the negative axis have no real logarithm: their size is kept.
    lost = (np.real(values) <= 0.0) & (np.abs(np.imag(values)) < 1e-9 * np.abs(values))
    values = np.where(lost, np.maximum(np.abs(values), _FASTEST), values)
    logarithms = np.log(np.where(np.abs(values) < _FASTEST, _FASTEST, values)) / step
    return (vectors * logarithms @ np.linalg.pinv(vectors)).real


def with_resonance(model: Model, scales: Sequence[Windows], nu: int, ny: int) -> list[Model]:
    """The model with one more resonance, at frequencies over the band and in several outputs.

    Where a loop hides a resonance from the projections, trying it finds it.

    Args:
        model: (A, B, C) of a lower order.
        scales: windows of all lengths.
        nu: number of inputs.
        ny: number of outputs.
    """
    A, _, C = model
    n = len(A)
    longest = scales[-1].step * scales[-1].samples
    size = np.linalg.norm(C, axis=1)
    outputs = [*np.eye(ny), *([np.ones(ny)] if ny > 1 else [])]
    models = []
    for omega in np.geomspace(4.0 / longest, 2.5 / scales[0].step, _FREQUENCIES):
        windows = min(scales, key=lambda entry: abs(np.log(omega * entry.step / 0.5)))
        larger = np.zeros((n + 2, n + 2))
        larger[:n, :n] = A
        larger[n:, n:] = omega * np.array([[0.0, 1.0], [-1.0, -2.0 * _DAMPING]])
        for output in outputs:
            column = (size * output)[:, None]
            reads = np.concatenate([C, column, np.zeros((ny, 1))], axis=1)
            models.append((larger, _inputs(larger, reads, windows, nu), reads))
    return models


def _inputs(A: np.ndarray, C: np.ndarray, windows: Windows, nu: int) -> np.ndarray:
    n = len(A)
    units = np.eye(n * nu).reshape(n * nu, n, nu)
    many = [np.broadcast_to(matrix, (n * nu, *matrix.shape)) for matrix in (A, C)]
    D = np.zeros((n * nu, len(C), nu))
    observed, response, _ = window_maps(many[0], units, many[1], D, windows.step, windows.samples)
    constant = window_maps(A, np.eye(n), C, np.zeros((len(C), n)), windows.step, windows.samples)[2]
    free = np.linalg.qr(np.concatenate([observed[0], constant], axis=-1))[0]
    outputs = np.concatenate(windows.outputs, axis=-1)
    responses = response @ np.concatenate(windows.inputs, axis=-1)
    target = outputs - free @ (free.T @ outputs)
    responses = responses - free @ (free.T @ responses)
    # Outputs in different units count alike.
    rows = target.reshape(windows.samples, len(C), -1)
    size = np.tile(np.maximum(np.linalg.norm(rows, axis=(0, 2)), 1e-300), windows.samples)
    regressors = (responses / size[:, None]).reshape(n * nu, -1).T
    solution = np.linalg.lstsq(regressors, (target / size[:, None]).ravel(), rcond=1e-10)[0]
    return solution.reshape(n, nu)
