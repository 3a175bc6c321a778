"""The demo's tables, beside the figures that the paper (001) published for its own arm."""

import dataclasses
from typing import Any

import numpy as np

from lpvid.study import MODEL_NAMES, StudyResult

SETTING = (
    "The study of Vizer, Mercère, Laroche and Ramdani (2015) on a simulated arm: at seven postures "
    "of the second joint the arm is excited about rest, noise is added to the measured joint "
    "velocities (30 dB), and black boxes of order 6 are identified from each record by PI-MOESP. "
    "The average black box of each posture is rewritten in the structure that physics gives "
    "(“restructured”) by minimising the H∞ norm of the difference, and its entries are "
    "interpolated by polynomials in κ = cos θ2. The model so found is compared with the exact "
    "linearisations interpolated in the same way (“analytic”) and with black boxes interpolated "
    "entry by entry in balanced coordinates (“balanced”).\n\n"
    "The published figures stand beside ours. Their arm has other physical constants and their "
    "records are not public, so they show what to expect, not what to match."
)

# 001, tables 1 to 4, for θ2 = π/8 … 7π/8.
_BFT = ((85.83, 67.42), (91.23, 98.18), (90.23, 85.07), (92.09, 97.83))
_BFT += ((89.65, 88.97), (88.42, 89.82), (91.01, 97.23))
_VAF = ((97.98, 89.39), (99.23, 99.96), (99.04, 97.77), (99.37, 99.9))
_VAF += ((98.93, 98.78), (98.66, 98.96), (99.2, 99.9))
_COST = (4.03e-3, 2.1e-3, 1.48e-3, 1.25e-3, 1.03e-3, 7.28e-4, 4.79e-4)
_FIT = {
    "restructured": {1: (84.7, 78.1), 2: (96.6, 88.8)},
    "analytic": {1: (88.2, 82.7), 2: (94.5, 91.5)},
    "balanced": {1: (92.0, 86.6), 2: (94.8, 90.1)},
}
_SWEEP = {
    "restructured": ((76.2, 94.4), (83.0, 97.1)),
    "analytic": ((78.6, 95.5), (88.4, 98.7)),
    "balanced": ((52.7, 77.7), (79.7, 95.9)),
}


@dataclasses.dataclass(frozen=True)
class Table:
    """A table with its section of the report."""

    heading: str
    text: str
    title: str
    headers: list[str]
    rows: list[list[Any]]
    figures: tuple[str, ...]


def tables(result: StudyResult) -> list[Table]:
    """The four tables of 001, with the figures that belong to each."""
    return [_local(result), _cost(result), _fit(result), _sweep(result)]


def angle(theta2: float) -> str:
    """θ2 as a multiple of π/8 where it is one."""
    eighths = 8.0 * theta2 / np.pi
    whole = round(eighths)
    return f"{'' if whole == 1 else whole}π/8" if abs(eighths - whole) < 1e-9 else f"{theta2:.3f}"


def _published(result: StudyResult, values: Any) -> list[Any]:
    """Published rows of the postures; nothing where the study was run elsewhere."""
    postures = [round(8.0 * theta2 / np.pi) for theta2 in result.theta2]
    on_grid = np.allclose(np.array(postures) * np.pi / 8.0, result.theta2)
    if not on_grid or min(postures) < 1 or max(postures) > len(values):
        return [None] * len(postures)
    return [values[posture - 1] for posture in postures]


def _local(result: StudyResult) -> Table:
    rows = []
    for theta2, bft, vaf, fits, variances in zip(
        result.theta2,
        np.asarray(result.local_bft),
        np.asarray(result.local_vaf),
        _published(result, _BFT),
        _published(result, _VAF),
        strict=True,
    ):
        first, second = fits or (None, None), variances or (None, None)
        ours = [float(value) for value in (*bft, *vaf)]
        rows.append([angle(theta2), *ours[:2], *first, *ours[2:], *second])
    return Table(
        "Local models",
        "The average black box of each posture, simulated from rest on a noise-free record with "
        "another excitation.",
        "Table 1. Local black boxes on validation records, percent",
        [
            "θ2",
            *("BFT y1", "BFT y2", "paper y1", "paper y2"),
            *("VAF y1", "VAF y2", "paper y1", "paper y2"),
        ],
        rows,
        ("records", "local_response", "bode"),
    )


def _cost(result: StudyResult) -> Table:
    rows = [
        [
            angle(theta2),
            float(cost),
            published,
            int(found.hits),
            int(found.match_costs.shape[-1]),
            float(found.margin),
        ]
        for theta2, cost, published, found in zip(
            result.theta2,
            np.asarray(result.relative_cost),
            _published(result, _COST),
            result.restructured,
            strict=True,
        )
    ]
    return Table(
        "Restructuring",
        "F = ‖G(ϑ) − G‖∞² over ‖G analytic‖∞, with how many of the starts ended in the best "
        "minimum, and how many times dearer the next distinct minimum is.",
        "Table 2. Relative cost of restructuring",
        ["θ2", "F / ‖G‖∞", "paper", "hits", "starts", "margin"],
        rows,
        ("minima", "poles"),
    )


def _fit(result: StudyResult) -> Table:
    rows = []
    for name in MODEL_NAMES:
        for degree, fit in sorted(result.interpolation_fit[name].items()):
            published = _FIT[name].get(degree, (None, None))
            rows.append([name, degree, float(fit), *published])
    return Table(
        "Interpolation",
        "FIT of the polynomials in κ to the local models' entries of A and B together; the "
        "paper gives A and B apart. An entrywise fit says little about a model: "
        "compare with table 4.",
        "Table 3. Fit of the interpolated entries, percent",
        ["model", "degree", "FIT", "paper A", "paper B"],
        rows,
        ("parameters", "modes"),
    )


def _sweep(result: StudyResult) -> Table:
    rows = []
    for name in MODEL_NAMES:
        bft, vaf = np.asarray(result.sweep_bft[name]), np.asarray(result.sweep_vaf[name])
        for k, (fit, variance) in enumerate(_SWEEP[name]):
            rows.append([name, f"y{k + 1}", float(bft[k]), fit, float(vaf[k]), variance])
    return Table(
        "Validation of the LPV model",
        "A noise-free record of the nonlinear arm in which θ2 crosses its whole range, against the "
        "three interpolated models, all simulated from rest.",
        "Table 4. The interpolated models along the sweep, percent",
        ["model", "output", "BFT", "paper", "VAF", "paper"],
        rows,
        ("sweep",),
    )
