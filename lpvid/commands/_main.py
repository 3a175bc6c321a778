"""Entry point: which command runs, and how it ends."""

import argparse
import importlib
import os
import sys
import traceback
from collections.abc import Sequence

from lpvid.commands._messages import Warnings, in_command_words, say
from lpvid.commands._parser import make_parser, protect_numbers

_DEBUG = "LPVID_DEBUG"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: arguments without the program's name; those of the process by default.

    Returns:
        Exit code: 0; 1 for a fault of the program; 2 for wrong use or unusable data, said in one
        line on stderr; 130 after Ctrl-C. `LPVID_DEBUG=1` adds the traceback.

    Example:
        >>> main(["identify", "run.csv"])  # doctest: +SKIP
        2
    """
    words = list(sys.argv[1:] if argv is None else argv)
    command = " ".join(["lpvid", *(word for word in words[:1] if not word.startswith("-"))])
    try:
        arguments = make_parser().parse_args(protect_numbers(words))
        with Warnings(command) as warnings:
            _run(arguments, warnings)
        sys.stdout.flush()
        return 0
    except SystemExit as stop:
        # argparse after --help and --version.
        return int(stop.code or 0)
    except KeyboardInterrupt:
        say(f"{command}: interrupted; files are whole or not written.")
        return 130
    except BrokenPipeError:
        # The reader of stdout has gone (`| head`); Python would complain at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except (ValueError, ImportError) as error:
        # An ImportError is an optional package that a file format needs.
        return _end(f"{command}: error: {in_command_words(str(error))}", 2)
    except OSError as error:
        reason = error.strerror or str(error)
        where = f"{error.filename}: " if error.filename else ""
        return _end(f"{command}: error: {where}{reason}", 2)
    except Exception as error:
        name = type(error).__name__
        return _end(
            f"{command}: internal error: {name}: {error} (LPVID_DEBUG=1 shows where; please "
            "report it)",
            1,
        )


def _run(arguments: argparse.Namespace, warnings: Warnings) -> None:
    # Imported only now: help and faults of usage do not wait for what a command needs.
    command = importlib.import_module(f"lpvid.commands._{arguments.command.replace('-', '_')}")
    command.run(arguments, warnings)


def _end(message: str, code: int) -> int:
    if os.environ.get(_DEBUG) == "1":
        traceback.print_exc()
    say(message)
    return code
