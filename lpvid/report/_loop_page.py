"""What closing the loop found, as one self-contained HTML page."""

import os
from pathlib import Path
from typing import Any

import numpy as np

from lpvid import plot
from lpvid.loop import Loop
from lpvid.report._loop_words import (
    ERROR_HEADERS,
    ablation_rows,
    ahead,
    doubts,
    error_rows,
    errors_of,
    estimate,
    headline,
    output_unit,
    probability,
    quantity,
    summary,
    tests,
    title,
)
from lpvid.report._report import Report

# Samples of a response that can be told apart on a page.
_SHOWN = 1500


def loop_page(loop: Loop) -> Report:
    """The page that `write_html` writes, to be added to.

    Args:
        loop: result of `lpvid.loop.close_the_loop`.

    Example:
        >>> page = loop_page(loop).heading("Our rig").paragraph("…")  # doctest: +SKIP
    """
    page = Report(headline(loop))
    page = page.paragraph(f"{loop.advice}\n\n{summary(loop)}")
    page = page.heading("Error before and after")
    page = page.paragraph(
        f"On data that took no part in the fit. Root mean square errors of predictions one step "
        f"and {ahead(loop)} ahead, and of the simulation (free run) with its best fit rate. "
        f"Floor of the noise: {loop.noise_floor_from}."
    )
    page = error_tables(page, loop)
    page = _effects(page, loop)
    page = _pictures(page, loop)
    page = page.heading("The model")
    page = page.paragraph(
        f"Structure {loop.structure}, fitted with {'the' if loop.effects else 'no'} effects in "
        "place; 95 % intervals that hold for coloured residuals."
    )
    rows = [[one.name, estimate(one)] for one in loop.parameters]
    page = page.table(rows, ["parameter", "estimate"])
    page = page.heading("How sure").paragraph(tests(loop))
    if loop.residual_tests:
        page = page.table(
            [[name, probability(value)] for name, value in loop.residual_tests.items()],
            ["test of the final residuals", "result"],
        )
    return page


def error_tables(page: Report, loop: Loop) -> Report:
    """A page with a table of the errors before and after more, for each output.

    Args:
        page: to be added to.
        loop: result of `lpvid.loop.close_the_loop`.

    Example:
        >>> page = error_tables(Report("Our rig"), loop)  # doctest: +SKIP
    """
    for k in range(len(loop.output_names)):
        page = page.table(error_rows(loop, k), ERROR_HEADERS, errors_of(loop, k))
    return page


def write_html(loop: Loop, path: str | os.PathLike[str]) -> Path:
    """Write what was found as one HTML page; an interruption leaves the old file.

    The verdict in plain words, errors before and after, effects with intervals and what they
    could be confused with, pictures. Nothing is fetched, no script runs; it reads on a phone.

    Args:
        loop: result of `lpvid.loop.close_the_loop`.
        path: where to.

    Returns:
        The path.

    Raises:
        OSError: the folder is missing or not writable.

    Example:
        >>> write_html(loop, "report.html").name  # doctest: +SKIP
        'report.html'
    """
    return loop_page(loop).write(path)


def _effects(page: Report, loop: Loop) -> Report:
    if not loop.effects:
        return page
    page = page.heading("What was missing")
    for number, effect in enumerate(loop.effects, 1):
        page = page.heading(f"{number}. {title(effect)}", 3)
        rows = [[one.name, estimate(one)] for one in effect.parameters]
        page = page.table(rows, [effect.family, "estimate, 95 % interval"])
        page = page.paragraph(
            f"It raises the log-likelihood by {effect.gain:.4g} on the data it was fitted to and "
            f"by {effect.held_out_gain:.4g} on data that took no part; over all tests of its "
            f"round {probability(effect.p_value)}."
        )
        certain = "Nothing else in the library looks like it on these records."
        page = page.paragraph(" ".join(doubts(effect)) or certain)
    if loop.ablation:
        names = [quantity(n, output_unit(loop, k, True)) for k, n in enumerate(loop.output_names)]
        caption = f"Error {ahead(loop)} ahead, held-out, when one effect is taken out again"
        page = page.table(ablation_rows(loop), ["effects", *names], caption)
    return page


def _pictures(page: Report, loop: Loop) -> Report:
    page = page.heading("Pictures")
    span = _span(loop)
    drawn: list[tuple[Any, str]] = [
        (plot.virtual_forces(loop), _FORCES),
        (plot.loop_responses(loop, span=span), _RESPONSES + ("" if span is None else _PART)),
        (plot.error_ladder(loop), _LADDER),
        (plot.loop_residuals(loop), _RESIDUALS),
        (plot.loop_spectra(loop), _SPECTRA),
        (plot.candidate_ranking(loop), _ranking(loop)),
    ]
    for axes, caption in drawn:
        if axes.size:
            page = page.figure(axes, caption)
    return page


_FORCES = (
    "What the model lacks at each port against what it depends on (dots: samples, circles: means) "
    "and the law that was found (line)."
)
_RESPONSES = "Held-out outputs beside the free runs without and with the effects, and their errors."
_PART = " Shown is the part where the model without effects errs most."
_LADDER = "Error over the prediction horizon; dotted: free run; short dashes: noise floor."
_RESIDUALS = "One-step prediction errors."
_SPECTRA = "Their spectra, beside the measured output's."


def _ranking(loop: Loop) -> str:
    tried = "What was tried in each round, by its gain in log-likelihood less the penalty."
    if not loop.effects:
        return tried
    if not any(effect.confusable_with for effect in loop.effects):
        return f"{tried} Blue: found."
    return f"{tried} Blue: found; hatched: cannot be told from it."


def _span(loop: Loop) -> tuple[float, float] | None:
    """Times of the part where the free run without effects errs most; `None` for all."""
    time = np.asarray(loop.series.time, float)
    if time.size <= _SHOWN or np.any(np.diff(time) <= 0.0):
        return None
    error = np.asarray(loop.series.output - loop.series.before, float)
    scale = np.maximum(np.nanstd(loop.series.output, axis=0), 1e-300)
    power = np.sum(np.nan_to_num(error / scale, posinf=0.0, neginf=0.0) ** 2, axis=1)
    sums = np.concatenate([[0.0], np.cumsum(power)])
    first = int(np.argmax(sums[_SHOWN:] - sums[:-_SHOWN]))
    return float(time[first]), float(time[first + _SHOWN - 1])
