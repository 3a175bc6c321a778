"""Linear plants by their matrices, with what structures must put up with: loops, friction, bias."""

import numpy as np
import scipy.linalg

from lpvid.data import IOData


def mechanical(mass, damping, stiffness, entry):
    """A and B of M q̈ + D q̇ + K q = entry u."""
    mass, damping, stiffness = (np.atleast_2d(matrix) for matrix in (mass, damping, stiffness))
    n = len(mass)
    mobility = np.linalg.inv(mass)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-mobility @ stiffness, -mobility @ damping]])
    B = np.concatenate([np.zeros(n), mobility @ np.asarray(entry, float)])[:, None]
    return A, B


def driven(
    A,
    B,
    outputs,
    *,
    dt=0.01,
    samples=1500,
    gains=(0.0, 0.0),
    friction=0.0,
    bias=0.0,
    offset=0.0,
    noise=1e-4,
    push=2.0,
    every=10,
    sign=1.0,
    seed=0,
):
    """A record: a held random drive, with a PD loop on the first coordinate where it has gains.

    Dry friction acts where the drive does, and is integrated by eight steps a sample.
    """
    random = np.random.default_rng(seed)
    n = len(A)
    fine = 8
    joint = scipy.linalg.expm(np.block([[A, B], [np.zeros((1, n + 1))]]) * dt / fine)
    transition, entry = joint[:n, :n], joint[:n, n]
    drive = push * np.repeat(random.standard_normal(samples // every + 1), every)[:samples]
    x, states, u = np.zeros(n), np.zeros((samples, n)), np.zeros(samples)
    for k in range(samples):
        states[k] = x
        u[k] = drive[k] - gains[0] * x[0] - gains[1] * x[n // 2]
        for _ in range(fine):
            force = u[k] + bias - friction * np.tanh(x[n // 2] / 1e-3)
            x = transition @ x + entry * force
    y = states @ np.asarray(outputs, float).T
    y = offset + y + noise * np.std(y, axis=0) * random.standard_normal(y.shape)
    return IOData(u=sign * u, y=y, dt=dt)
