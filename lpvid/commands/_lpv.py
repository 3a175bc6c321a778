"""`lpvid lpv`: local models at operating points, restructured, interpolated, tested."""

import argparse
import itertools
import math
import time
from typing import Any, NamedTuple

import jax
import numpy as np

from lpvid import __version__
from lpvid._results import Status, is_successful
from lpvid.analysis import hinf_norm
from lpvid.commands._cache import keep_compiled_code
from lpvid.commands._errors import UsageError
from lpvid.commands._identify import poles_of
from lpvid.commands._lpv_tables import print_all, written
from lpvid.commands._messages import Warnings, say
from lpvid.commands._output import check_targets, write_json
from lpvid.commands._records import (
    check_columns,
    offsets_of,
    read_records,
    subspace_method,
    without_offsets,
)
from lpvid.data import IOData, Offset, join
from lpvid.identify import Fit, identify, simulation_fit
from lpvid.interpolate import interpolate, leave_one_out
from lpvid.io import save
from lpvid.mechanics import two_link_arm_structure
from lpvid.models import (
    AbstractStructure,
    LPVStateSpace,
    MechanicalStructure,
    ModalStructure,
    Polynomial,
    StateSpace,
    align,
    balance,
    d2c,
    polynomial_basis,
)
from lpvid.restructure import Restructured, restructure_along

_ARM_ORDER = 6
# Between two ends; local models that are stable may be joined by ones that are not.
_FROZEN = 33
# Predicted responses further off than this do not come from one smooth family.
_LARGEST_MISS = 0.3


class _Point(NamedTuple):
    """One operating point and what was identified there."""

    kappa: tuple[float, ...]
    files: list[str]
    data: IOData
    offset: Offset | None
    fit: Fit
    continuous: StateSpace

    @property
    def name(self) -> str:
        return written(self.kappa)


class _Test(NamedTuple):
    """One test record: its scheduling as asked for, and what it holds."""

    asked: str
    file: str
    kappa: tuple[float, ...] | None
    data: IOData
    offset: Offset | None


def run(arguments: argparse.Namespace, warnings: Warnings) -> None:
    """Read, identify each point, restructure, interpolate, test, print, write."""
    started = time.perf_counter()
    groups = _groups(arguments)
    _check(arguments, groups)
    keep_compiled_code()
    records = _read(arguments, groups)
    tests = _read_tests(arguments, records, len(next(iter(groups))))
    points = []
    for kappa, files in groups.items():
        say(f"Identifying at K = {written(kappa)}")
        with warnings.about(f"K = {written(kappa)}"):
            points.append(_identify(arguments, kappa, files, records[kappa], warnings))
    structure = _structure(arguments, points[0].fit.model)
    say("Restructuring" if structure else "Aligning the black boxes")
    models = _local_models(arguments, structure, points)
    for point, model in zip(points, models, strict=True):
        if isinstance(model, Restructured) and not bool(is_successful(model.status)):
            warnings.add(f"K = {point.name}: restructured, but: {Status[model.status]}")
    kappas = np.array([point.kappa for point in points])
    say("Interpolating and testing")
    errors = leave_one_out(models, kappas)
    if max(errors) > 0 and not min(errors.values()) <= _LARGEST_MISS:
        warnings.add(
            f"The local models do not form a smooth family in K: predicted from the others, a "
            f"point's response is {100.0 * min(errors.values()):.3g} % off at best. Modes may "
            "cross, or the order may be wrong."
        )
    lpv = interpolate(models, kappas, Polynomial(degree=arguments.degree))
    unstable_at = _unstable_at(lpv, kappas)
    if unstable_at is not None:
        warnings.add(
            f"K = {written(unstable_at)}: the LPV model frozen there is unstable. Try another "
            "--degree or --order, or add operating points."
        )
    content: dict[str, Any] = {
        "command": "lpv",
        "version": __version__,
        "inputs": points[0].data.input_names,
        "outputs": points[0].data.output_names,
        "dt": points[0].data.dt,
        "method": arguments.method,
        "order": arguments.order,
        "structure": arguments.structure,
        "points": [
            _point_content(point, model, lpv) for point, model in zip(points, models, strict=True)
        ],
        "degree": max(sum(powers) for powers in lpv.basis.exponents),
        "leave_one_out": errors,
        "stable_over_range": unstable_at is None,
        "parameter_names": lpv.structure.parameter_names,
        "test": [_test_content(test, lpv, points) for test in tests],
    }
    print_all(arguments, content, [point.name for point in points])
    if arguments.out is not None:
        save(arguments.out, lpv)
        print(f"\nModel saved to {arguments.out}")
    if arguments.json is not None:
        content |= {"seconds": time.perf_counter() - started, "warnings": warnings.messages}
        write_json(arguments.json, content)
        print(f"Figures written to {arguments.json}")


def _groups(arguments: argparse.Namespace) -> dict[tuple[float, ...], list[str]]:
    """Files by operating point, in rising order: restructuring looks at neighbours."""
    groups: dict[tuple[float, ...], list[str]] = {}
    for text, file in arguments.at:
        kappa = _numbers(text)
        if kappa is None:
            raise UsageError(f"--at: {text.strip()!r} is no number (or several, as 0.1,2)")
        groups.setdefault(kappa, []).append(file)
    if len({len(kappa) for kappa in groups}) > 1:
        raise UsageError("--at: every K must have equally many numbers")
    if len(groups) < 2:
        raise UsageError("--at: at least two operating points are needed")
    return dict(sorted(groups.items()))


def _numbers(text: str) -> tuple[float, ...] | None:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        return None
    return values if all(math.isfinite(value) for value in values) else None


def _check(arguments: argparse.Namespace, groups: dict[tuple[float, ...], list[str]]) -> None:
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


def _read(
    arguments: argparse.Namespace, groups: dict[tuple[float, ...], list[str]]
) -> dict[tuple[float, ...], IOData]:
    # All files at once: the reader compares their sample times and channels.
    everything = read_records(arguments, [file for files in groups.values() for file in files])
    records = iter(everything.records)
    return {kappa: join([next(records) for _ in files]) for kappa, files in groups.items()}


def _read_tests(
    arguments: argparse.Namespace, records: dict[tuple[float, ...], IOData], n_scheduling: int
) -> list[_Test]:
    dt = next(iter(records.values())).dt
    tests = []
    for text, file in arguments.test:
        kappa = _numbers(text)
        columns = [] if kappa is not None else [part.strip() for part in text.split(",")]
        if len(columns if kappa is None else kappa) != n_scheduling:
            raise UsageError(
                f"--test: {text.strip()!r} is not {n_scheduling} number(s), as --at has, nor as "
                "many columns"
            )
        data = read_records(arguments, [file], columns)
        if not math.isclose(data.dt, dt, rel_tol=1e-6):
            raise UsageError(
                f"{file}: the sample time is {data.dt:g} s, but the records of --at have {dt:g} s"
            )
        offset, (data,) = without_offsets(arguments, data.replace(dt=dt))
        tests.append(_Test(text.strip(), file, kappa, data, offset))
    return tests


def _identify(
    arguments: argparse.Namespace,
    kappa: tuple[float, ...],
    files: list[str],
    data: IOData,
    warnings: Warnings,
) -> _Point:
    offset, (data,) = without_offsets(arguments, data)
    try:
        fit = identify(data, subspace_method(arguments))
    except ValueError as error:
        raise UsageError(f"at K = {written(kappa)}: {error}") from error
    # Of an ill-conditioned fit, `identify` says only that.
    if not bool(fit.model.is_stable()) and not bool(fit.status == Status.unstable):
        warnings.add("the model is not stable; ask for --stabilise, or another --order")
    try:
        continuous = d2c(fit.model)
    except ValueError as error:
        # No other rule for one point alone: the parameters would not be those of its neighbours.
        raise UsageError(
            f"at K = {written(kappa)}: the model has a pole on the negative real axis of z, so "
            f"none in continuous time gives it at dt = {data.dt:g} s; ask for another --order or "
            "--block-rows, or record with a smaller sample time"
        ) from error
    return _Point(kappa, files, data, offset, fit, continuous)


def _structure(arguments: argparse.Namespace, model: StateSpace) -> AbstractStructure | None:
    if arguments.structure == "modal":
        return ModalStructure(model.nx // 2, model.nu, model.ny, feedthrough=True)
    if arguments.structure == "mechanical":
        return MechanicalStructure(model.nx // 2, arguments.measured or "displacement")
    if arguments.structure == "two-link-arm":
        return two_link_arm_structure(lengths=arguments.lengths)
    return None


def _local_models(
    arguments: argparse.Namespace, structure: AbstractStructure | None, points: list[_Point]
) -> list[Restructured] | list[StateSpace]:
    if structure is not None:
        return restructure_along(
            [point.continuous for point in points],
            structure,
            starts=arguments.starts,
            key=jax.random.key(arguments.seed),
        )
    for point in points:
        if not bool(point.continuous.is_stable()):
            raise UsageError(
                f"at K = {point.name}: the model is unstable and cannot be aligned; ask for "
                "--stabilise, or another --order"
            )
    aligned = [balance(points[0].continuous)[0]]
    for point in points[1:]:
        # To the neighbour, not to the first: bases drift along K as the models do.
        aligned.append(align(point.continuous, aligned[-1]))
    return aligned


def _unstable_at(lpv: LPVStateSpace, kappas: np.ndarray) -> tuple[float, ...] | None:
    """The first κ within the range at which the frozen model is unstable."""
    if lpv.n_scheduling == 1:
        between = np.linspace(kappas.min(axis=0), kappas.max(axis=0), _FROZEN)
    else:
        # Not over the whole box: its corners may be far from every point.
        pairs = itertools.combinations(kappas, 2)
        between = np.array([(first + second) / 2.0 for first, second in pairs])
    grid = np.unique(np.concatenate([kappas, between]), axis=0)
    unstable = grid[~np.asarray(lpv.is_stable(grid))]
    return tuple(unstable[0].tolist()) if len(unstable) else None


def _point_content(
    point: _Point, model: Restructured | StateSpace, lpv: LPVStateSpace
) -> dict[str, Any]:
    frozen = lpv.at(np.array(point.kappa)).discretise(point.data.dt)
    content: dict[str, Any] = {
        "kappa": point.kappa,
        "files": point.files,
        "samples": point.data.lengths,
        "stable": bool(point.fit.model.is_stable()),
        "fit_status": Status[point.fit.status],
        "offsets": offsets_of(point.offset),
        "poles": poles_of(point.fit.model),
        "fit": simulation_fit(point.fit.model, point.data),
        "fit_lpv": simulation_fit(frozen, point.data),
    }
    if isinstance(model, Restructured):
        norm = float(hinf_norm(point.continuous).value)
        content |= {
            "status": Status[model.status],
            "cost": float(model.cost),
            "error_norm": float(model.error_norm),
            "relative_error": float(model.error_norm) / norm,
            "hits": int(model.hits),
            "margin": float(model.margin),
            "parameters": model.parameters,
        }
    return content


def _test_content(test: _Test, lpv: LPVStateSpace, points: list[_Point]) -> dict[str, Any]:
    # A frozen model is simulated as such: one matrix exponential instead of one a sample.
    model = lpv if test.kappa is None else lpv.at(np.array(test.kappa)).discretise(test.data.dt)
    return {
        "kappa": test.asked if test.kappa is None else test.kappa,
        "file": test.file,
        "offsets": offsets_of(test.offset),
        "lpv": simulation_fit(model, test.data),
        "local": {point.name: simulation_fit(point.fit.model, test.data) for point in points},
    }
