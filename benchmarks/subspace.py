"""Subspace identification against SLICOT (`ctrlsys`): CPU time beside quality, in one process.

`run()` gives rows of one fit at several lengths, and of many noise realisations. Times are CPU
seconds of the whole call (`process_time`: all threads count), least and median of repeats after the
first call, which is kept apart. Repeats of both sides take turns, so that both see the same load.
Run it with `OMP_NUM_THREADS=1`: one BLAS thread on both sides.
"""

import time

import ctrlsys
import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import block_diag
from scipy.signal import dlsim

from lpvid.data import IOData
from lpvid.identify import (
    CVA,
    N4SID,
    ORSE,
    InformationCriterion,
    LargestGap,
    NoiseFloor,
    PastInputMOESP,
    PastOutputMOESP,
    identify,
)

DT, ORDER, BLOCK_ROWS, DECIBEL = 1 / 50, 6, 20, 30.0


def plant():
    """Modes at 2, 5 and 11 Hz, damping 2, 1.5 and 1 %, 50 Hz, 2 inputs, 2 outputs."""
    rng = np.random.default_rng(7)
    blocks = []
    for hertz, damping in ((2.0, 0.02), (5.0, 0.015), (11.0, 0.01)):
        omega = 2 * np.pi * hertz
        pole = np.exp(DT * omega * (-damping + 1j * np.sqrt(1 - damping**2)))
        blocks.append([[pole.real, pole.imag], [-pole.imag, pole.real]])
    B, C = rng.standard_normal((6, 2)), rng.standard_normal((2, 6))
    return block_diag(*blocks), B, C, 0.5 * rng.standard_normal((2, 2))


def records(n, realisations=1, seed=0):
    """Binary inputs, clean outputs, outputs with white noise (realisation, time, output)."""
    rng = np.random.default_rng(seed)
    u = np.where(rng.standard_normal((n, 2)) > 0, 1.0, -1.0)
    clean = dlsim((*plant(), 1.0), u)[1]
    noise = rng.standard_normal((realisations, *clean.shape))
    return u, clean, clean + noise * clean.std(axis=0) * 10 ** (-DECIBEL / 20)


def slicot(u, y, algorithm):
    """MOEN4: A and C by MOESP, B and D by N4SID. `C` Cholesky, `Q` QR."""
    (n, nu), ny = u.shape, y.shape[1]
    u, y = np.asfortranarray(u), np.asfortranarray(y)
    factor = ctrlsys.ib01ad("M", algorithm, "N", "O", "N", "N", BLOCK_ROWS, nu, ny, u, y, 0.0, -1.0)
    return ctrlsys.ib01bd("C", "A", "N", BLOCK_ROWS, ORDER, nu, ny, n, factor[1], 0.0)[:4]


def slicot_matrices(u, y, algorithm):
    A, C, B, D = slicot(u, y, algorithm)
    return A, B, C, D


def fit_to_clean(matrices, u, clean):
    """Mean over outputs of the fit to the clean output, in percent."""
    simulated = dlsim((*(np.asarray(m) for m in matrices), 1.0), u)[1]
    missed = np.linalg.norm(clean - simulated, axis=0)
    return float(np.mean(100 * (1 - missed / np.linalg.norm(clean - clean.mean(axis=0), axis=0))))


def measured(calls, repeats):
    """First, least and median CPU seconds, least wall seconds and last value of every call."""
    first, cpu, wall, value = {}, {}, {}, {}
    for name, call in calls.items():
        start = time.process_time()
        value[name] = call()
        first[name], cpu[name], wall[name] = time.process_time() - start, [], []
    for _ in range(repeats):
        for name, call in calls.items():
            # Once untimed: the cache holds this side's data, not what the other side left.
            call()
            start, clock = time.process_time(), time.perf_counter()
            value[name] = call()
            cpu[name].append(time.process_time() - start)
            wall[name].append(time.perf_counter() - clock)
    return {
        name: dict(
            first_s=first[name],
            cpu_s=min(cpu[name]),
            median_cpu_s=float(np.median(cpu[name])),
            wall_s=min(wall[name]),
        )
        | dict(value=value[name])
        for name in calls
    }


def one_fit(n, repeats):
    """Rows of one fit of `n` samples."""
    u, clean, noisy = records(n)
    y = noisy[0]
    data = IOData(u=u, y=y, dt=DT)
    method = PastOutputMOESP(order=ORDER, block_rows=BLOCK_ROWS)
    calls = {
        "lpvid": lambda: jax.block_until_ready(identify(data, method)),
        "slicot cholesky": lambda: slicot_matrices(u, y, "C"),
        "slicot qr": lambda: slicot_matrices(u, y, "Q"),
    }
    results = measured(calls, repeats)
    fit = results["lpvid"].pop("value")
    models = {"lpvid": (fit.model.A, fit.model.B, fit.model.C, fit.model.D)}
    status = {"lpvid": str(fit.status)}
    for name in ("slicot cholesky", "slicot qr"):
        models[name], status[name] = results[name].pop("value"), "info 0"
    return _rows(f"one fit, N = {n}", results, models, status, u, clean)


def many_fits(n, realisations, repeats):
    """Rows of many noise realisations: `lax.map` here, a loop there."""
    u, clean, noisy = records(n, realisations)
    data = IOData(u=u, y=noisy[0], dt=DT)
    method = PastOutputMOESP(order=ORDER, block_rows=BLOCK_ROWS)
    ys = jnp.asarray(noisy)

    @jax.jit
    def all_of_them(ys):
        return jax.lax.map(lambda y: identify(data.replace(y=y), method).model, ys)

    calls = {
        "lpvid lax.map": lambda: jax.block_until_ready(all_of_them(ys)),
        "slicot cholesky": lambda: [slicot_matrices(u, y, "C") for y in noisy],
    }
    results = measured(calls, repeats)
    batch = results["lpvid lax.map"].pop("value")
    models = {
        "lpvid lax.map": (batch.A[-1], batch.B[-1], batch.C[-1], batch.D[-1]),
        "slicot cholesky": results["slicot cholesky"].pop("value")[-1],
    }
    status = dict.fromkeys(models, "last of the batch")
    return _rows(f"{realisations} realisations, N = {n}", results, models, status, u, clean)


def accuracy(n=3_000, seeds=20):
    """Fit to the clean output over noise and inputs of many seeds: median and least of each."""
    methods = {
        f"lpvid {method.__name__}": method(order=ORDER, block_rows=BLOCK_ROWS)
        for method in (PastOutputMOESP, PastInputMOESP, N4SID, CVA, ORSE)
    }
    fits = {name: [] for name in (*methods, "slicot cholesky")}
    orders = {name: [] for name in ("NoiseFloor", "InformationCriterion", "LargestGap")}
    rules = (NoiseFloor(), InformationCriterion(), LargestGap())
    for seed in range(1, seeds + 1):
        u, clean, noisy = records(n, seed=seed)
        data = IOData(u=u, y=noisy[0], dt=DT)
        for name, method in methods.items():
            model = identify(data, method).model
            fits[name].append(fit_to_clean((model.A, model.B, model.C, model.D), u, clean))
        fits["slicot cholesky"].append(fit_to_clean(slicot_matrices(u, noisy[0], "C"), u, clean))
        for name, rule in zip(orders, rules, strict=True):
            orders[name].append(identify(data, PastOutputMOESP(rule, BLOCK_ROWS)).order)
    return [
        dict(who=name, median=float(np.median(values)), least=min(values))
        for name, values in fits.items()
    ], {name: sum(order == ORDER for order in found) for name, found in orders.items()}


def _rows(what, results, models, status, u, clean):
    reference = results["slicot cholesky"]["cpu_s"]
    return [
        dict(
            what=what,
            who=name,
            **times,
            ratio=times["cpu_s"] / reference,
            fit_percent=fit_to_clean(models[name], u, clean),
            status=status[name],
        )
        for name, times in results.items()
    ]


def run(*, short=3_000, long=30_000, realisations=100, repeats=40):
    """All rows. `ratio` is CPU time over that of SLICOT's Cholesky route in the same run."""
    return [
        *one_fit(short, repeats),
        *one_fit(long, max(repeats // 2, 3)),
        *many_fits(short, realisations, max(repeats // 8, 3)),
    ]


def main():
    for row in run():
        print(
            f"{row['what']:28s} {row['who']:16s} first {row['first_s']:7.2f} s  "
            f"cpu {1e3 * row['cpu_s']:8.2f} ms (median {1e3 * row['median_cpu_s']:8.2f})  "
            f"wall {1e3 * row['wall_s']:8.2f} ms  ratio {row['ratio']:6.2f}  "
            f"fit {row['fit_percent']:.3f} %  {row['status']}"
        )
    seeds = 20
    rows, orders = accuracy(seeds=seeds)
    print(f"\nFit to the clean output, N = 3000, {seeds} seeds")
    for row in rows:
        print(f"{row['who']:24s} median {row['median']:.3f} %  least {row['least']:.3f} %")
    print("Order found: " + ", ".join(f"{name} {n}/{seeds}" for name, n in orders.items()))


if __name__ == "__main__":
    main()
