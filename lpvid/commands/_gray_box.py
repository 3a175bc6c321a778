"""`lpvid gray-box`: mass, damping and stiffness matrices with intervals, and the modes."""

import argparse
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lpvid import __version__
from lpvid._files import plain, write_json
from lpvid._results import Status
from lpvid.analysis import propagate
from lpvid.commands._cache import keep_compiled_code
from lpvid.commands._errors import UsageError
from lpvid.commands._messages import Warnings
from lpvid.commands._output import NORMAL_95, check_targets
from lpvid.commands._records import (
    check_columns,
    offsets_of,
    read_records,
    with_rest,
    without_offsets,
)
from lpvid.data import IOData
from lpvid.identify import (
    ContinuousTimeMOESP,
    MechanicalFit,
    identify_mechanical,
    simulation_fit,
)
from lpvid.io import save
from lpvid.mechanics import MassSpringDamper
from lpvid.refinement import Refined, refine
from lpvid.report import text_table

NAMES = ("mass", "damping", "stiffness")


def run(arguments: argparse.Namespace, warnings: Warnings) -> None:
    """Read, fit, refine, print, write."""
    started = time.perf_counter()
    check_columns(arguments)
    if len(arguments.input) != len(arguments.output):
        raise UsageError(
            f"--input names {len(arguments.input)} columns and --output {len(arguments.output)}: "
            "every degree of freedom needs one force and one displacement, in the same order"
        )
    check_targets({"--out": arguments.out, "--json": arguments.json}, arguments.files)
    keep_compiled_code()
    data = read_records(arguments, arguments.files)
    print(f"{data!r}")
    train, test = data.split(arguments.split)
    arguments.keep_offsets = not arguments.remove_offsets
    offset, (train, test) = without_offsets(arguments, train, test)
    start = identify_mechanical(
        train, ContinuousTimeMOESP(tau=arguments.tau, block_rows=arguments.block_rows)
    )
    print(
        f"Subspace step: filters of {float(start.tau):.4g} s, {int(start.block_rows)} rows; "
        "refined by output error."
    )
    # Means are not offsets: what they leave is estimated with the model.
    refined = refine(start, train, output_offset=None if offset is None else "per record")
    if offset is not None and refined.output_offset is not None:
        offset = with_rest(offset, refined.output_offset)
    figures = _figures(refined)
    scores = {"start": _scores(start, train, test), "refined": _scores(refined, train, test)}
    _print(figures, scores, train)
    if arguments.out is not None:
        save(arguments.out, refined.model)
        print(f"Model saved to {arguments.out}")
    if arguments.json is not None:
        content = {
            "command": "gray-box",
            "version": __version__,
            "files": arguments.files,
            "inputs": data.input_names,
            "outputs": data.output_names,
            "dt": data.dt,
            "samples": {"train": train.lengths, "test": test.lengths},
            **figures,
            "start": {name: getattr(start, name) for name in NAMES},
            "filter_time_constant": start.tau,
            "block_rows": start.block_rows,
            "offsets": offsets_of(offset),
            "fit": scores,
            "noise_std": jnp.sqrt(jnp.diagonal(refined.noise_covariance)),
            "status": {"start": Status[start.status], "refined": refined.advice},
            "seconds": time.perf_counter() - started,
            "warnings": warnings.messages,
        }
        write_json(arguments.json, content)
        print(f"Figures written to {arguments.json}")


def _scores(found: MechanicalFit | Refined, train: IOData, test: IOData) -> dict[str, Any]:
    return {"train": simulation_fit(found, train), "test": simulation_fit(found, test)}


def _figures(refined: Refined) -> dict[str, Any]:
    """M, D, K and the modes, each with its standard deviation and 95 % interval."""

    def mechanical(parameters):
        # Offsets are parameters of the fit, not of the model.
        model = refined.model_at(parameters)
        return model.structure.mechanical_matrices(model.parameters)

    def matrices(parameters):
        return jnp.stack(mechanical(parameters))

    def modes(parameters):
        found = MassSpringDamper(*mechanical(parameters)).modes()
        return jnp.stack([found.frequencies / (2.0 * jnp.pi), found.damping_ratios])

    # White measurement noise is rare: intervals for noise of any colour.
    covariance = refined.robust_covariance
    own = refined.model.structure.n_parameters
    figures: dict[str, Any] = {"unidentified": refined.stats["unidentified"][:own]}
    for value, deviation, names in (
        (*_with_deviation(matrices, refined, covariance), NAMES),
        (*_with_deviation(modes, refined, covariance), ("frequency_hz", "damping_ratio")),
    ):
        for name, centre, spread in zip(names, value, deviation, strict=True):
            figures[name] = {
                "value": centre,
                "std": spread,
                "interval95": np.stack(
                    [centre - NORMAL_95 * spread, centre + NORMAL_95 * spread], -1
                ),
            }
    shapes = MassSpringDamper(*mechanical(refined.parameters)).modes().shapes
    figures["mode_shapes"] = shapes / jnp.max(jnp.abs(shapes), axis=0)[None]
    return figures


def _with_deviation(function, refined: Refined, covariance) -> tuple[np.ndarray, np.ndarray]:
    value, spread = propagate(function, refined.parameters, covariance)
    count = value.size
    variance = np.diagonal(np.asarray(spread).reshape(count, count))
    if np.any(np.asarray(refined.stats["unidentified"])):
        # What hangs on a parameter that the records do not show is not known either.
        slope = np.asarray(jax.jacfwd(function)(refined.parameters)).reshape(count, -1)
        hanging = np.any(slope[:, np.asarray(refined.stats["unidentified"])] != 0.0, axis=1)
        variance = np.where(hanging, np.inf, variance)
    deviation = np.sqrt(np.maximum(variance, 0.0)).reshape(value.shape)
    return np.asarray(value), deviation


def _print(figures: dict[str, Any], scores: dict[str, Any], data: IOData) -> None:
    print("\nM y'' + D y' + K y = u, 95 % intervals")
    count = data.ny
    rows = [
        (
            f"{letter}[{i + 1},{j + 1}]",
            figures[name]["value"][i, j],
            f"± {NORMAL_95 * figures[name]['std'][i, j]:.2g}",
        )
        for letter, name in zip("MDK", NAMES, strict=True)
        for i in range(count)
        for j in range(i, count)
    ]
    print(text_table(rows, ["entry", "value", "interval"]) + "\n")
    frequency, damping = figures["frequency_hz"], figures["damping_ratio"]
    modes = [
        (
            frequency["value"][k],
            f"± {NORMAL_95 * frequency['std'][k]:.2g}",
            damping["value"][k],
            f"± {NORMAL_95 * damping['std'][k]:.2g}",
            "  ".join(f"{entry:+.3f}" for entry in np.asarray(figures["mode_shapes"])[:, k]),
        )
        for k in range(count)
    ]
    print(text_table(modes, ["frequency (Hz)", "", "damping", "", "shape"]) + "\n")
    fits = [
        (name, *(plain(scores[stage][part])[k] for stage in scores for part in ("train", "test")))
        for k, name in enumerate(data.output_names)
    ]
    header = ["output", "subspace, fitted (%)", "rest (%)", "refined, fitted (%)", "rest (%)"]
    print(text_table(fits, header))
