"""`lpvid close-loop`: what a model lacks, named, added and refitted; error before and after."""

import argparse
import sys

from lpvid import __version__, loop
from lpvid._files import write_json
from lpvid.commands._cache import keep_compiled_code
from lpvid.commands._errors import UsageError
from lpvid.commands._messages import Warnings
from lpvid.commands._output import check_targets
from lpvid.commands._records import check_columns, read_records
from lpvid.io import load
from lpvid.loop.structures import PortedModel, structure_named
from lpvid.report import loop_text, to_json, write_html

BLACK_BOX = "black-box"
# Share of each record that is fitted to where the user says nothing.
SPLIT = 2.0 / 3.0


def run(arguments: argparse.Namespace, warnings: Warnings) -> None:
    """Read, close the loop, print, write."""
    _check(arguments)
    keep_compiled_code()
    model = None if arguments.model is None else load(arguments.model)
    data = read_records(arguments, arguments.files, arguments.schedule)
    print(f"{data!r}")
    split = arguments.split or SPLIT
    test = None
    if arguments.test:
        test = read_records(arguments, arguments.test, arguments.schedule)
    # What is held out takes no part in starting the structure either.
    fitted = data.split(split)[0] if test is None else data
    if model is None:
        structure = structure_named(arguments.structure or BLACK_BOX, fitted, order=arguments.order)
    else:
        structure = PortedModel(model, fitted)
    print(f"Structure {structure.name}; fitting and testing …", flush=True)
    found = loop.close_the_loop(
        structure,
        data,
        test=test,
        split=split,
        hold=arguments.hold,
        progress=sys.stderr.isatty(),
    )
    print(f"\n{loop_text(found)}\n")
    if arguments.html is not None:
        # Pictures go to a file: no window, no display needed.
        import matplotlib

        matplotlib.use("Agg")
        write_html(found, arguments.html)
        print(f"Report written to {arguments.html}")
    if arguments.json is not None:
        content = {
            "command": "close-loop",
            "version": __version__,
            "files": arguments.files,
            "test": arguments.test,
            "model_file": arguments.model,
            **to_json(found),
            "inputs": data.input_names,
            "scheduling": data.scheduling_names,
            "warnings": warnings.messages,
        }
        write_json(arguments.json, content)
        print(f"Figures written to {arguments.json}")


def _check(arguments: argparse.Namespace) -> None:
    check_columns(arguments)
    model = [] if arguments.model is None else [arguments.model]
    check_targets(
        {"--json": arguments.json, "--html": arguments.html},
        [*arguments.files, *arguments.test, *model],
    )
    if model and arguments.structure is not None:
        raise UsageError("--model brings its own structure: give --model or --structure")
    if model and arguments.order is not None:
        raise UsageError("--model brings its own order: give --model or --order")
    if arguments.test and arguments.split is not None:
        raise UsageError("--test holds data out, and so does --split: give one of them")
