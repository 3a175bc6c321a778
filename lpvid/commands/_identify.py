"""`lpvid identify`: a black box from the first part of each record, scored on the rest."""

import argparse
import time
from typing import Any

import jax.numpy as jnp
import numpy as np

from lpvid import __version__
from lpvid._results import Status
from lpvid.commands._cache import keep_compiled_code
from lpvid.commands._messages import Warnings
from lpvid.commands._output import check_targets, plain, write_json
from lpvid.commands._records import (
    check_columns,
    make_method,
    offsets_of,
    read_records,
    without_offsets,
)
from lpvid.identify import Fit, identify, simulation_fit
from lpvid.io import save
from lpvid.models import StateSpace
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
    offset, (train, test) = without_offsets(arguments, train, test)
    fit = identify(train, make_method(arguments))
    scores = {
        "train": np.asarray(simulation_fit(fit.model, train)),
        "test": np.asarray(simulation_fit(fit.model, test)),
    }
    stable = bool(fit.model.is_stable())
    _print(arguments, fit, scores, train.output_names, stable, offset is not None)
    if arguments.out is not None:
        save(arguments.out, fit.model)
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
            "block_rows": fit.singular_values.shape[0] // data.ny,
            "stable": stable,
            "poles": poles_of(fit.model),
            "singular_values": fit.singular_values,
            "offsets": offsets_of(offset),
            "fit": scores,
            "status": Status[fit.status],
            "poles_moved": int(fit.stats["eigenvalues_moved"]),
            "seconds": time.perf_counter() - started,
            "warnings": warnings.messages,
        }
        write_json(arguments.json, content)
        print(f"Figures written to {arguments.json}")


def poles_of(model: StateSpace) -> list[dict[str, Any]]:
    """Poles by frequency: in z, natural frequency, damping ratio, and the equivalent in s."""
    modes = model.modes()
    discrete = np.asarray(jnp.exp(modes.poles * model.dt))
    return [
        {
            "re": float(z.real),
            "im": float(z.imag),
            "frequency_hz": float(frequency) / (2.0 * np.pi),
            "damping": float(damping),
            "continuous": {"re": float(s.real), "im": float(s.imag)},
        }
        for z, s, frequency, damping in zip(
            discrete,
            np.asarray(modes.poles),
            np.asarray(modes.frequency),
            np.asarray(modes.damping),
            strict=True,
        )
    ]


def _print(
    arguments: argparse.Namespace,
    fit: Fit,
    scores: dict[str, np.ndarray],
    outputs: tuple[str, ...],
    stable: bool,
    offsets_removed: bool,
) -> None:
    if offsets_removed:
        print(
            "Offsets: each channel's mean over the fitted part was taken out of both parts.\n"
            "The model is for signals with these means taken out (--json lists them)."
        )
    state = "stable" if stable else "UNSTABLE"
    print(f"Order {fit.order}, {arguments.method}, {state}.\n")
    rows = [
        (pole["frequency_hz"], pole["damping"], f"{pole['re']:.6f} + {pole['im']:.6f}j")
        for pole in poles_of(fit.model)
        if pole["im"] >= 0.0
    ]
    print(text_table(rows, ["frequency (Hz)", "damping", "pole (z)"]) + "\n")
    table = [
        (name, train, test)
        for name, train, test in zip(
            outputs, plain(scores["train"]), plain(scores["test"]), strict=True
        )
    ]
    print(text_table(table, ["output", "BFT fitted (%)", "BFT rest (%)"]))
