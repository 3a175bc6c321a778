"""`lpvid demo`: the study of Vizer et al. (2015) on the reference arm, then a hidden effect."""

import argparse
import sys
import time
from pathlib import Path

import jax
import numpy as np
from tqdm import tqdm

from lpvid import __version__
from lpvid._files import write_json
from lpvid.commands._cache import keep_compiled_code
from lpvid.commands._demo_figures import FIGURES
from lpvid.commands._demo_loop import Ending, add_section, end
from lpvid.commands._demo_loop import summary as ending_summary
from lpvid.commands._demo_tables import SETTING, tables
from lpvid.commands._messages import Warnings
from lpvid.commands._output import make_folder
from lpvid.mechanics import reference_two_link_arm
from lpvid.plot import save_figure
from lpvid.report import Report, loop_text, text_table
from lpvid.study import StudyResult, run_study, summary

# Stages that `run_study` announces.
_STAGES = 5


def run(arguments: argparse.Namespace, warnings: Warnings) -> None:
    """Run the study, draw, write, print."""
    started = time.perf_counter()
    folder = make_folder("--out", arguments.out)
    keep_compiled_code()
    # Pictures go to files: no window, no display needed.
    import matplotlib

    matplotlib.use("Agg")
    with _Progress(_STAGES + 2) as progress:
        result = run_study(
            jax.random.key(arguments.seed), runs=arguments.runs, report=progress.begin
        )
        progress.begin("Drawing")
        drawn = time.perf_counter()
        pictures = _draw(result, folder)
        drawing = time.perf_counter() - drawn
        progress.begin("Closing the loop on a record with a hidden effect")
        closing = time.perf_counter()
        ending = end(reference_two_link_arm(), arguments.seed)
        closing = time.perf_counter() - closing
    figures = summary(result)
    figures["seconds_by_stage"] = {**figures["seconds_by_stage"], "draw": drawing, "loop": closing}
    figures["seconds"] = time.perf_counter() - started
    content = {
        "study": figures,
        "loop": ending_summary(ending),
        "seed": arguments.seed,
        "runs": arguments.runs,
        "version": __version__,
        "warnings": warnings.messages,
    }
    write_json(folder / "summary.json", content)
    page = _report(result, pictures, arguments, figures["seconds"], ending, folder)
    page.write(folder / "report.html")
    for table in tables(result):
        print(f"{table.title}\n{text_table(table.rows, table.headers)}\n")
    print(f"A hidden effect: {loop_text(ending.found)}\n")
    print(f"{figures['seconds']:.0f} s in all. Report: {folder / 'report.html'}")


class _Progress:
    """Says in words what begins, and shows a bar on a terminal."""

    def __init__(self, total: int):
        self._number, self._total = 0, total
        # `disable=None`: no bar where stderr is no terminal.
        self._bar = tqdm(
            total=total,
            disable=None,
            leave=False,
            bar_format="{l_bar}{bar}| {n_fmt}/{total_fmt} stages, {elapsed}",
        )

    def __enter__(self) -> "_Progress":
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.close()

    def begin(self, message: str) -> None:
        """A stage begins; the one before it is done."""
        if self._number:
            self._bar.update()
        self._number += 1
        tqdm.write(f"[{self._number}/{self._total}] {message}", file=sys.stderr)


def _draw(result: StudyResult, folder: Path) -> list[tuple[str, Path]]:
    """Every figure as a PNG file; caption and path."""
    return [
        (figure.caption, save_figure(figure.draw(result), folder / f"{figure.name}.png"))
        for figure in FIGURES
    ]


def _report(
    result: StudyResult,
    pictures: list[tuple[str, Path]],
    arguments: argparse.Namespace,
    seconds: float,
    ending: Ending,
    folder: Path,
) -> Report:
    page = Report("A two-link flexible arm: from noisy local records to an LPV model")
    page = page.paragraph(SETTING)
    page = page.paragraph(
        f"{arguments.runs} noise realisation(s) at each of {len(result.theta2)} postures, seed "
        f"{arguments.seed}, {result.failed_runs} identification(s) failed; {seconds:.0f} s in all. "
        f"lpvid {__version__}."
    )
    by_name = {figure.name: picture for figure, picture in zip(FIGURES, pictures, strict=True)}
    for table in tables(result):
        page = page.heading(table.heading)
        page = page.paragraph(table.text).table(table.rows, table.headers, table.title)
        for name in table.figures:
            caption, path = by_name[name]
            page = page.figure(path, caption)
    page = add_section(page, ending, folder)
    slowest = max(result.seconds, key=lambda stage: result.seconds[stage])
    rows = [(stage, float(np.round(value, 1))) for stage, value in result.seconds.items()]
    page = page.heading("Time").paragraph(f"Compilation included; most went to “{slowest}”.")
    return page.table(rows, ["stage", "seconds"])
