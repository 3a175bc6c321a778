"""The demo's last step: a record with an effect that nobody declared, and what is made of it."""

from pathlib import Path
from typing import Any, NamedTuple

import jax

from lpvid import loop, plot
from lpvid.loop.structures import structure_named
from lpvid.report import Report, error_tables, headline, to_json, write_html
from lpvid.study import Undeclared, undeclared_record

# Where the arm is, from all others that the seed draws.
_STREAM = 20
_FITTED = 2.0 / 3.0

SETTING = (
    "Last, a record of the arm at θ2 = π/2 with an effect in it that the linear model lacks: dry "
    "friction or quadratic drag at one joint, or a delay of both inputs, drawn by the seed with "
    "its size. The search is told nothing of it."
)


class Ending(NamedTuple):
    """What was hidden and what was found.

    Attributes:
        hidden: the record and its effect.
        found: what closing the loop made of it.
    """

    hidden: Undeclared
    found: loop.Loop


def end(arm: Any, seed: int) -> Ending:
    """Simulate the record, close the loop on it."""
    hidden = undeclared_record(arm, jax.random.fold_in(jax.random.key(seed), _STREAM))
    # Records show masses and gains up to one factor only: the drive's gain is the user's to know.
    structure = structure_named(
        "two-link-arm",
        hidden.data.split(_FITTED)[0],
        lengths=tuple(float(length) for length in arm.link_lengths),
        velocity_gain=float(arm.velocity_gains[0]),
    )
    return Ending(hidden, loop.close_the_loop(structure, hidden.data, split=_FITTED))


def summary(ending: Ending) -> dict[str, Any]:
    """Figures for the JSON file."""
    hidden = ending.hidden
    truth = {
        "name": hidden.name,
        "joint": hidden.joint,
        "size": {"value": hidden.size, "unit": hidden.unit},
    }
    return {"hidden": truth, **to_json(ending.found)}


def add_section(page: Report, ending: Ending, folder: Path) -> Report:
    """The report's last section, and a page of its own beside it."""
    hidden, found = ending
    write_html(found, folder / "loop.html")
    where = f"joint {hidden.joint}" if hidden.joint else "both inputs"
    page = page.heading("An effect that nobody declared").paragraph(SETTING)
    page = page.paragraph(
        f"Hidden: {hidden.name} at {where}, {hidden.size:.3g} {hidden.unit}. {headline(found)}. "
        f"{found.advice}\n\nMore is in loop.html, beside this page."
    )
    page = error_tables(page, found)
    for name, axes, caption in (
        ("virtual_forces", plot.virtual_forces(found), "What is lacking, and the laws found."),
        ("held_out", plot.loop_responses(found), "Held-out outputs before and after."),
    ):
        if axes.size:
            page = page.figure(plot.save_figure(axes, folder / f"{name}.png"), caption)
    return page
