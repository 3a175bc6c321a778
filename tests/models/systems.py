"""Systems for the tests of this folder."""

import jax.numpy as jnp
import numpy as np

from lpvid.models import StateSpace


def flexible(seed=0, modes=3, nu=2, ny=2, feedthrough=True):
    """Lightly damped continuous-time model of 1 to 10 Hz."""
    rng = np.random.default_rng(seed)
    frequencies = 2 * np.pi * np.sort(rng.uniform(1, 10, modes))
    A = np.zeros((2 * modes, 2 * modes))
    for k, frequency in enumerate(frequencies):
        damping = rng.uniform(0.01, 0.1)
        A[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = [
            [-damping * frequency, frequency],
            [-frequency, -damping * frequency],
        ]
    B, C = rng.normal(size=(2 * modes, nu)), rng.normal(size=(ny, 2 * modes))
    D = rng.normal(size=(ny, nu)) if feedthrough else None
    return StateSpace(A, B, C, D)


def batch(count=3, dt=0.0, **options):
    """Several of them, stacked."""
    systems = [flexible(seed, **options) for seed in range(count)]
    systems = [system.discretise(dt) for system in systems] if dt else systems
    A, B, C, D = (
        jnp.stack([getattr(system, name) for system in systems]) for name in ("A", "B", "C", "D")
    )
    return StateSpace(A, B, C, D, dt=dt)


def matrices(system):
    return tuple(np.asarray(m) for m in (system.A, system.B, system.C, system.D))
