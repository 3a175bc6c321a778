"""Step responses (003): the paper's claims, noise, and the comparison with subspace methods.

Plant: [[8 (s+10)(s²+25) / ((s+2)(s²+2s+100)), −1/(s+2)], [1, 5 (50−s) / (s²+2s+25)]], order 5,
sampled at 0.01 s for 60 s, one unit step on each input.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import warnings

import numpy as np
from scipy.signal import max_len_seq

from lpvid._results import Status
from lpvid.data import IOData
from lpvid.identify import (
    DeviationSubspace,
    DualRealisation,
    PastOutputMOESP,
    PrimalRealisation,
    identify,
    identify_step_response,
)
from lpvid.models import StateSpace
from lpvid.refinement import refine
from lpvid.report import text_table

SAMPLE_TIME = 0.01
DURATION = 60.0
# Sorted by imaginary part: 003 gives −2, −1 ± 4.90j and −1 ± 9.95j.
POLES = -np.array([1, 1, 2, 1, 1]) + 1j * np.array([-(99**0.5), -(24**0.5), 0, 24**0.5, 99**0.5])
FEEDTHROUGH = np.array([[8.0, 0.0], [1.0, 0.0]])
# What 003 says of its models, by order: published method; subspace with a step, with M-sequences.
PAPER_STABLE = {
    "moments": {1, 3, 5},
    "subspace, steps": {5},
    "subspace, M-sequences": {4, 5},
}


def plant() -> StateSpace:
    """The paper's plant (equation 52), minimal, in modal form."""
    # 8 (s+10)(s²+25) / ((s+2)(s²+2s+100)) = 8 + r/(s+2) + (b1 s + b0)/(s²+2s+100)
    pair = np.array([1.0, 2.0, 100.0])
    numerator = 8.0 * np.polymul([1.0, 10.0], [1.0, 0.0, 25.0])
    rest = np.polysub(numerator, 8.0 * np.polymul([1.0, 2.0], pair))
    r = np.polyval(rest, -2.0) / np.polyval(pair, -2.0)
    b1, b0 = np.polydiv(np.polysub(rest, r * pair), [1.0, 2.0])[0][-2:]
    A = np.zeros((5, 5))
    A[0, 0] = -2.0
    A[1:3, 1:3] = [[0.0, 1.0], [-100.0, -2.0]]
    A[3:5, 3:5] = [[0.0, 1.0], [-25.0, -2.0]]
    B = np.array([[1.0, -1.0 / r], [0, 0], [1, 0], [0, 0], [0, 1]])
    C = np.array([[r, b0, b1, 0.0, 0.0], [0.0, 0.0, 0.0, 250.0, -5.0]])
    return StateSpace(A, B, C, FEEDTHROUGH)


def step_inputs(time: int) -> np.ndarray:
    """One unit step on each input in turn, (record, time, input)."""
    return np.repeat(np.eye(2)[:, None, :], time, axis=1)


def respond(model: StateSpace, u: np.ndarray) -> np.ndarray:
    """Responses of a continuous-time model to held inputs, (record, time, output)."""
    return np.stack([np.asarray(model.simulate(u=one, dt=SAMPLE_TIME)) for one in u])


def records(noise: float = 0.0, seed: int = 0, duration: float = DURATION) -> IOData:
    """The paper's experiments, with white output noise of a given standard deviation."""
    u = step_inputs(round(duration / SAMPLE_TIME) + 1)
    y = respond(plant(), u)
    y = y + noise * np.random.default_rng(seed).standard_normal(y.shape)
    return IOData(u=u, y=y, dt=SAMPLE_TIME)


def step_fits(model: StateSpace, duration: float = DURATION) -> np.ndarray:
    """Fit of a model's step responses to the plant's, (output, input), percent.

    100 (1 − |y − ŷ| / |y − mean y|) without noise; channel (2, 1), a gain of one, has no variation
    within the record: its y is measured from the rest before the step.
    """
    u = step_inputs(round(duration / SAMPLE_TIME) + 1)
    y, y_hat = respond(plant(), u), respond(model, u)
    size = np.linalg.norm(y - y.mean(axis=1, keepdims=True), axis=1)
    size[0, 1] = np.linalg.norm(y[0, :, 1])
    return 100.0 * (1.0 - np.linalg.norm(y - y_hat, axis=1) / size).T


def fit(data: IOData, order: int, method):
    """`identify_step_response`, its warnings left to the status."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return identify_step_response(data, order=order, method=method, throw=False)


def claims() -> list[dict]:
    """Without noise: which orders are stable, here and in the paper, and how near order 5 comes."""
    data, rows = records(), []
    methods = {
        "primal": PrimalRealisation(),
        "dual": DualRealisation(),
        "deviations": DeviationSubspace(),
    }
    for name, method in methods.items():
        for order in range(1, 6):
            found = fit(data, order, method)
            row = {
                "method": name,
                "order": order,
                "stable": bool(found.model.is_stable()),
                "003": "" if name == "deviations" else order in PAPER_STABLE["moments"],
                "status": Status[found.status].split(".")[0],
            }
            if row["stable"]:
                row |= _fit_columns(step_fits(found.model))
            if order == 5:
                row["pole error"] = float(np.max(np.abs(_poles(found.model) - POLES)))
                row["D error"] = float(np.max(np.abs(np.asarray(found.model.D) - FEEDTHROUGH)))
            rows.append(row)
    return rows


def noise_study(noise: float, seeds: range, order: int = 5, refined: bool = True) -> list[dict]:
    """Stable models and step-response fits over noise realisations, method by method."""
    fits = {"primal": [], "dual": [], "deviations": []} | ({"refined": []} if refined else {})
    for seed in seeds:
        data = records(noise, seed)
        fits["primal"].append(fit(data, order, PrimalRealisation()).model)
        fits["dual"].append(fit(data, order, DualRealisation()).model)
        start = fit(data, order, DeviationSubspace()).model
        fits["deviations"].append(start)
        if refined:
            fits["refined"].append(refine(start, data, initial_state="zero").model)
    rows = []
    for name, found in fits.items():
        stable = [bool(model.is_stable()) for model in found]
        percent = np.array([step_fits(m) for m, s in zip(found, stable, strict=True) if s])
        row = {"noise": noise, "method": name, "stable": f"{sum(stable)}/{len(stable)}"}
        if len(percent):
            row |= _fit_columns(percent.min(axis=0), "min ")
            row |= _fit_columns(np.median(percent, axis=0), "median ")
        rows.append(row)
    return rows


def subspace_comparison() -> list[dict]:
    """PO-MOESP on the inputs of 003's comparison (equations 54 and 55), without noise."""
    rows = []
    for kind, u in comparison_inputs().items():
        data = IOData(u=u, y=respond(plant(), u[None])[0], dt=SAMPLE_TIME)
        for order in range(1, 6):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                found = identify(data, PastOutputMOESP(order=order, block_rows=20), throw=False)
            row = {
                "input": kind,
                "order": order,
                "stable": bool(found.model.is_stable()),
                "003": order in PAPER_STABLE[f"subspace, {kind}"],
                "status": Status[found.status].split(".")[0],
            }
            if row["stable"]:
                row |= _fit_columns(step_fits(found.model))
            rows.append(row)
    return rows


def comparison_inputs() -> dict[str, np.ndarray]:
    """Steps one after the other, and two M-sequences held for 11 samples, 120 s each."""
    time = round(2 * DURATION / SAMPLE_TIME)
    first = np.arange(time) < time // 2
    sequence = 2.0 * max_len_seq(10)[0] - 1.0
    shifted = np.roll(sequence, sequence.size // 2)
    held = np.repeat(np.stack([sequence, shifted], axis=1), 11, axis=0)
    repeats = -(-time // held.shape[0])
    return {
        "steps": np.stack([first, ~first], axis=1).astype(float),
        "M-sequences": np.tile(held, (repeats, 1))[:time],
    }


def _poles(model: StateSpace) -> np.ndarray:
    poles = np.asarray(model.poles())
    return poles[np.argsort(poles.imag)]


def _fit_columns(percent: np.ndarray, prefix: str = "") -> dict[str, float]:
    return {f"{prefix}fit {i + 1}{j + 1}": float(percent[i, j]) for i in range(2) for j in range(2)}


def run(seeds: int = 20) -> list[dict]:
    """Rows of the noise study at the levels of the issue: seeds 0, 1, …"""
    return [row for noise in (1e-3, 1e-2) for row in noise_study(noise, range(seeds))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20, help="noise realisations, from seed 0 on")
    seeds = parser.parse_args().seeds
    tables = {
        "Without noise, beside what 003 says": claims(),
        "White output noise, order 5; fits are those of the stable models": run(seeds),
        "PO-MOESP on 003's inputs, without noise": subspace_comparison(),
    }
    for title, rows in tables.items():
        headers = list(dict.fromkeys(key for row in rows for key in row))
        cells = [[_cell(row.get(key, "")) for key in headers] for row in rows]
        print(f"\n{title}")
        print(text_table(cells, headers))


def _cell(value: object) -> object:
    return f"{value:.4g}" if isinstance(value, float) and abs(value) < 1 else value


if __name__ == "__main__":
    main()
