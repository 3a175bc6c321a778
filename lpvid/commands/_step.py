"""`lpvid step`: a continuous-time model from records that settle."""

import argparse
import time
from typing import Any

import jax.numpy as jnp
import numpy as np

from lpvid import __version__
from lpvid._files import plain, write_json
from lpvid._results import Status
from lpvid.analysis import bft
from lpvid.commands._cache import keep_compiled_code
from lpvid.commands._messages import Warnings
from lpvid.commands._output import check_targets
from lpvid.commands._records import check_columns, read_records
from lpvid.data import IOData
from lpvid.identify import (
    DeviationSubspace,
    DualRealisation,
    PrimalRealisation,
    identify_step_response,
)
from lpvid.io import save
from lpvid.models import StateSpace
from lpvid.refinement import refine
from lpvid.report import text_table

_METHODS = {
    "deviation": DeviationSubspace,
    "primal": PrimalRealisation,
    "dual": DualRealisation,
}


def run(arguments: argparse.Namespace, warnings: Warnings) -> None:
    """Read, fit, refine if asked, score, print, write."""
    started = time.perf_counter()
    check_columns(arguments)
    check_targets(
        {"--out": arguments.out, "--json": arguments.json}, [*arguments.files, *arguments.test]
    )
    keep_compiled_code()
    data = read_records(arguments, arguments.files)
    test = read_records(arguments, arguments.test) if arguments.test else None
    print(f"{data!r}")
    fit = identify_step_response(
        data,
        order=arguments.order,
        method=_METHODS[arguments.method](),
        settled=arguments.settled,
    )
    models = {"identified": fit.model}
    advice = None
    if arguments.refine:
        refined = refine(fit.model, data, initial_state="zero")
        models["refined"], advice = refined.model, refined.advice
    scores = {
        name: {
            "train": _scores(model, data),
            "test": None if test is None else _scores(model, test),
        }
        for name, model in models.items()
    }
    final = models["refined" if arguments.refine else "identified"]
    if not bool(final.is_stable()):
        warnings.add("the model is unstable; try another --order or --method deviation")
    _print(arguments, final, scores, data)
    if arguments.out is not None:
        save(arguments.out, final)
        print(f"Model saved to {arguments.out}")
    if arguments.json is not None:
        poles = np.asarray(final.poles())
        content = {
            "command": "step",
            "version": __version__,
            "files": arguments.files,
            "test": arguments.test,
            "inputs": data.input_names,
            "outputs": data.output_names,
            "dt": data.dt,
            "method": arguments.method,
            "order": fit.order,
            "stable": bool(final.is_stable()),
            "poles": [{"re": float(s.real), "im": float(s.imag)} for s in poles],
            "dc_gain": final.dc_gain(),
            "feedthrough": final.D,
            "singular_values": fit.singular_values,
            "settled_windows": fit.windows,
            "final_outputs": fit.final_outputs,
            "noise_std": fit.stats["noise"],
            "fit": scores,
            "status": {"identified": Status[fit.status], "refined": advice},
            "seconds": time.perf_counter() - started,
            "warnings": warnings.messages,
        }
        write_json(arguments.json, content)
        print(f"Figures written to {arguments.json}")


def _scores(model: StateSpace, data: IOData) -> list[Any]:
    """BFT of every record and output, simulated from rest; none for an output that stays still."""
    rows = []
    for record in data.records:
        moves = np.ptp(np.asarray(record.y), axis=0) > 0.0
        simulated = model.simulate(u=record.u, dt=record.dt)
        finite = jnp.where(jnp.isfinite(simulated), simulated, 1e300)
        found = np.asarray(bft(record.y, finite))
        rows.append(
            [float(value) if moved else None for value, moved in zip(found, moves, strict=True)]
        )
    return rows


def _print(
    arguments: argparse.Namespace, model: StateSpace, scores: dict[str, Any], data: IOData
) -> None:
    state = "stable" if bool(model.is_stable()) else "UNSTABLE"
    print(f"Order {model.nx}, {arguments.method}, {state}.\n")
    poles = sorted(np.asarray(model.poles()), key=lambda s: (abs(s), s.imag))
    rows = [
        (f"{s.real:.5g} {s.imag:+.5g}j", abs(s) / (2.0 * np.pi), -s.real / abs(s))
        for s in poles
        if s.imag >= 0.0
    ]
    print(text_table(rows, ["pole (1/s)", "frequency (Hz)", "damping"]) + "\n")
    table = [
        (part_name, file, output, *_column(scores, part, r, k))
        for part, part_name, files in (
            ("train", "fitted", arguments.files),
            ("test", "test", arguments.test),
        )
        for r, file in enumerate(files)
        for k, output in enumerate(data.output_names)
    ]
    print(text_table(table, ["", "record", "output", *(f"BFT {name} (%)" for name in scores)]))


def _column(scores: dict[str, Any], part: str, record: int, output: int) -> list[Any]:
    return [plain(stage[part])[record][output] for stage in scores.values()]
