"""The arguments of every command."""

import argparse
import re
from collections.abc import Sequence
from typing import NoReturn

from lpvid.commands import _values as values
from lpvid.commands._errors import UsageError
from lpvid.loop import HOLDS
from lpvid.loop.structures import STRUCTURES as PORTED_STRUCTURES

METHODS = ("po-moesp", "pi-moesp", "n4sid", "cva", "orse")
CONTINUOUS_METHODS = ("continuous-moesp", "continuous-n4sid", "continuous-cva")
STEP_METHODS = ("deviation", "primal", "dual")
STRUCTURES = ("modal", "mechanical", "two-link-arm", "black-box")
PREDICTORS = ("output-error", "innovation")
MEASURED = ("displacement", "velocity", "acceleration")
_RADIUS = 0.9999
_NEGATIVE_NUMBERS = re.compile(r"-[\d.][\d.,eE+-]*")


class _Parser(argparse.ArgumentParser):
    """argparse, but a fault is one line and no exit."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message} (see {self.prog} --help)")


def protect_numbers(argv: Sequence[str]) -> list[str]:
    """Arguments in which `-0.5,1` and `-1e-3` are numbers; argparse takes them for options."""
    return [f" {word}" if _NEGATIVE_NUMBERS.fullmatch(word) else word for word in argv]


def make_parser() -> argparse.ArgumentParser:
    """The parser of `lpvid`."""
    from lpvid import __version__

    parser = _Parser(
        prog="lpvid",
        description="System identification and linear parameter-varying (LPV) modelling.",
        epilog="LPVID_NO_CACHE=1 keeps no compiled code between runs; LPVID_DEBUG=1 shows "
        "tracebacks.",
    )
    parser.add_argument("--version", action="version", version=f"lpvid {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    _add_demo(commands)
    _add_identify(commands)
    _add_gray_box(commands)
    _add_step(commands)
    _add_lpv(commands)
    _add_close_loop(commands)
    commands.add_parser(
        "info",
        help="versions, devices, precision",
        description="Versions, devices and precision, for a report of a fault.",
    )
    return parser


def _add_demo(commands) -> None:
    demo = commands.add_parser(
        "demo",
        help="the two-link arm's study, with a report",
        description="Identify a simulated two-link flexible arm at seven postures from noisy "
        "records, restructure, interpolate to one LPV model, validate; write summary.json, "
        "pictures and report.html.",
    )
    demo.add_argument("--out", default="lpvid-demo", metavar="DIR", help="folder (%(default)s)")
    demo.add_argument(
        "--runs",
        type=values.count,
        default=10,
        metavar="N",
        help="noise realisations (%(default)s)",
    )
    _add_seed(demo)


def _add_identify(commands) -> None:
    identify = commands.add_parser(
        "identify",
        help="a black box from records, scored on their rest",
        description="Identify a discrete-time state-space model from the first part of each "
        "record and score its simulation on the rest. Several files are several records.",
    )
    identify.add_argument("files", nargs="+", metavar="FILE", help=".csv, .txt, .dat, .mat, .npz")
    _add_columns(identify)
    _add_keep_offsets(identify)
    identify.add_argument(
        "--order", type=values.order, default="auto", metavar="N|auto", help="states (%(default)s)"
    )
    _add_method(identify, (*METHODS, *CONTINUOUS_METHODS))
    identify.add_argument(
        "--tau", type=values.seconds, metavar="S", help="filters of a continuous method (searched)"
    )
    identify.add_argument(
        "--refine", action="store_true", help="refine the model by maximum likelihood"
    )
    identify.add_argument(
        "--predictor",
        choices=PREDICTORS,
        help="what is refined: the simulation (output-error) or the one-step prediction",
    )
    identify.add_argument(
        "--split",
        type=values.fraction,
        default=0.5,
        metavar="F",
        help="share of each record to fit on (%(default)s)",
    )
    _add_files_out(identify)


def _add_gray_box(commands) -> None:
    gray_box = commands.add_parser(
        "gray-box",
        help="mass, damping and stiffness from forces and displacements",
        description="Identify M, D and K of M y\" + D y' + K y = u in continuous time, refine them "
        "by output error, and print them and the modes with 95 %% intervals. As many inputs "
        "(forces) as outputs (displacements), in the same order.",
    )
    gray_box.add_argument("files", nargs="+", metavar="FILE", help=".csv, .txt, .dat, .mat, .npz")
    _add_columns(gray_box)
    gray_box.add_argument(
        "--remove-offsets",
        action="store_true",
        help="take each channel's mean over the fitted part out (for sensors without a zero)",
    )
    gray_box.add_argument(
        "--tau", type=values.seconds, metavar="S", help="filters' time constant (searched)"
    )
    gray_box.add_argument(
        "--block-rows", type=values.block_rows, metavar="S", help="filtered rows (searched)"
    )
    gray_box.add_argument(
        "--split",
        type=values.fraction,
        default=0.75,
        metavar="F",
        help="share of each record to fit on (%(default)s)",
    )
    _add_files_out(gray_box)


def _add_step(commands) -> None:
    step = commands.add_parser(
        "step",
        help="a continuous-time model from step records",
        description="Identify a continuous-time model from records that start at rest and settle: "
        "one file for each experiment, as many as inputs or more, steps of any size.",
    )
    step.add_argument("files", nargs="+", metavar="FILE", help=".csv, .txt, .dat, .mat, .npz")
    _add_columns(step)
    step.add_argument("--order", type=values.count, required=True, metavar="N", help="states")
    step.add_argument(
        "--method",
        choices=STEP_METHODS,
        default=STEP_METHODS[0],
        help="deviation bears noise, primal and dual are the published moments (%(default)s)",
    )
    step.add_argument(
        "--settled", type=values.seconds, metavar="S", help="when all has settled (looked for)"
    )
    step.add_argument("--refine", action="store_true", help="refine the model by output error")
    step.add_argument(
        "--test", action="append", default=[], metavar="FILE", help="a record to test on, from rest"
    )
    _add_files_out(step)


def _add_lpv(commands) -> None:
    lpv = commands.add_parser(
        "lpv",
        help="one LPV model from records at several operating points",
        description="Identify a local model at each operating point, restructure, interpolate in "
        "the scheduling variable, refine if asked, test. K is a number, or several with commas "
        "between them.",
    )
    lpv.add_argument(
        "--at",
        nargs=2,
        action="append",
        required=True,
        metavar=("K", "FILE"),
        help="a record and its operating point; the same K again is one more record of it",
    )
    lpv.add_argument(
        "--test",
        nargs=2,
        action="append",
        default=[],
        metavar=("K", "FILE"),
        help="a record to test on; K may be the column of a measured schedule",
    )
    _add_columns(lpv)
    _add_keep_offsets(lpv)
    lpv.add_argument("--order", type=values.count, required=True, metavar="N", help="states")
    _add_method(lpv)
    lpv.add_argument(
        "--degree",
        type=values.degree,
        default="auto",
        metavar="D|auto",
        help="of the polynomial in K; auto leaves one point out in turn (%(default)s)",
    )
    lpv.add_argument(
        "--structure", choices=STRUCTURES, default="modal", help="of the local models (%(default)s)"
    )
    lpv.add_argument(
        "--lengths", type=values.lengths, metavar="L1,L2", help="links in metres, for two-link-arm"
    )
    lpv.add_argument("--measured", choices=MEASURED, help="for mechanical (displacement)")
    lpv.add_argument(
        "--starts", type=values.count, default=24, metavar="N", help="of the search (%(default)s)"
    )
    lpv.add_argument(
        "--refine",
        action="store_true",
        help="refine the LPV model on all records --at at once, by output error",
    )
    _add_seed(lpv)
    _add_files_out(lpv)


def _add_close_loop(commands) -> None:
    close_loop = commands.add_parser(
        "close-loop",
        help="what a model lacks: found, named, added; error before and after",
        description="Fit a model to records, find what it lacks, name the effect (friction, "
        "backlash, delay, …), add it, fit again, and say how far the error on held-out data falls; "
        "or say that nothing is to be added, or that the records do not decide. Several files are "
        "several experiments.",
    )
    close_loop.add_argument("files", nargs="+", metavar="FILE", help=".csv, .txt, .dat, .mat, .npz")
    _add_columns(close_loop)
    close_loop.add_argument(
        "--schedule",
        type=values.columns,
        action="extend",
        default=[],
        metavar="COL,…",
        help="columns of measured signals that the model's parameters may depend on",
    )
    close_loop.add_argument(
        "--structure",
        choices=PORTED_STRUCTURES,
        metavar="NAME",
        help=f"of the model: {', '.join(PORTED_STRUCTURES)} (black-box)",
    )
    close_loop.add_argument(
        "--order", type=values.count, metavar="N", help="states of a black box or an arm (chosen)"
    )
    close_loop.add_argument(
        "--model", metavar="MODEL.json", help="a saved model to start from, no structure"
    )
    close_loop.add_argument(
        "--split",
        type=values.fraction,
        metavar="F",
        help="share of each record to fit on; the rest is held out (0.67)",
    )
    close_loop.add_argument(
        "--test",
        action="append",
        default=[],
        metavar="FILE",
        help="a held-out record; all FILEs are then fitted to",
    )
    close_loop.add_argument(
        "--hold",
        choices=HOLDS,
        default="zero",
        help="what the inputs do between samples: held (zero), or straight lines, for measured and "
        "band-limited ones (zero)",
    )
    close_loop.add_argument("--json", metavar="FILE", help="where to write the figures as JSON")
    close_loop.add_argument("--html", metavar="FILE", help="where to write the report as HTML")


def _add_columns(parser) -> None:
    parser.add_argument(
        "--input",
        type=values.columns,
        action="extend",
        required=True,
        metavar="COL,…",
        help="input columns: names, or numbers from 1 in a table without header",
    )
    parser.add_argument(
        "--output", type=values.columns, action="extend", required=True, metavar="COL,…"
    )
    clock = parser.add_mutually_exclusive_group(required=True)
    clock.add_argument("--dt", type=values.seconds, metavar="S", help="sample time in seconds")
    clock.add_argument("--time", metavar="COL", help="time column in seconds")
    parser.add_argument(
        "--resample", action="store_true", help="bring non-uniform time to a uniform grid"
    )


def _add_keep_offsets(parser) -> None:
    parser.add_argument(
        "--keep-offsets",
        action="store_true",
        help="do not take each channel's mean out (for records about zero, or short ones)",
    )


def _add_method(parser, choices: Sequence[str] = METHODS) -> None:
    parser.add_argument(
        "--method", choices=choices, default=choices[0], help="of identification (%(default)s)"
    )
    parser.add_argument(
        "--block-rows",
        type=values.block_rows,
        metavar="S",
        help="rows of past and future (by order)",
    )
    parser.add_argument(
        "--stabilise",
        type=values.radius,
        nargs="?",
        const=_RADIUS,
        metavar="RADIUS",
        help=f"move unstable poles onto this radius ({_RADIUS})",
    )


def _add_files_out(parser) -> None:
    parser.add_argument("--out", metavar="MODEL.json", help="where to save the model")
    parser.add_argument("--json", metavar="FILE", help="where to write the figures as JSON")


def _add_seed(parser) -> None:
    parser.add_argument(
        "--seed",
        type=values.seed,
        default=0,
        metavar="S",
        help="of the random numbers (%(default)s)",
    )
