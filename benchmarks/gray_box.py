"""Mass, damping and stiffness of the study of Olofsson et al. (2014), against its figures.

    python -m benchmarks.gray_box [--runs 100]

Records: steps of 0.5 to 1 N held for 1 to 4 s, 20 000 samples at 5 ms, output noise 3e-4. Ranges of
the search and the default weight were chosen on other seeds (those of `random_steps` 100 to 105).
"""

import os

# One BLAS thread, before anything loads a BLAS.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import time

import jax
import jax.numpy as jnp
import numpy as np

import lpvid as lv
from lpvid import mechanics
from lpvid._results import Status
from lpvid.identify import (
    ContinuousTimeCVA,
    ContinuousTimeMOESP,
    ContinuousTimeN4SID,
    gray_box,
    identify_mechanical,
    simulation_fit,
)
from lpvid.models import MechanicalStructure, StructuredModel
from lpvid.refinement import refine
from lpvid.report import text_table

DT, SAMPLES, NOISE = 5e-3, 20_000, 3e-4
PUBLISHED = {"M": 0.0303, "D": 0.125, "K": 0.00108, "fit 1 %": 97.6, "fit 2 %": 96.9}
WANTED = {"M": 0.002, "D": 0.006, "K": 0.001}
METHODS = {
    "MOESP": ContinuousTimeMOESP,
    "N4SID": ContinuousTimeN4SID,
    "CVA": ContinuousTimeCVA,
}


def clean_record(system, seed: int, dt: float = DT, hold=(1.0, 4.0)) -> lv.IOData:
    u = mechanics.random_steps(jax.random.key(seed), SAMPLES, 2, dt=dt, hold=hold)
    return lv.IOData(u=u, y=system.state_space().simulate(u=u, dt=dt), dt=dt)


def with_noise(data: lv.IOData, seed: int, spread) -> lv.IOData:
    noise = jax.random.normal(jax.random.key(seed), data.y.shape)
    return data.replace(y=data.y + jnp.asarray(spread) * noise)


def errors(matrices, system) -> np.ndarray:
    """Relative Frobenius errors of M, D and K."""
    truth = (system.mass, system.damping, system.stiffness)
    return np.array(
        [np.linalg.norm(a - b) / np.linalg.norm(b) for a, b in zip(matrices, truth, strict=True)]
    )


def matrices_of(fit) -> tuple:
    return fit.mass, fit.damping, fit.stiffness


def bound(system, data: lv.IOData, noise: float) -> np.ndarray:
    """Cramér–Rao bound of the relative Frobenius errors: root of the expected squares.

    Nine parameters and the four initial states, white Gaussian noise of known variance.
    """
    structure = MechanicalStructure(n_degrees=2)
    matrices = (system.mass, system.damping, system.stiffness)
    parameters = structure.parameters_of(*matrices)
    # Displacements and speeds of about their size, so that the information is well scaled.
    size = jnp.tile(jnp.std(jnp.asarray(data.y), axis=0), 2)

    def simulated(unknowns):
        model = structure.matrices(unknowns[:9])
        return model.simulate(u=data.u, dt=data.dt, x0=size * unknowns[9:]).reshape(-1)

    jacobian = jax.jacfwd(simulated)(jnp.concatenate([parameters, jnp.zeros(4)]))
    covariance = noise**2 * jnp.linalg.inv(jacobian.T @ jacobian)[:9, :9]
    slopes = jax.jacfwd(structure.mechanical_matrices)(parameters)
    return np.array(
        [
            np.sqrt(np.einsum("ijp,pq,ijq->", slope, covariance, slope)) / np.linalg.norm(matrix)
            for slope, matrix in zip(slopes, matrices, strict=True)
        ]
    )


def published_settings(seed: int = 1) -> list[dict]:
    """At τ = 0.15 s and i = 10, each weight; fits on a validation record with and without noise."""
    system = mechanics.MassSpringDamper.reference()
    data = with_noise(clean_record(system, seed), seed + 1000, NOISE)
    clean = clean_record(system, seed + 1)
    noisy = with_noise(clean, seed + 1001, NOISE)
    rows = [{"method": "published", **PUBLISHED}]
    truth = simulation_fit(system.state_space().discretise(DT), noisy)
    rows.append({"method": "true plant", **_fits(truth, "noisy ")})
    laguerre, powers = gray_box.LaguerreFilters(), gray_box.FilterPowers()
    # Ten filters in all is the other reading of the published i.
    for basis, rows_each in ((laguerre, 10), (laguerre, 5), (powers, 10), (powers, 5)):
        for name, method in METHODS.items():
            chosen = method(tau=0.15, block_rows=rows_each, filters=basis)
            fit = identify_mechanical(data, chosen, throw=False)
            row = {"method": f"{name}, {type(basis).__name__}", "rows": rows_each}
            row |= dict(zip("MDK", errors(matrices_of(fit), system), strict=True))
            if np.all(np.isfinite(np.asarray(fit.mass))):
                discrete = fit.model.discretise(DT)
                row |= _fits(simulation_fit(discrete, clean), "")
                row |= _fits(simulation_fit(discrete, noisy), "noisy ")
            rows.append(row | {"status": Status[fit.status].split(".")[0]})
    return rows


def _fits(fits, kind: str) -> dict:
    return {f"{kind}fit {k + 1} %": float(value) for k, value in enumerate(fits)}


def realisations(runs: int, seed: int = 1) -> list[dict]:
    """Errors over noise realisations: searched, then refined, against the bound."""
    system = mechanics.MassSpringDamper.reference()
    clean = clean_record(system, seed)
    limit = bound(system, clean, NOISE)
    structure = MechanicalStructure(n_degrees=2)
    found: dict[str, list] = {"searched": [], "refined": []}
    seconds = {"searched": 0.0, "refined": 0.0}
    for run in range(runs + 1):
        data = with_noise(clean, 5000 + run, NOISE)
        start = time.perf_counter()
        fit = identify_mechanical(data)
        middle = time.perf_counter()
        refined = refine(StructuredModel(fit.structure, fit.parameters), data)
        parameters = jax.block_until_ready(refined.parameters)
        end = time.perf_counter()
        if run == 0:
            # Compilation.
            continue
        seconds["searched"] += (middle - start) / runs
        seconds["refined"] += (end - middle) / runs
        found["searched"].append(errors(matrices_of(fit), system))
        found["refined"].append(errors(structure.mechanical_matrices(parameters), system))
    rows = [{"estimate": "wanted, median", **WANTED}]
    rows.append({"estimate": "Cramér–Rao bound, root mean square", **_named(limit)})
    for stage, samples in found.items():
        squares = np.sqrt(np.mean(np.square(samples), axis=0))
        rows.append({"estimate": f"{stage}, median", **_named(np.median(samples, axis=0))})
        rows[-1]["s a run"] = seconds[stage]
        rows.append({"estimate": f"{stage}, root mean square", **_named(squares)})
        rows.append({"estimate": f"{stage}, over the bound", **_named(squares / limit)})
    return rows


def _named(values) -> dict:
    return dict(zip("MDK", map(float, values), strict=True))


def micro_manipulator(seed: int = 1) -> list[dict]:
    """Frequencies of the micro-manipulator at several noise levels; τ and i searched."""
    system = mechanics.MassSpringDamper.micro_manipulator()
    clean = clean_record(system, seed, dt=1e-4, hold=(0.02, 0.08))
    spread = np.std(np.asarray(clean.y), axis=0)
    rows = [{"noise": "published", "Hz 1": 83.1, "Hz 2": 96.7}]
    for ratio in (np.inf, 30.0, 20.0, 10.0):
        data = with_noise(clean, seed + 1, spread * 10 ** (-ratio / 20))
        fit = identify_mechanical(data)
        hertz = np.asarray(fit.modes.frequencies) / (2 * np.pi)
        row = {"noise": f"{ratio:g} dB", "Hz 1": hertz[0], "Hz 2": hertz[1]}
        row |= {"off %": 100 * np.abs(hertz / [83.1, 96.7] - 1).max()}
        row |= _named(errors(matrices_of(fit), system))
        row |= {"tau ms": 1e3 * float(fit.tau), "i": int(fit.block_rows)}
        rows.append(row)
    return rows


def run(runs: int = 100) -> dict[str, list[dict]]:
    """Rows of every table by title."""
    return {
        "At the published filter, tau = 0.15 s and i = 10": published_settings(),
        f"Relative Frobenius errors over {runs} noise realisations": realisations(runs),
        "Micro-manipulator": micro_manipulator(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.gray_box", description=__doc__)
    parser.add_argument("--runs", type=int, default=100)
    for title, rows in run(parser.parse_args().runs).items():
        headers = list(dict.fromkeys(key for row in rows for key in row))
        print(f"\n{title}")
        print(text_table([[row.get(key, "") for key in headers] for row in rows], headers))


if __name__ == "__main__":
    main()
