"""H-infinity norms in a batch, with gradients, against SLICOT's AB13DD in a loop without them.

CPU time, both sides in one run and on the same systems: differences of a black box and a model that
is a few percent off, as the restructuring meets them.
"""

import os

# One BLAS thread on both sides, before anything loads a BLAS.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import time
from collections.abc import Callable

import jax
import numpy as np

from lpvid import analysis, models
from lpvid._results import Status


def difference_systems(count: int, n: int, seed: int = 0) -> tuple[np.ndarray, ...]:
    """A, B, C, D of `count` differences of two models with n / 2 states, two inputs and outputs."""
    if n % 4:
        raise ValueError(f"n must be a multiple of 4 (two models of oscillating modes), got {n}.")
    rng = np.random.default_rng(seed)
    half = n // 2
    modes = half // 2
    omega = 2 * np.pi * np.linspace(2.0, 11.0, modes)
    damping = np.linspace(0.02, 0.01, modes)
    A, B, C = np.zeros((count, n, n)), np.zeros((count, n, 2)), np.zeros((count, 2, n))
    for index in range(count):
        inputs, outputs = rng.standard_normal((half, 2)), rng.standard_normal((2, half))
        for side, (error, sign) in enumerate(((0.0, 1.0), (0.02, -1.0))):
            speed = omega * (1 + error * rng.standard_normal(modes))
            rate = damping * (1 + 5 * error * rng.standard_normal(modes)) * speed
            modal = np.diag(np.repeat(-rate, 2))
            even = np.arange(0, half, 2)
            modal[even, even + 1], modal[even + 1, even] = speed, -speed
            T = np.linalg.qr(rng.standard_normal((half, half)))[0]
            part = slice(side * half, (side + 1) * half)
            A[index, part, part] = T.T @ modal @ T
            B[index, part] = T.T @ (inputs + error * rng.standard_normal((half, 2)))
            C[index, :, part] = sign * (outputs + error * rng.standard_normal((2, half))) @ T
    return A, B, C, np.zeros((count, 2, 2))


def run(count: int = 700, n: int = 12, repeats: int = 5) -> list[dict]:
    """Rows of CPU seconds, first call apart, and the largest relative difference to AB13DD."""
    try:
        import slycot
    except ImportError as error:
        raise ImportError(
            "The H-infinity benchmark compares with SLICOT: install the `bench` extra (slycot)."
        ) from error
    matrices = difference_systems(count, n)
    eye = np.eye(n)

    def peer():
        return np.array(
            [
                slycot.ab13dd("C", "I", "N", "Z", n, 2, 2, a, eye, b, c, d, 1e-10)[0]
                for a, b, c, d in zip(*matrices, strict=True)
            ]
        )

    def norm(A, B, C, D):
        found = analysis.hinf_norm(models.StateSpace(A, B, C, D))
        return found.value, found.status

    batched = jax.jit(jax.vmap(norm))
    gradients = jax.value_and_grad(norm, argnums=(0, 1, 2, 3), has_aux=True)
    batched_gradients = jax.jit(jax.vmap(gradients))
    looped_gradients = jax.jit(lambda *m: jax.lax.map(lambda s: gradients(*s), m))
    ours = {
        "lpvid, vmap": lambda: batched(*matrices),
        "lpvid, vmap, with gradients": lambda: batched_gradients(*matrices)[0],
        "lpvid, lax.map, with gradients": lambda: looped_gradients(*matrices)[0],
    }
    expected = peer()
    rows = [_row("slycot AB13DD, loop, no gradients", *_timed(peer, repeats), count)]
    for name, call in ours.items():
        first, best = _timed(lambda call=call: jax.block_until_ready(call()), repeats)
        value, status = call()
        row = _row(name, first, best, count)
        row["max relative difference"] = float(np.max(np.abs(np.asarray(value) / expected - 1)))
        row["successful"] = float(np.mean(np.asarray(status == Status.successful)))
        row["speed-up over AB13DD"] = rows[0]["cpu s"] / best
        rows.append(row)
    return rows


def _timed(call: Callable[[], object], repeats: int) -> tuple[float, float]:
    """CPU seconds of the first call (compilation included) and of the best later one."""
    times = []
    for _ in range(repeats + 1):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return times[0], min(times[1:])


def _row(name: str, first: float, best: float, count: int) -> dict:
    return {"what": name, "cpu s": best, "first call cpu s": first, "us each": 1e6 * best / count}


if __name__ == "__main__":
    for line in run():
        print("  ".join(f"{k}: {v:.4g}" if isinstance(v, float) else v for k, v in line.items()))
