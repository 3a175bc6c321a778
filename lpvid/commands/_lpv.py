"""`lpvid lpv`: local models at operating points, restructured, interpolated, refined, tested."""

import argparse
import itertools
import math
import time
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array

from lpvid import __version__
from lpvid._files import write_json
from lpvid._results import Status, is_successful
from lpvid.analysis import hinf_norm
from lpvid.commands._cache import keep_compiled_code
from lpvid.commands._errors import UsageError
from lpvid.commands._identify import poles_of
from lpvid.commands._lpv_arguments import check, groups_of, numbers
from lpvid.commands._lpv_refine import refine_all
from lpvid.commands._lpv_tables import print_all, written
from lpvid.commands._messages import Warnings, say
from lpvid.commands._records import (
    offsets_of,
    read_records,
    subspace_method,
    with_rest,
    without_offsets,
)
from lpvid.data import IOData, Offset, join
from lpvid.identify import Fit, identify, simulation_fit
from lpvid.interpolate import align_along, interpolate, leave_one_out, modal_along
from lpvid.io import save
from lpvid.mechanics import two_link_arm_structure
from lpvid.models import (
    AbstractStructure,
    LPVStateSpace,
    MechanicalStructure,
    ModalStructure,
    Polynomial,
    PolynomialBasis,
    StateSpace,
    d2c,
)
from lpvid.restructure import Restructured, restructure_along

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
    """Read, identify each point, restructure, interpolate, refine, test, print, write."""
    started = time.perf_counter()
    groups = groups_of(arguments)
    check(arguments, groups)
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
    kappas = np.array([point.kappa for point in points])
    models = _local_models(arguments, structure, points, kappas, warnings)
    for point, model in zip(points, models, strict=True):
        if isinstance(model, Restructured) and not bool(is_successful(model.status)):
            warnings.add(f"K = {point.name}: restructured, but: {Status[model.status]}")
    say("Interpolating and testing")
    errors = leave_one_out(models, kappas)
    if max(errors) > 0 and not min(errors.values()) <= _LARGEST_MISS:
        warnings.add(
            f"The local models do not form a smooth family in K: predicted from the others, a "
            f"point's response is {100.0 * min(errors.values()):.3g} % off at best. Modes may "
            "cross, or the order may be wrong."
        )
    interpolated = interpolate(models, kappas, Polynomial(degree=arguments.degree))
    refinement = None
    if arguments.refine:
        say("Refining on all records at once")
        refinement = refine_all(interpolated, _all_records(points), warnings)
    refined = None if refinement is None else refinement.model
    lpv = interpolated if refined is None else refined
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
            _point_content(point, model, interpolated, refined)
            for point, model in zip(points, models, strict=True)
        ],
        "degree": _degree(lpv),
        "leave_one_out": errors,
        "refined": None if refinement is None else refinement.content,
        "stable_over_range": unstable_at is None,
        "parameter_names": lpv.structure.parameter_names,
        "test": [_test_content(test, interpolated, refined, points) for test in tests],
    }
    print_all(arguments, content, [point.name for point in points])
    if arguments.out is not None:
        save(arguments.out, lpv)
        print(f"\nModel saved to {arguments.out}")
    if arguments.json is not None:
        content |= {"seconds": time.perf_counter() - started, "warnings": warnings.messages}
        write_json(arguments.json, content)
        print(f"Figures written to {arguments.json}")


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
        kappa = numbers(text)
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
    if offset is not None and fit.output_offset is not None:
        data = data.replace(y=data.y - fit.output_offset[None])
        offset = with_rest(offset, fit.output_offset)
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
    arguments: argparse.Namespace,
    structure: AbstractStructure | None,
    points: list[_Point],
    kappas: np.ndarray,
    warnings: Warnings,
) -> list[Restructured] | list[StateSpace]:
    black_boxes = [point.continuous for point in points]
    if structure is not None:
        return restructure_along(
            black_boxes,
            structure,
            starts=arguments.starts,
            key=jax.random.key(arguments.seed),
        )
    try:
        return modal_along(black_boxes, kappas)
    except ValueError:
        pass
    try:
        aligned = align_along(black_boxes, kappas)
    except ValueError as error:
        raise UsageError(
            "the local models have modes that cannot be told apart, and are too unstable to be "
            "aligned as they are; ask for --stabilise, or another --order"
        ) from error
    warnings.add(
        "A local model has modes that cannot be told apart (equal poles, or more states than it "
        "needs), so the states were aligned as a whole; a lower --order may do better."
    )
    return aligned


def _all_records(points: list[_Point]) -> IOData:
    """The local records one after the other, each with its scheduling."""
    return join(
        [
            point.data.replace(kappa=np.tile(point.kappa, (point.data.n_samples, 1)))
            for point in points
        ]
    )


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


def _degree(lpv: LPVStateSpace) -> int:
    assert isinstance(lpv.basis, PolynomialBasis)
    return max(sum(powers) for powers in lpv.basis.exponents)


def _point_content(
    point: _Point,
    model: Restructured | StateSpace,
    interpolated: LPVStateSpace,
    refined: LPVStateSpace | None,
) -> dict[str, Any]:
    content: dict[str, Any] = {
        "kappa": point.kappa,
        "files": point.files,
        "samples": point.data.lengths,
        "stable": bool(point.fit.model.is_stable()),
        "fit_status": Status[point.fit.status],
        "offsets": offsets_of(point.offset),
        "poles": poles_of(point.fit.model),
        "fit": simulation_fit(point.fit.model, point.data),
        "fit_lpv": _score(interpolated, point.kappa, point.data),
        "fit_refined": None if refined is None else _score(refined, point.kappa, point.data),
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


def _test_content(
    test: _Test,
    interpolated: LPVStateSpace,
    refined: LPVStateSpace | None,
    points: list[_Point],
) -> dict[str, Any]:
    return {
        "kappa": test.asked if test.kappa is None else test.kappa,
        "file": test.file,
        "offsets": offsets_of(test.offset),
        "lpv": _score(interpolated, test.kappa, test.data),
        "refined": None if refined is None else _score(refined, test.kappa, test.data),
        "local": {point.name: simulation_fit(point.fit.model, test.data) for point in points},
    }


def _score(lpv: LPVStateSpace, kappa: tuple[float, ...] | None, data: IOData) -> Array:
    # A frozen model is simulated as such: one matrix exponential instead of one a sample.
    model = lpv if kappa is None else lpv.at(np.array(kappa)).discretise(data.dt)
    return simulation_fit(model, data)
