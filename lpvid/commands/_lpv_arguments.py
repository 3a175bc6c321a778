"""What `lpvid lpv` was asked: operating points, and options that fit them and one another."""

import argparse
import math

import numpy as np

from lpvid.commands._errors import UsageError
from lpvid.commands._output import check_targets
from lpvid.commands._records import check_columns
from lpvid.models import polynomial_basis

_ARM_ORDER = 6


def groups_of(arguments: argparse.Namespace) -> dict[tuple[float, ...], list[str]]:
    """Files by operating point, in rising order: restructuring looks at neighbours."""
    groups: dict[tuple[float, ...], list[str]] = {}
    for text, file in arguments.at:
        kappa = numbers(text)
        if kappa is None:
            raise UsageError(f"--at: {text.strip()!r} is no number (or several, as 0.1,2)")
        groups.setdefault(kappa, []).append(file)
    if len({len(kappa) for kappa in groups}) > 1:
        raise UsageError("--at: every K must have equally many numbers")
    if len(groups) < 2:
        raise UsageError("--at: at least two operating points are needed")
    return dict(sorted(groups.items()))


def numbers(text: str) -> tuple[float, ...] | None:
    """Finite numbers with commas between them; None for any other text."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        return None
    return values if all(math.isfinite(value) for value in values) else None


def check(arguments: argparse.Namespace, groups: dict[tuple[float, ...], list[str]]) -> None:
    """Raise where options contradict one another or the operating points."""
    check_columns(arguments)
    sources = [file for files in groups.values() for file in files]
    sources += [file for _, file in arguments.test]
    check_targets({"--out": arguments.out, "--json": arguments.json}, sources)
    _check_degree(arguments.degree, np.array(list(groups)))
    name, order = arguments.structure, arguments.order
    if (arguments.lengths is not None) != (name == "two-link-arm"):
        needed = "needs" if arguments.lengths is None else "is for"
        first, second = (
            ("the structure two-link-arm", "--lengths L1,L2")
            if arguments.lengths is None
            else ("--lengths", "the structure two-link-arm only")
        )
        raise UsageError(f"{first} {needed} {second}")
    if arguments.measured is not None and name != "mechanical":
        raise UsageError("--measured is for the structure mechanical only")
    if name in ("modal", "mechanical") and order % 2:
        raise UsageError(f"--order: the structure {name} has two states a mode, {order} is odd")
    if name == "two-link-arm" and order != _ARM_ORDER:
        raise UsageError(f"--order: the structure two-link-arm has {_ARM_ORDER} states")
    if name == "mechanical" and {len(arguments.input), len(arguments.output)} != {order // 2}:
        raise UsageError(
            f"--order: the structure mechanical has one input and one output a degree of freedom, "
            f"{order // 2} for order {order}"
        )


def _check_degree(degree: int | str, kappas: np.ndarray) -> None:
    if isinstance(degree, str):
        return
    count, width = kappas.shape
    # Monomials of that total degree at most.
    needed = math.comb(width + degree, degree)
    if count < needed:
        raise UsageError(
            f"--degree: {degree} in {width} scheduling variable(s) needs {needed} distinct points "
            f"--at, {count} given; lower it or add operating points"
        )
    if np.linalg.matrix_rank(np.asarray(polynomial_basis(kappas, degree)(kappas))) < needed:
        raise UsageError(
            f"--degree: {degree} needs {needed} points --at that do not all lie on a curve of this "
            "degree; lower it or add operating points"
        )
