"""Seed → sealed records: plants, excitation, effects of a calibrated strength, noise."""

import dataclasses
import json
import multiprocessing
import zlib
from pathlib import Path

import numpy as np

from benchmarks.blind_suite._calibrate import (
    calibrated,
    in_words_of_library,
    runs_of,
    wanted_effects,
)
from benchmarks.blind_suite._draft import SAMPLES, draft_record
from benchmarks.blind_suite._laws import FAMILIES, REPORTED
from benchmarks.blind_suite._plants import PLANTS
from benchmarks.blind_suite._simulate import simulate

CALIBRATION = 1500
# Substeps of the records themselves; dry friction's reversals are what needs them.
FINE = 24

# Shares of the cases; each plant's records are dealt in this order.
CASES = {"one": 0.34, "two": 0.10, "none": 0.22, "decoy": 0.12, "outside": 0.22}


@dataclasses.dataclass
class Record:
    """One record as the solver sees it."""

    key: str
    structure: str
    dt: float
    u: np.ndarray
    y: np.ndarray
    kappa: np.ndarray | None
    input_names: list[str]
    input_units: list[str]
    output_names: list[str]
    output_units: list[str]


def _plant_records(name: str, cases: list[str], seed: int, samples: int):
    """All records of one plant, and their labels."""
    plant = PLANTS[name]
    code = zlib.crc32(plant.name.encode())
    seeds = np.random.SeedSequence([seed, code]).generate_state(len(cases), np.uint64)
    shift = int(np.random.default_rng([seed, code]).integers(1000))
    drafts, motions, names, counters = [], [], [], {}
    for i, case in enumerate(cases):
        count = counters[case] = counters.get(case, shift) + 1
        draft = draft_record(plant, f"{plant.name}-{i:04d}", case, int(seeds[i]), count, samples)
        rng = np.random.default_rng(draft.seed)
        drafts.append(draft)
        motions.append(plant.draw(rng, case == "decoy"))
        # Nothing in loop or noise may go with the effect: another counter, another stride.
        names.append(wanted_effects(plant, draft, count // 2 + 5 * shift, rng))

    short = min(CALIBRATION, samples)
    clean = simulate(plant, runs_of(plant, drafts, motions, [[]] * len(drafts), short))
    noise_std = [
        np.std(clean.y[r], axis=0) * 10 ** (-drafts[r].snr / 20) for r in range(len(drafts))
    ]
    rows, effects, realised = calibrated(plant, drafts, motions, names, clean, noise_std)
    final = [[effects[j] for j, row in enumerate(rows) if row == r] for r in range(len(drafts))]
    noise = np.stack(
        [
            np.random.default_rng(d.seed + 2).standard_normal((samples, len(plant.outputs)))
            * noise_std[r]
            for r, d in enumerate(drafts)
        ]
    )
    with np.errstate(all="ignore"):
        runs = runs_of(plant, drafts, motions, final, samples, noise)
        signals = simulate(plant, runs, FINE)
    records, labels = [], {}
    for r, draft in enumerate(drafts):
        kappa = signals.kappa[r][:, None] if draft.measured else None
        records.append(
            Record(
                draft.key,
                plant.structure,
                plant.dt,
                signals.u[r],
                signals.y[r],
                kappa,
                [name for name, _ in plant.inputs],
                [unit for _, unit in plant.inputs],
                [name for name, _ in plant.outputs],
                [unit for _, unit in plant.outputs],
            )
        )
        mine = [j for j, row in enumerate(rows) if row == r]
        labels[draft.key] = {
            "plant": plant.name,
            "case": draft.case,
            "loop": "closed" if draft.closed else "open",
            "snr": draft.snr,
            "moving": draft.moving,
            "noise_std": noise_std[r].tolist(),
            "physical": motions[r].physical,
            "finite": bool(np.max(np.abs(signals.y[r])) < 1e3 * np.max(np.abs(clean.y[r]))),
            "effects": [
                {
                    "name": REPORTED.get(effects[j].name, effects[j].name),
                    "detail": effects[j].name,
                    "family": FAMILIES.get(
                        REPORTED.get(effects[j].name, effects[j].name), "outside"
                    ),
                    "port": effects[j].label,
                    "amplitude": list(in_words_of_library(effects[j], signals.kappa[r])),
                    "shape": list(effects[j].shape),
                    "over_noise": realised[j][0],
                    "over_response": realised[j][1],
                }
                for j in mine
            ],
        }
    return records, labels


def deal(count: int) -> list[str]:
    """`count` cases in their shares, well mixed so that any first few are a fair sample."""
    dealt: list[str] = []
    owed = dict.fromkeys(CASES, 0.0)
    for _ in range(count):
        owed = {case: value + CASES[case] for case, value in owed.items()}
        richest = max(owed, key=lambda case: owed[case])
        owed[richest] -= 1.0
        dealt.append(richest)
    return dealt


def generate(
    seed: int,
    count: int,
    *,
    plants: tuple[str, ...] = tuple(PLANTS),
    samples: int = SAMPLES,
    processes: int = 1,
) -> tuple[list[Record], dict[str, dict]]:
    """`count` records in all, plants in turn, and their labels by key.

    Args:
        seed: 1 for development; 2 gives the figures that are reported.
        count: records in all; the first few of a larger suite are not those of a smaller one.
        plants: names of `PLANTS`.
        samples: of each record.
        processes: that simulate at the same time, a plant each.
    """
    shares = [count // len(plants) + (i < count % len(plants)) for i in range(len(plants))]
    jobs = [(name, deal(share), seed, samples) for name, share in zip(plants, shares, strict=True)]
    jobs = [job for job in jobs if job[1]]
    if processes > 1 and len(jobs) > 1:
        with multiprocessing.get_context("spawn").Pool(processes) as pool:
            made = pool.starmap(_plant_records, jobs, chunksize=1)
    else:
        made = [_plant_records(*job) for job in jobs]
    records = [some for some, _ in made]
    labels = {key: label for _, theirs in made for key, label in theirs.items()}
    mixed = [group[i] for i in range(max(map(len, records))) for group in records if i < len(group)]
    return [record for record in mixed if labels[record.key]["finite"]], labels


def save(folder: Path, records: list[Record], labels: dict[str, dict]) -> None:
    """Records in `records.npz`, the truth apart in `labels.json`."""
    folder.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, np.ndarray] = {}
    about = {}
    for record in records:
        arrays[f"{record.key}/u"], arrays[f"{record.key}/y"] = record.u, record.y
        if record.kappa is not None:
            arrays[f"{record.key}/kappa"] = record.kappa
        fields = ("structure", "dt", "input_names", "input_units", "output_names", "output_units")
        about[record.key] = {field: getattr(record, field) for field in fields}
    np.savez_compressed(folder / "records.npz", about=np.array(json.dumps(about)), **arrays)  # pyright: ignore[reportArgumentType]
    (folder / "labels.json").write_text(json.dumps(labels, indent=1))


def load(folder: Path) -> list[Record]:
    """The records of a folder, without their labels."""
    with np.load(folder / "records.npz") as archive:
        about = json.loads(str(archive["about"]))
        return [
            Record(
                key=key,
                u=archive[f"{key}/u"],
                y=archive[f"{key}/y"],
                kappa=archive[f"{key}/kappa"] if f"{key}/kappa" in archive else None,
                **fields,
            )
            for key, fields in about.items()
        ]
