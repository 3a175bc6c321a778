"""Random systems with known damping, and the peer's norm of them."""

import numpy as np
import slycot


def modal_system(rng, nx, nu, ny, *, damping=1e-4, feedthrough=1.0, unstable=0):
    """A random system in a random basis: lightly damped modes between 0.1 and 100 rad/s."""
    A = np.zeros((nx, nx))
    for mode in range(nx // 2):
        omega, zeta = 10 ** rng.uniform(-1, 2), 10 ** rng.uniform(np.log10(damping), -0.3)
        zeta = -zeta if mode < unstable else zeta
        block = slice(2 * mode, 2 * mode + 2)
        A[block, block] = omega * np.array([[-zeta, 1.0], [-1.0, -zeta]])
    if nx % 2:
        A[-1, -1] = -(10 ** rng.uniform(-1, 2))
    T = np.linalg.qr(rng.standard_normal((nx, nx)))[0] * 10 ** rng.uniform(-0.5, 0.5, nx)
    B, C = rng.standard_normal((nx, nu)), rng.standard_normal((ny, nx))
    D = feedthrough * 10 ** rng.uniform(-2, 2) * rng.standard_normal((ny, nu))
    return np.linalg.solve(T, A @ T), B, C, D


def sampled(A, B, C, D, dt):
    """The system seen through a zero-order hold."""
    from scipy.linalg import expm

    nx, nu = B.shape
    big = expm(np.block([[A, B], [np.zeros((nu, nx + nu))]]) * dt)
    return big[:nx, :nx], big[:nx, nx:], C, D


def stack(systems):
    """Systems of one size as four arrays with a leading axis."""
    return tuple(np.stack([system[k] for system in systems]) for k in range(4))


def slicot_norm(A, B, C, D, dt=0.0):
    """AB13DD: the norm and the frequency of its peak."""
    nx, nu = B.shape
    kind = "D" if dt else "C"
    norm, omega = slycot.ab13dd(
        kind, "I", "S", "D", nx, nu, C.shape[0], A, np.eye(nx), B, C, D, 1e-12
    )
    return norm, omega / dt if dt else omega
