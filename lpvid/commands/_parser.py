"""The arguments of every command."""

import argparse
import math
import re
from collections.abc import Sequence
from typing import NoReturn

from lpvid.commands._errors import UsageError

METHODS = ("po-moesp", "pi-moesp")
STRUCTURES = ("modal", "mechanical", "two-link-arm", "black-box")
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
    _add_lpv(commands)
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
        "--runs", type=_count, default=10, metavar="N", help="noise realisations (%(default)s)"
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
    identify.add_argument(
        "--order", type=_order, default="auto", metavar="N|auto", help="states (%(default)s)"
    )
    _add_method(identify)
    identify.add_argument(
        "--split",
        type=_fraction,
        default=0.5,
        metavar="F",
        help="share of each record to fit on (%(default)s)",
    )
    _add_files_out(identify)


def _add_lpv(commands) -> None:
    lpv = commands.add_parser(
        "lpv",
        help="one LPV model from records at several operating points",
        description="Identify a local model at each operating point, restructure, interpolate in "
        "the scheduling variable, test. K is a number, or several with commas between them.",
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
    lpv.add_argument("--order", type=_count, required=True, metavar="N", help="states")
    _add_method(lpv)
    lpv.add_argument(
        "--degree",
        type=_degree,
        default="auto",
        metavar="D|auto",
        help="of the polynomial in K; auto leaves one point out in turn (%(default)s)",
    )
    lpv.add_argument(
        "--structure", choices=STRUCTURES, default="modal", help="of the local models (%(default)s)"
    )
    lpv.add_argument(
        "--lengths", type=_lengths, metavar="L1,L2", help="links in metres, for two-link-arm"
    )
    lpv.add_argument("--measured", choices=MEASURED, help="for mechanical (displacement)")
    lpv.add_argument(
        "--starts", type=_count, default=24, metavar="N", help="of the search (%(default)s)"
    )
    _add_seed(lpv)
    _add_files_out(lpv)


def _add_columns(parser) -> None:
    parser.add_argument(
        "--input",
        type=_columns,
        action="extend",
        required=True,
        metavar="COL,…",
        help="input columns: names, or numbers from 1 in a table without header",
    )
    parser.add_argument("--output", type=_columns, action="extend", required=True, metavar="COL,…")
    clock = parser.add_mutually_exclusive_group(required=True)
    clock.add_argument("--dt", type=_seconds, metavar="S", help="sample time in seconds")
    clock.add_argument("--time", metavar="COL", help="time column in seconds")
    parser.add_argument(
        "--resample", action="store_true", help="bring non-uniform time to a uniform grid"
    )
    parser.add_argument(
        "--keep-offsets",
        action="store_true",
        help="do not take each channel's mean out (for records about zero, or short ones)",
    )


def _add_method(parser) -> None:
    parser.add_argument(
        "--method", choices=METHODS, default=METHODS[0], help="of identification (%(default)s)"
    )
    parser.add_argument(
        "--block-rows", type=_block_rows, metavar="S", help="rows of past and future (by order)"
    )
    parser.add_argument(
        "--stabilise",
        type=_radius,
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
        "--seed", type=_seed, default=0, metavar="S", help="of the random numbers (%(default)s)"
    )


def _whole(text: str, least: int, most: int | None = None) -> int:
    try:
        value = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text.strip()!r} is no whole number") from None
    if value < least:
        raise argparse.ArgumentTypeError(f"{value} is below {least}")
    if most is not None and value > most:
        raise argparse.ArgumentTypeError(f"{value} is above {most}")
    return value


def _count(text: str) -> int:
    return _whole(text, 1)


def _seed(text: str) -> int:
    return _whole(text, 0, 2**32 - 1)


def _block_rows(text: str) -> int:
    return _whole(text, 2)


def _order(text: str) -> int | str:
    try:
        return text if text == "auto" else _whole(text, 1)
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(f"{error}; give a positive one, or auto") from None


def _degree(text: str) -> int | str:
    try:
        return text if text == "auto" else _whole(text, 0)
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(f"{error}; give one from 0, or auto") from None


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text.strip()!r} is no number") from None
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text.strip()} is not finite")
    return value


def _seconds(text: str) -> float:
    value = _number(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"{value:g} is no positive number of seconds")
    return value


def _fraction(text: str) -> float:
    value = _number(text)
    if not 0 < value < 1:
        raise argparse.ArgumentTypeError(f"{value:g} does not lie between 0 and 1")
    return value


def _radius(text: str) -> float:
    value = _number(text)
    if not 0 < value < 1:
        raise argparse.ArgumentTypeError(f"the radius {value:g} does not lie between 0 and 1")
    return value


def _columns(text: str) -> list[str]:
    names = [name.strip() for name in text.split(",")]
    if not all(names):
        raise argparse.ArgumentTypeError(f"{text!r} has an empty column name")
    return names


def _lengths(text: str) -> tuple[float, float]:
    values = [_number(part) for part in text.split(",")]
    if len(values) != 2 or min(values) <= 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not two positive lengths such as 0.35,0.30")
    return values[0], values[1]
