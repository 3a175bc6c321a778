"""Single-link flexible arm: ORSE on every experiment of Sun 2000 (002), modes and errors.

The arm is simulated with the sensors of 002 (12 bits over ±10 V, 5 mV of white noise), once without
and once with 0.4 A of Coulomb friction, which its closed loops compensate by 0.8 V as in 002. ORSE
sees the first half of a record; delta_i = RMS(error) / RMS(output) is that of its simulation over
the whole one: hub angle, base and middle strain, tachometer. Block rows and orders were chosen on
another key than the one scored; `--choose` does that again.

    python -m benchmarks.single_link [--choose] [--out FOLDER]
"""

import os

# One BLAS thread, before anything loads a BLAS.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import dataclasses
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

import lpvid as lv
from lpvid.analysis import relative_error
from lpvid.data import IOData
from lpvid.identify import ORSE, Fit, identify
from lpvid.mechanics import (
    ArmEffects,
    DryFriction,
    Quantisation,
    SingleLinkFlexibleArm,
    bounded_position_record,
    closed_loop_record,
    open_loop_record,
    reference_single_link_arm,
)
from lpvid.report import text_table

SCORED_KEY, CHOICE_KEYS = 0, (100,)
SENSORS = {"noise": 0.005, "quantisation": Quantisation()}
CLEAN = ArmEffects(**SENSORS)
STICKY = ArmEffects(friction=DryFriction(0.4), **SENSORS)
COMPENSATION = 0.8

# The first half may leave the pole at one a hair outside: simulated, it would grow.
RADIUS = 0.99999
BLOCK_ROWS_TRIED, ORDERS_TRIED = (30, 60, 100), (8, 14, 20, 26)
# Without friction the arm has eight states; with it, what `--choose` found, by experiment.
BLOCK_ROWS, ORDER = 60, 8


@dataclasses.dataclass(frozen=True)
class Experiment:
    """One kind of record, its payload in kg, and delta_1 … delta_4 of the like record of 002."""

    record: Callable[..., IOData]
    published: tuple[float, float, float, float]
    code: str
    order_with_friction: int
    options: dict
    payload: float = 0.0

    def arm(self) -> SingleLinkFlexibleArm:
        return reference_single_link_arm(payload_mass=self.payload)

    def data(self, key: int, effects: ArmEffects) -> IOData:
        options = dict(self.options)
        if self.record is closed_loop_record and effects.friction is not None:
            options["compensation"] = COMPENSATION
        return self.record(self.arm(), jax.random.key(key), effects=effects, **options)


def _open(excitation, code, published, order):
    return Experiment(open_loop_record, published, code, order, {"excitation": excitation})


def _bounded(random_size, code, published, order):
    return Experiment(bounded_position_record, published, code, order, {"random_size": random_size})


def _closed(reference, payload, code, published, order):
    options = {"reference": reference}
    return Experiment(closed_loop_record, published, code, order, options, payload)


# Tables 2-1, 2-3 and 2-4: 300 Hz, 2 V in open loop, 3 V else.
EXPERIMENTS = {
    "square": _open("square", "O_dat2", (0.0484, 0.1476, 0.3125, 0.1449), 26),
    "periodic random": _open("periodic random", "O_dat6", (0.3370, 0.2608, 0.5030, 0.3381), 26),
    "varying square": _open("varying square", "O_dat10", (0.1155, 0.2676, 0.5897, 0.2554), 26),
    "random": _open("random", "O_dat13", (0.9137, 0.6792, 0.5809, 0.5006), 20),
    "bounded, constant": _bounded(False, "B_dat9", (0.0443, 0.1488, 0.2833, 0.0998), 26),
    "bounded, random": _bounded(True, "B_dat2", (0.1603, 0.3304, 0.5614, 0.2277), 20),
    "closed, square": _closed("square", 0.0, "C_dat2", (0.1061, 0.4774, 0.6506, 0.2957), 14),
    "closed, varying": _closed(
        "varying square", 0.0, "C_dat3", (0.0735, 0.4242, 0.6675, 0.2136), 14
    ),
    "closed, 200 g": _closed("square", 0.2, "C_dat6", (0.0656, 0.5164, 0.6237, 0.2540), 26),
    "closed, 300 g": _closed("square", 0.3, "C_dat11", (0.0584, 0.4287, 0.5507, 0.2533), 26),
    "closed, 400 g": _closed("square", 0.4, "C_dat14", (0.0663, 0.5049, 0.6137, 0.2545), 26),
}


def fitted(data: IOData, order: int, block_rows: int) -> Fit:
    """ORSE on the first half of a record."""
    method = ORSE(order=order, block_rows=block_rows, feedthrough=False, stabilise=RADIUS)
    with warnings.catch_warnings():
        # An order above the rank of the data is one of those tried.
        warnings.simplefilter("ignore", UserWarning)
        return identify(data.split(0.5)[0], method)


def errors(fit: Fit, data: IOData) -> np.ndarray:
    """delta_1 … delta_4 over the whole record."""
    y = fit.model.simulate(u=data.u, x0=fit.x0[0])
    return np.asarray(relative_error(data.y, y))


def arm_modes(arm: SingleLinkFlexibleArm) -> np.ndarray:
    """Frequencies |s| of the linearised arm's flexible modes, Hz."""
    poles = np.asarray(arm.linearised().poles())
    return np.sort(np.abs(poles[np.imag(poles) > 1.0])) / (2 * np.pi)


def model_modes(fit: Fit) -> np.ndarray:
    """Frequencies |s| of the model's complex modes of damping below one half, Hz."""
    poles = np.log(np.asarray(fit.model.poles()).astype(complex)) / fit.model.dt
    flexible = poles[(poles.imag > 1e-6) & (-poles.real < 0.5 * np.abs(poles))]
    return np.sort(np.abs(flexible)) / (2 * np.pi)


def nearest(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    return np.array([found[np.argmin(np.abs(found - f))] if len(found) else np.nan for f in true])


def scored(name: str, effects: ArmEffects, key: int = SCORED_KEY) -> dict:
    """One row: modes and data-matching errors of one experiment."""
    experiment = EXPERIMENTS[name]
    start = time.perf_counter()
    data = jax.block_until_ready(experiment.data(key, effects))
    simulated = time.perf_counter() - start
    order = ORDER if effects.friction is None else experiment.order_with_friction
    fit = fitted(data, order, BLOCK_ROWS)
    true = arm_modes(experiment.arm())
    found = nearest(model_modes(fit), true)
    return {
        "true_hz": true,
        "found_hz": found,
        "worst_percent": float(100 * np.max(np.abs(found / true - 1))),
        "delta": errors(fit, data),
        "order": order,
        "status": str(fit.status),
        "simulated_s": simulated,
    }


def run(effects: ArmEffects, key: int = SCORED_KEY) -> list[list]:
    """Rows of the table, one an experiment."""
    rows = []
    for name, experiment in EXPERIMENTS.items():
        row = scored(name, effects, key)
        rows.append(
            [
                name,
                row["order"],
                *(
                    f"{f:.2f} ({t:.2f})"
                    for f, t in zip(row["found_hz"], row["true_hz"], strict=True)
                ),
                f"{row['worst_percent']:.2f}",
                *(f"{d:.4f}" for d in row["delta"]),
                f"{row['delta'].mean():.4f}",
                f"{np.mean(experiment.published):.4f}",
                experiment.code,
                *(f"{d:.4f}" for d in experiment.published),
                f"{row['simulated_s']:.1f}",
            ]
        )
    return rows


HEADERS = [
    "experiment", "order", "mode 1 (true) Hz", "mode 2 (true) Hz", "mode 3 (true) Hz", "worst %",
    "d1", "d2", "d3", "d4", "mean", "002 mean", "002", "d1", "d2", "d3", "d4", "simulation s",
]  # fmt: skip


def choose() -> None:
    """Block rows and orders by the mean error on keys that are not scored."""
    for title, effects in (("without friction", CLEAN), ("0.4 A of friction", STICKY)):
        rows, tried = [], [(n, BLOCK_ROWS) for n in ORDERS_TRIED]
        if effects.friction is None:
            tried = [(ORDER, q) for q in BLOCK_ROWS_TRIED]
        for name, experiment in EXPERIMENTS.items():
            records = [experiment.data(key, effects) for key in CHOICE_KEYS]
            deltas = [
                np.mean([errors(fitted(data, n, q), data).mean() for data in records])
                for n, q in tried
            ]
            rows.append([name, *(f"{d:.4f}" for d in deltas), str(tried[int(np.argmin(deltas))])])
        print(f"\n{title}: mean error on keys {CHOICE_KEYS}; (order, block rows)")
        print(text_table(rows, ["experiment", *(str(t) for t in tried), "chosen"]))


def draw(folder: Path) -> None:
    """One record with friction beside its model, as a picture."""
    data = EXPERIMENTS["bounded, constant"].data(SCORED_KEY, STICKY)
    fit = fitted(data, EXPERIMENTS["bounded, constant"].order_with_friction, BLOCK_ROWS)
    y = fit.model.simulate(u=data.u, x0=fit.x0[0])
    window = slice(6000, 8400)
    axes = lv.plot.compare(data[window], {"ORSE": np.asarray(y)[window]})
    folder.mkdir(parents=True, exist_ok=True)
    axes[0, 0].figure.savefig(folder / "single_link.png", dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--choose", action="store_true")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    if arguments.choose:
        choose()
        return
    for title, effects in (("No friction", CLEAN), ("Coulomb friction of 0.4 A", STICKY)):
        print(f"\n{title}: ORSE, {BLOCK_ROWS} block rows, key {SCORED_KEY}")
        print(text_table(run(effects), HEADERS))
    if arguments.out:
        draw(arguments.out)


if __name__ == "__main__":
    main()
