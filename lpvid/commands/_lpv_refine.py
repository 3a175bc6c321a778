"""`lpvid lpv --refine`: the LPV model's coefficients fitted to all local records at once."""

import re
import warnings as python_warnings
from typing import Any, NamedTuple

import numpy as np

from lpvid._results import Status, is_successful
from lpvid.commands._messages import Warnings
from lpvid.data import IOData
from lpvid.models import FreeStructure, LPVStateSpace, PolynomialBasis
from lpvid.refinement import refine

_COEFFICIENT = re.compile(r"coefficients\[(\d+),(\d+)\]")


class Refinement(NamedTuple):
    """The refined model, None where refinement failed, and what is told of it."""

    model: LPVStateSpace | None
    content: dict[str, Any]


def refine_all(lpv: LPVStateSpace, data: IOData, warnings: Warnings) -> Refinement:
    """Refine on records that hold their scheduling; warns where it failed or is not sure."""
    with python_warnings.catch_warnings():
        # Said below, in the names that the user knows.
        python_warnings.filterwarnings("ignore", message="refine: ")
        found = refine(lpv, data, throw=False)
    status, advice = found.status, _in_words(found.advice, lpv)
    if isinstance(lpv.structure, FreeStructure):
        # The records never tell the basis of a black box's states. Held, its coefficients would
        # be too few: interpolated bases are not the best ones for polynomials of this degree.
        status = Status.successful if status == Status.unidentified else status
        advice = Status[status]
    failed = bool(status == Status.nonfinite or status == Status.overflow)
    # A comparison with NaN is false.
    better = bool(found.cost <= found.initial_cost) and bool(np.isfinite(found.cost))
    kept = better and not failed
    if not kept:
        reason = advice.split(". ")[0] if failed else "The cost did not fall"
        warnings.add(
            f"refinement failed, the model stays as interpolated: {reason}. Try another --degree, "
            "--order or --structure, or --stabilise."
        )
    elif not bool(is_successful(status)):
        warnings.add(f"refined, but: {advice}")
    content = {
        "status": Status[status],
        "advice": advice,
        "initial_cost": float(found.initial_cost),
        "cost": float(found.cost),
        "steps": int(found.stats["steps"]),
        "kept": kept,
    }
    return Refinement(found.model if kept else None, content)


def _in_words(advice: str, lpv: LPVStateSpace) -> str:
    """Advice in which a coefficient is called by its parameter and its power of K."""
    names, basis = lpv.structure.parameter_names, lpv.basis

    def word(match: re.Match[str]) -> str:
        row, column = (int(number) for number in match.groups())
        powers = basis.exponents[row] if isinstance(basis, PolynomialBasis) else (row,)
        return f"{names[column]} of degree {','.join(map(str, powers))}"

    return _COEFFICIENT.sub(word, advice)
