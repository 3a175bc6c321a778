"""A two-mode system whose modes move with K, and records of it in files."""

import numpy as np
from scipy.signal import cont2discrete

DT = 0.01


def frequencies(kappa):
    """Natural frequencies in Hz: their logarithms are affine in kappa."""
    return 5.0 * np.exp(0.3 * kappa), 14.0 * np.exp(-0.2 * kappa)


DAMPINGS = (0.03, 0.02)


def matrices(kappa):
    A, B, C = np.zeros((4, 4)), np.zeros((4, 1)), np.zeros((1, 4))
    for mode, (frequency, damping, gain) in enumerate(
        zip(frequencies(kappa), DAMPINGS, (1.0 + 0.5 * kappa, -0.6), strict=True)
    ):
        omega, block = 2.0 * np.pi * frequency, slice(2 * mode, 2 * mode + 2)
        A[block, block] = [[0.0, omega], [-omega, -2.0 * damping * omega]]
        B[2 * mode + 1, 0] = 1.0
        C[0, 2 * mode] = gain
    return A, B, C


def simulate(schedule, seed, noise=0.0):
    rng = np.random.default_rng(seed)
    u = np.sign(rng.standard_normal(len(schedule)))
    x, y = np.zeros(4), np.zeros(len(schedule))
    known = {}
    for t, kappa in enumerate(schedule):
        if kappa not in known:
            A, B, C = matrices(kappa)
            known[kappa] = (*cont2discrete((A, B, C, np.zeros((1, 1))), DT)[:2], C)
        Ad, Bd, C = known[kappa]
        y[t] = C[0] @ x
        x = Ad @ x + Bd[:, 0] * u[t]
    return u, y + noise * y.std() * rng.standard_normal(len(y))


def write_table(path, schedule, seed, noise=0.0, offsets=(0.0, 0.0)):
    """A CSV file with the columns t, u, y, k."""
    u, y = simulate(schedule, seed, noise)
    t = DT * np.arange(len(u))
    table = np.c_[t, u + offsets[0], y + offsets[1], schedule]
    np.savetxt(path, table, delimiter=",", header="t,u,y,k", comments="", fmt="%.12g")
    return str(path)
