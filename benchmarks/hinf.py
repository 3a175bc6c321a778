"""H-infinity norms in a batch, with gradients, against SLICOT's AB13DD in a loop without them.

    python -m benchmarks.hinf [--systems 1000] [--seed 1]

CPU time, both sides in one run and on the same systems: differences of a black box and a model that
is a few percent off, as the restructuring meets them. With `--systems` also the accuracy on random
systems: 1 to 50 states, damping from 0.5 down to 1e-4, modes between 0.1 and 100 rad/s in a random
basis, continuous and sampled at 10 Hz, with and without D, one in six with unstable modes (whose
L-infinity norm is compared). A norm is `low` where the response in extended precision, at the
frequency that the other one gives, exceeds it by more than 1e-9.
"""

import os

# One BLAS thread on both sides, before anything loads a BLAS.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import itertools
import time
from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np
from scipy.linalg import expm
from tqdm import tqdm

from lpvid import analysis, models
from lpvid._results import Status
from lpvid.report import text_table

# States, inputs, outputs.
SHAPES = ((1, 1, 1), (2, 1, 1), (5, 2, 1), (9, 1, 3), (16, 3, 3), (31, 2, 2), (50, 3, 2))
DT = 0.1


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


def random_system(
    rng: np.random.Generator, shape: tuple[int, int, int], dt: float, feedthrough: bool
) -> tuple[tuple[np.ndarray, ...], bool]:
    """Matrices of a random system and whether it is unstable."""
    nx, nu, ny = shape
    A = np.zeros((nx, nx))
    unstable = int(rng.integers(1, 3)) if nx > 1 and rng.random() < 1 / 6 else 0
    for mode in range(nx // 2):
        omega, damping = 10 ** rng.uniform(-1, 2), 10 ** rng.uniform(-4, np.log10(0.5))
        damping = -damping if mode < unstable else damping
        block = slice(2 * mode, 2 * mode + 2)
        A[block, block] = omega * np.array([[-damping, 1.0], [-1.0, -damping]])
    if nx % 2:
        A[-1, -1] = -(10 ** rng.uniform(-1, 2))
    T = np.linalg.qr(rng.standard_normal((nx, nx)))[0] * 10 ** rng.uniform(-0.5, 0.5, nx)
    A = np.linalg.solve(T, A @ T)
    B, C = rng.standard_normal((nx, nu)), rng.standard_normal((ny, nx))
    D = feedthrough * 10 ** rng.uniform(-2, 2) * rng.standard_normal((ny, nu))
    if dt:
        held = expm(np.block([[A, B], [np.zeros((nu, nx + nu))]]) * dt)
        A, B = held[:nx, :nx], held[:nx, nx:]
    return (A, B, C, D), unstable > 0


def extended_gain(A, B, C, D, omega: float, dt: float) -> float:
    """The largest singular value at one frequency, by elimination in extended precision."""
    if np.isinf(omega):
        return float(np.linalg.norm(D, 2))
    point = np.exp(1j * np.longdouble(omega) * dt) if dt else 1j * np.longdouble(omega)
    nx = A.shape[0]
    pencil = point * np.eye(nx, dtype=np.clongdouble) - A
    table = np.concatenate([pencil, B.astype(np.clongdouble)], axis=1)
    for k in range(nx):
        pivot = k + np.argmax(np.abs(table[k:, k]))
        table[[k, pivot]] = table[[pivot, k]]
        factors = table[:, k] / table[k, k]
        factors[k] = 0.0
        table -= factors[:, None] * table[k]
    states = table[:, nx:] / np.diagonal(table)[:, None]
    return float(np.linalg.norm((C @ states + D).astype(complex), 2))


def accuracy(count: int = 1000, seed: int = 1) -> list[dict]:
    """Rows of relative differences to AB13DD, one for each kind of system."""
    slycot = _slycot()
    kinds = list(itertools.product(SHAPES, (0.0, DT), (False, True)))
    rng = np.random.default_rng(seed)
    norms = eqx.filter_jit(analysis.hinf_norm)
    rows = []
    for (shape, dt, feedthrough), size in tqdm(
        zip(kinds, [len(part) for part in np.array_split(range(count), len(kinds))], strict=True),
        total=len(kinds),
    ):
        drawn = [random_system(rng, shape, dt, feedthrough) for _ in range(size)]
        systems, unstable = [system for system, _ in drawn], np.array([u for _, u in drawn])
        stacked = (np.stack(matrices) for matrices in zip(*systems, strict=True))
        model = models.StateSpace(*stacked, dt=dt)

        def peer(systems=systems, shape=shape, dt=dt):
            nx, nu, ny = shape
            kind, eye = "D" if dt else "C", np.eye(nx)
            return np.array(
                [
                    slycot.ab13dd(kind, "I", "S", "D", nx, nu, ny, A, eye, B, C, D, 1e-12)
                    for A, B, C, D in systems
                ]
            )

        expected = peer()
        found = norms(model)
        value, omega = np.asarray(found.value), np.asarray(found.frequency)
        right = np.where(
            unstable, found.status == Status.l_infinity, found.status == Status.successful
        )
        difference = np.abs(value / expected[:, 0] - 1)
        high, low = np.zeros(size, bool), np.zeros(size, bool)
        for k in np.flatnonzero(difference > 1e-9):
            theirs = expected[k, 1] / dt if dt else expected[k, 1]
            high[k] = extended_gain(*systems[k], omega[k], dt) > expected[k, 0] * (1 + 1e-9)
            low[k] = extended_gain(*systems[k], theirs, dt) > value[k] * (1 + 1e-9)
        _, ours = _timed(lambda model=model: jax.block_until_ready(norms(model)), 2)
        _, slicot = _timed(peer, 2)
        rows.append(
            {
                "n, nu, ny": "{}, {}, {}".format(*shape),
                "dt": dt,
                "with D": feedthrough,
                "systems": size,
                "unstable": int(unstable.sum()),
                "worst relative difference": float(np.max(difference[~high], initial=0.0)),
                "over 1e-9": int(np.sum(difference > 1e-9)),
                "AB13DD low": int(high.sum()),
                "lpvid low": int(low.sum()),
                "other status": int(np.sum(~right)),
                "CPU over AB13DD's": ours / slicot,
            }
        )
    return rows


def _slycot():
    try:
        import slycot
    except ImportError as error:
        raise ImportError(
            "The H-infinity benchmark compares with SLICOT: install the `bench` extra (slycot)."
        ) from error
    return slycot


def run(count: int = 700, n: int = 12, repeats: int = 5) -> list[dict]:
    """Rows of CPU seconds, first call apart, and the largest relative difference to AB13DD."""
    slycot = _slycot()
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


def _table(rows: list[dict]) -> str:
    headers = list(dict.fromkeys(key for row in rows for key in row))
    return text_table([[row.get(key, "") for key in headers] for row in rows], headers)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.hinf", description=__doc__)
    parser.add_argument("--systems", type=int, default=0, help="random systems to compare")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    print(_table(run()))
    if arguments.systems:
        rows = accuracy(arguments.systems, arguments.seed)
        worst = max(row["worst relative difference"] for row in rows)
        counts = {
            name: sum(row[name] for row in rows)
            for name in ("systems", "over 1e-9", "AB13DD low", "lpvid low", "other status")
        }
        print(
            f"\n{_table(rows)}\n\nWorst relative difference, AB13DD not low: {worst:.2g}; ", end=""
        )
        print(", ".join(f"{name}: {count}" for name, count in counts.items()))


if __name__ == "__main__":
    main()
