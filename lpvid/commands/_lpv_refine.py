"""`lpvid lpv --refine`: the LPV model's coefficients fitted to all local records at once."""

import re
import warnings as python_warnings
from typing import Any, NamedTuple

import numpy as np

from lpvid._results import Status, is_successful
from lpvid.commands._messages import Warnings
from lpvid.data import IOData
from lpvid.models import FreeStructure, LPVStateSpace, PolynomialBasis
from lpvid.refinement import Refined, refine

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
        found = refine(lpv, data, fixed=_held(lpv, data), throw=False)
    advice = _in_words(found, lpv)
    failed = found.status == Status.nonfinite or found.status == Status.overflow
    # A comparison with NaN is false.
    better = bool(found.cost <= found.initial_cost) and bool(np.isfinite(found.cost))
    kept = better and not bool(failed)
    if not kept:
        reason = advice.split(". ")[0] if failed else "The cost did not fall"
        warnings.add(
            f"refinement failed, the model stays as interpolated: {reason}. Try another --degree, "
            "--order or --structure, or --stabilise."
        )
    elif not bool(is_successful(found.status)):
        warnings.add(f"refined, but: {advice}")
    content = {
        "status": Status[found.status],
        "advice": advice,
        "initial_cost": float(found.initial_cost),
        "cost": float(found.cost),
        "steps": int(found.stats["steps"]),
        "kept": kept,
    }
    return Refinement(found.model if kept else None, content)


def _held(lpv: LPVStateSpace, data: IOData) -> list[str]:
    """Coefficients that keep a black box in sections in the basis of its states.

    In A what is alike at all points (zeros, and the frequencies that scale the states); of each
    section the rows of B of one input, as its two states have two free numbers in their basis.
    """
    structure = lpv.structure
    if not isinstance(structure, FreeStructure):
        return []
    n, m = structure.n_states, structure.n_inputs
    coefficients = np.asarray(lpv.coefficients)
    upper = np.arange(0, n - 1, 2)
    free = np.zeros((n, n), bool)
    free[upper + 1, upper] = free[upper + 1, upper + 1] = True
    if n % 2:
        free[-1, -1] = True
    B = coefficients[:, n * n : n * (n + m)].reshape(-1, n, m)
    sizes = np.sum(B**2, axis=0) * np.mean(np.asarray(data.u) ** 2, axis=0)
    held = np.flatnonzero(~free).tolist()
    for first in range(0, n, 2):
        strongest = int(np.argmax(np.sum(sizes[first : first + 2], axis=0)))
        held += [n * n + row * m + strongest for row in range(first, min(first + 2, n))]
    return [f"coefficients[*,{column}]" for column in held]


def _in_words(found: Refined, lpv: LPVStateSpace) -> str:
    """The advice, a coefficient called by its parameter and its power of K."""
    names, basis = lpv.structure.parameter_names, lpv.basis

    def word(match: re.Match[str]) -> str:
        row, column = (int(number) for number in match.groups())
        powers = basis.exponents[row] if isinstance(basis, PolynomialBasis) else (row,)
        return f"{names[column]} of degree {','.join(map(str, powers))}"

    return _COEFFICIENT.sub(word, found.advice)
