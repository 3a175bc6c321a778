"""The study of 001 with 100 noise realisations per point, its tables beside the paper's.

`python -m benchmarks.study [--runs 100]` runs the whole study twice in one process, the first call
(compilation included) apart, and prints tables 1 to 4 of 001 with the spread over the runs. Every
black box is then restructured once more from the true parameters, to compare with; that is no part
of the study and is timed apart.
"""

import os

# Before anything loads a BLAS.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import time

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from lpvid.analysis import parameter_fit
from lpvid.commands._demo_tables import angle, tables
from lpvid.interpolate import balance_along, interpolate
from lpvid.models import Polynomial
from lpvid.report import text_table
from lpvid.study import MonteCarloResult, run_monte_carlo

# 001, table 3: FIT of A(κ), B(κ), C(κ) and D(κ), percent; D of the first two is not determined.
PAPER_FIT = {
    ("restructured", 1): (84.7, 78.1, 97.9, None),
    ("restructured", 2): (96.6, 88.8, 98.9, None),
    ("analytic", 1): (88.2, 82.7, 100.0, None),
    ("analytic", 2): (94.5, 91.5, 100.0, None),
    ("balanced", 1): (92.0, 86.6, 84.7, 94.8),
    ("balanced", 2): (94.8, 90.1, 91.1, 98.4),
}
# 001, table 2.
PAPER_COST = (4.03e-3, 2.1e-3, 1.48e-3, 1.25e-3, 1.03e-3, 7.28e-4, 4.79e-4)
PAPER_SECONDS = 90.0


class Stages:
    """Wall and CPU seconds of each stage, which tqdm announces."""

    def __init__(self):
        self.rows: list[tuple[str, float, float]] = []
        self._begun: tuple[str, float, float] | None = None

    def begin(self, name: str) -> None:
        self.end()
        tqdm.write(name)
        self._begun = (name, time.perf_counter(), time.process_time())

    def end(self) -> None:
        if self._begun is not None:
            name, wall, cpu = self._begun
            row = (name, time.perf_counter() - wall, time.process_time() - cpu)
            self.rows.append(row)
        self._begun = None

    def of_study(self) -> list[tuple[str, float, float]]:
        """Stages of the study itself, the comparison with the truth left out."""
        return [row for row in self.rows if "true parameters" not in row[0]]


def run(runs: int = 100, seed: int = 0) -> tuple[MonteCarloResult, Stages, Stages]:
    """The study twice: what it found, and the stages of the first and of the second call."""
    first, second = Stages(), Stages()
    key = jax.random.key(seed)
    run_monte_carlo(key, runs=runs, report=first.begin, progress=True)
    first.end()
    result = run_monte_carlo(key, runs=runs, reference=True, report=second.begin, progress=True)
    second.end()
    return result, first, second


def steady_state_errors(result: MonteCarloResult) -> np.ndarray:
    """‖G_i(0) − I‖ of every black box: no ϑ can have a smaller H∞ error.

    At rest the arm's velocities are their references, whatever ϑ is: G(0, ϑ) = I.
    """
    model = result.black_boxes.values.model
    at_rest = model.D - model.C @ np.linalg.solve(model.A, model.B)
    return np.linalg.svd(at_rest - np.eye(2), compute_uv=False)[..., 0]


def cost_rows(result: MonteCarloResult) -> list[list]:
    """Table 2: the average models and the single runs."""
    reference = result.reference
    assert reference is not None
    ratio = (result.runs.values.error_norm / reference.values.error_norm) ** 2
    floor = steady_state_errors(result)
    rows = []
    for k, theta2 in enumerate(result.study.theta2):
        single = result.relative_cost[k]
        rows.append(
            [
                angle(theta2),
                float(result.study.relative_cost[k]),
                PAPER_COST[k],
                float(np.nanmedian(single)),
                float(np.nanmax(single)),
                int(np.sum(~result.runs.kept[k])),
                100.0 * float(np.mean(ratio[k] <= 1.05)),
                float(np.nanmax(ratio[k])),
                100.0 * float(np.mean(result.runs.values.error_norm[k] <= 1.025 * floor[k])),
            ]
        )
    return rows


def fit_rows(result: MonteCarloResult) -> list[list]:
    """Table 3: FIT of each matrix by itself (001, equation 36), the paper's in brackets."""
    study = result.study
    kappas = np.cos(np.array(study.theta2))
    local = {
        "restructured": [found.model for found in study.restructured],
        "analytic": study.analytic,
        "balanced": balance_along(study.black_boxes),
    }
    rows = []
    for (name, degree), paper in PAPER_FIT.items():
        lpv = interpolate(local[name], kappas, Polynomial(degree=degree))
        frozen = [lpv.at(kappa) for kappa in kappas]
        row: list = [name, degree]
        for matrix, published in zip("ABCD", paper, strict=True):
            wanted, found = (
                jnp.stack([getattr(model, matrix) for model in models]).reshape(-1)
                for models in (local[name], frozen)
            )
            known = bool(jnp.any(wanted != 0.0))
            row += [float(parameter_fit(wanted, found)) if known else None, published]
        rows.append(row)
    return rows


def sweep_rows(result: MonteCarloResult) -> list[list]:
    """Table 4's restructured model: of the averages, of the runs' mean, and of single runs."""
    rows = []
    for name in ("bft", "vaf"):
        mean = np.asarray(getattr(result.mean_sweep, name))
        spread = result.sweeps.summary(lambda values, name=name: getattr(values, name))
        for k in range(2):
            rows.append(
                [
                    f"{name.upper()} y{k + 1}",
                    float(getattr(result.study, f"sweep_{name}")["restructured"][k]),
                    float(mean[k]),
                    *(float(getattr(spread, part)[k]) for part in ("low", "median", "high")),
                ]
            )
    return rows


def main() -> None:
    """Run, and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.study", description=__doc__)
    parser.add_argument("--runs", type=int, default=100, help="noise realisations of each point")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    result, first, second = run(arguments.runs, arguments.seed)

    local, _, _, sweep = tables(result.study)
    print(f"\n{local.title}\n{text_table(local.rows, local.headers)}")
    headers = ["θ2", "F/‖G‖∞ of averages", "paper", "runs' median", "runs' largest", "failed"]
    headers += ["within 5 % of truth's (%)", "worst over truth's", "within 5 % of the bound (%)"]
    print("\nTable 2. Relative cost of restructuring; of the runs, against a start at the truth")
    print(text_table(cost_rows(result), headers))
    headers = ["model", "degree"]
    headers += [name for matrix in "ABCD" for name in (f"{matrix}(κ)", "paper")]
    print("\nTable 3. FIT of the interpolated matrices, percent")
    print(text_table(fit_rows(result), headers))
    print(f"\n{sweep.title}\n{text_table(sweep.rows, sweep.headers)}")
    headers = ["restructured", "of averages", "of mean ϑ", "runs' 5 %", "median", "95 %"]
    print("\nTable 4, spread over the runs, percent")
    print(text_table(sweep_rows(result), headers))

    count = result.runs.kept.size
    print(
        f"\n{count} runs: {100 * result.share_optimal():.1f} % cost at most 5 % more than from the "
        f"true parameters; {result.black_boxes.failed} identifications and {result.runs.failed} "
        "restructurings failed."
    )
    for status, number in result.runs.outcomes().items():
        print(f"  {number:4d}  {status}")
    rows = [
        [name, wall, cpu, first_wall, first_cpu]
        for (name, wall, cpu), (_, first_wall, first_cpu) in zip(
            second.of_study(), first.rows, strict=True
        )
    ]
    rows.append(["all", *(sum(row[k] for row in rows) for k in range(1, 5))])
    rows += [[name, wall, cpu, None, None] for name, wall, cpu in second.rows[len(rows) - 1 :]]
    print("\nSeconds")
    print(text_table(rows, ["stage", "wall", "CPU", "first call wall", "first call CPU"]))
    print(f"001 reports {PAPER_SECONDS:.0f} s for the seven restructurings alone, on 8 cores.")


if __name__ == "__main__":
    main()
