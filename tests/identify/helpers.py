"""Systems and records with known answers, and SLICOT as the independent route."""

import numpy as np
from scipy.linalg import block_diag
from scipy.signal import dlsim


def three_modes(dt=1 / 50):
    """The common problem: modes at 2, 5 and 11 Hz, damping 2, 1.5 and 1 %, 2 inputs, 2 outputs."""
    rng = np.random.default_rng(7)
    blocks = []
    for hertz, damping in ((2.0, 0.02), (5.0, 0.015), (11.0, 0.01)):
        omega = 2 * np.pi * hertz
        pole = np.exp(dt * omega * (-damping + 1j * np.sqrt(1 - damping**2)))
        blocks.append([[pole.real, pole.imag], [-pole.imag, pole.real]])
    B, C = rng.standard_normal((6, 2)), rng.standard_normal((2, 6))
    return block_diag(*blocks), B, C, 0.5 * rng.standard_normal((2, 2))


def respond(system, u, x0=None):
    """Output of a discrete-time system, by SciPy."""
    return dlsim((*system, 1.0), u, x0=x0)[1]


def prbs(n, nu, seed=0):
    return np.where(np.random.default_rng(seed).standard_normal((n, nu)) > 0, 1.0, -1.0)


def common_problem(n, seed=0, decibel=30.0):
    """Inputs, clean outputs and outputs with white noise."""
    u = prbs(n, 2, seed)
    clean = respond(three_modes(), u)
    noise = np.random.default_rng(seed + 1).standard_normal(clean.shape)
    return u, clean, clean + noise * clean.std(axis=0) * 10 ** (-decibel / 20)


def slicot_moen4(u, y, order, block_rows, algorithm="C"):
    """SLICOT: A and C by MOESP, B and D by N4SID, which is the combination that is right."""
    import ctrlsys

    (n, nu), ny = u.shape, y.shape[1]
    u, y = np.asfortranarray(u), np.asfortranarray(y)
    factor = ctrlsys.ib01ad("M", algorithm, "N", "O", "N", "N", block_rows, nu, ny, u, y, 0.0, -1.0)
    A, C, B, D, *_ = ctrlsys.ib01bd("C", "A", "N", block_rows, order, nu, ny, n, factor[1], 0.0)
    return A, B, C, D


def slicot_start(system, u, y):
    """SLICOT's initial state of a given system."""
    import ctrlsys

    A, B, C, D = (np.asfortranarray(m) for m in system)
    u, y = np.asfortranarray(u), np.asfortranarray(y)
    return ctrlsys.ib01cd("X", "U", "D", A.shape[0], *D.shape[::-1], A, B, C, D, u, y, 0.0)[0]


def fit_percent(y, y_hat):
    return 100 * (1 - np.linalg.norm(y - y_hat, axis=0) / np.linalg.norm(y - y.mean(0), axis=0))


def sorted_poles(A):
    return np.sort_complex(np.linalg.eigvals(np.asarray(A)))


def markov(system, count):
    """D, CB, CAB, …: what does not depend on the basis."""
    A, B, C, D = (np.asarray(m) for m in system)
    parameters, state = [D], B
    for _ in range(count):
        parameters.append(C @ state)
        state = A @ state
    return np.stack(parameters)
