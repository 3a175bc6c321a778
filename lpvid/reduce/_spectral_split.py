"""A model as the sum of its stable and its unstable part."""

import numpy as np
import scipy.linalg

from lpvid.models import StateSpace


def spectral_split(model: StateSpace) -> tuple[StateSpace, StateSpace]:
    """Stable part with D and unstable part without, by an ordered Schur form.

    A pole on the stability boundary counts as unstable. Numbers only, one model, no batch.
    """
    A, B, C = (np.asarray(m) for m in (model.A, model.B, model.C))
    # LAPACK gives the two parts of a pole apart.
    if model.is_discrete:
        select = lambda real, imag: real * real + imag * imag < 1.0  # noqa: E731
    else:
        select = lambda real, imag: real < 0.0  # noqa: E731
    T, Q, *number = scipy.linalg.schur(A, output="real", sort=select)
    count = int(number[0])
    # [[I, X], [0, I]] with T11 X - X T22 + T12 = 0 removes the coupling of the two blocks.
    X = scipy.linalg.solve_sylvester(T[:count, :count], -T[count:, count:], -T[:count, count:])
    inputs, outputs = Q.T @ B, C @ Q
    stable = StateSpace(
        T[:count, :count],
        inputs[:count] - X @ inputs[count:],
        outputs[:, :count],
        model.D,
        dt=model.dt,
    )
    unstable = StateSpace(
        T[count:, count:],
        inputs[count:],
        outputs[:, :count] @ X + outputs[:, count:],
        dt=model.dt,
    )
    return stable, unstable
