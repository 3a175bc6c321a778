"""`lpvid identify`: a black box from the first part of each record, scored on the rest."""

import argparse
import time
from typing import Any

import jax.numpy as jnp
import numpy as np

from lpvid import __version__
from lpvid._files import plain, write_json
from lpvid._results import Status
from lpvid.analysis import pole_covariance
from lpvid.commands._cache import keep_compiled_code
from lpvid.commands._errors import UsageError
from lpvid.commands._messages import Warnings
from lpvid.commands._output import NORMAL_95, check_targets
from lpvid.commands._parser import CONTINUOUS_METHODS
from lpvid.commands._records import (
    any_method,
    check_columns,
    offsets_of,
    read_records,
    with_rest,
    without_offsets,
)
from lpvid.data import IOData
from lpvid.identify import identify, simulation_fit
from lpvid.io import save
from lpvid.models import StateSpace
from lpvid.refinement import Innovation, OutputError, Refined, refine
from lpvid.report import text_table


def run(arguments: argparse.Namespace, warnings: Warnings) -> None:
    """Read, fit, score, print, write."""
    started = time.perf_counter()
    check_columns(arguments)
    check_targets({"--out": arguments.out, "--json": arguments.json}, arguments.files)
    keep_compiled_code()
    data = read_records(arguments, arguments.files)
    print(f"{data!r}")
    train, test = data.split(arguments.split)
    method = any_method(arguments)
    if arguments.predictor is not None and not arguments.refine:
        raise UsageError("--predictor says what --refine fits: give both")
    offset, (train, test) = without_offsets(arguments, train, test)
    fit = identify(train, method)
    fits: dict[str, Any] = {"identified": fit}
    refined = None
    if arguments.refine:
        predictor = Innovation() if arguments.predictor == "innovation" else OutputError()
        # Means are not offsets: what they leave differs from record to record, and a
        # continuous-time method leaves it alone.
        rests = None if offset is None else "per record"
        refined = refine(fit, train, predictor=predictor, output_offset=rests)
        fits["refined"] = refined
    scores = {name: _scores(found, train, test) for name, found in fits.items()}
    final = fits["refined" if arguments.refine else "identified"]
    model = final.model
    rest = getattr(final, "output_offset", None)
    if offset is not None and rest is not None:
        offset = with_rest(offset, rest)
    stable = bool(model.is_stable())
    _print(arguments, poles_of(model, refined), scores, train, stable, offset is not None)
    if arguments.out is not None:
        save(arguments.out, model)
        print(f"Model saved to {arguments.out}")
    if arguments.json is not None:
        content = {
            "command": "identify",
            "version": __version__,
            "files": arguments.files,
            "inputs": data.input_names,
            "outputs": data.output_names,
            "dt": data.dt,
            "samples": {"train": train.lengths, "test": test.lengths},
            "method": arguments.method,
            "order": fit.order,
            "block_rows": int(fit.stats.get("block_rows", fit.singular_values.shape[0] // data.ny)),
            "stable": stable,
            "poles": poles_of(model, refined),
            "singular_values": fit.singular_values,
            "offsets": offsets_of(offset),
            "fit": scores["refined" if arguments.refine else "identified"],
            "fit_before_refinement": scores["identified"] if arguments.refine else None,
            "status": Status[fit.status],
            "refinement": None if refined is None else _refinement(refined),
            "poles_moved": int(fit.stats.get("eigenvalues_moved", 0)),
            "seconds": time.perf_counter() - started,
            "warnings": warnings.messages,
        }
        write_json(arguments.json, content)
        print(f"Figures written to {arguments.json}")


def _scores(fit: Any, train: IOData, test: IOData) -> dict[str, np.ndarray]:
    return {
        "train": np.asarray(simulation_fit(fit, train)),
        "test": np.asarray(simulation_fit(fit, test)),
    }


def _refinement(refined: Refined) -> dict[str, Any]:
    return {
        "status": refined.advice,
        "cost": refined.cost,
        "initial_cost": refined.initial_cost,
        "noise_std": jnp.sqrt(jnp.diagonal(refined.noise_covariance)),
        "innovation_gain": refined.innovation_gain,
    }


def poles_of(model: StateSpace, refined: Refined | None = None) -> list[dict[str, Any]]:
    """Poles by frequency, in z or s: natural frequency, damping ratio, equivalent in s.

    Of a refined model with the standard deviations of frequency and damping ratio.
    """
    modes = model.modes()
    poles = np.asarray(modes.poles)
    own = np.exp(poles * model.dt) if model.is_discrete else poles
    found = [
        {
            "re": float(z.real),
            "im": float(z.imag),
            "frequency_hz": float(frequency) / (2.0 * np.pi),
            "damping": float(damping),
            "continuous": {"re": float(s.real), "im": float(s.imag)},
        }
        for z, s, frequency, damping in zip(
            own, poles, np.asarray(modes.frequency), np.asarray(modes.damping), strict=True
        )
    ]
    if refined is None:
        return found
    # Poles do not depend on offsets, which an integrator may hide.
    unknown = zip(refined.parameter_names, refined.stats["unidentified"], strict=True)
    if any(lost for name, lost in unknown if not name.startswith("offset[")):
        return found
    spread = pole_covariance(refined.model_at, refined.parameters, refined.robust_covariance)
    for pole in found:
        nearest = np.argmin(np.abs(np.asarray(spread.poles) - complex(pole["re"], pole["im"])))
        pole["frequency_std_hz"] = float(spread.frequency_std[nearest]) / (2.0 * np.pi)
        pole["damping_std"] = float(spread.damping_std[nearest])
    return found


def _print(
    arguments: argparse.Namespace,
    poles: list[dict[str, Any]],
    scores: dict[str, dict[str, np.ndarray]],
    data: IOData,
    stable: bool,
    offsets_removed: bool,
) -> None:
    if offsets_removed:
        print(
            "Offsets: taken out of both parts as the fitted part shows them (--json lists them).\n"
            "The model is for signals without them."
        )
    state = "stable" if stable else "UNSTABLE"
    print(f"Order {len(poles)}, {arguments.method}, {state}.\n")
    domain = "s" if arguments.method in CONTINUOUS_METHODS else "z"
    rows = [
        (
            pole["frequency_hz"],
            *_interval(pole, "frequency_std_hz"),
            pole["damping"],
            *_interval(pole, "damping_std"),
            f"{pole['re']:.6f} + {pole['im']:.6f}j",
        )
        for pole in poles
        if pole["im"] >= 0.0
    ]
    sure = ["95 %"] if "damping_std" in poles[0] else []
    header = ["frequency (Hz)", *sure, "damping", *sure, f"pole ({domain})"]
    print(text_table(rows, header) + "\n")
    table = [
        (name, *(plain(fit[part])[k] for fit in scores.values() for part in ("train", "test")))
        for k, name in enumerate(data.output_names)
    ]
    parts = ["fitted (%)", "rest (%)"]
    header = ["output", *(f"BFT {part}" for part in parts)]
    if arguments.refine:
        header += [f"refined, {part}" for part in parts]
    print(text_table(table, header))


def _interval(pole: dict[str, Any], name: str) -> tuple[str, ...]:
    return (f"± {NORMAL_95 * pole[name]:.2g}",) if name in pole else ()
