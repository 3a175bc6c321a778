"""What closing the loop found, in words and rows, for the page and for the terminal."""

import textwrap
from statistics import NormalDist
from typing import Any

import numpy as np

from lpvid.loop import EstimatedNumber, FoundEffect, Loop
from lpvid.report._report import text_table

# Half a 95 % interval in standard deviations.
_NORMAL_95 = NormalDist().inv_cdf(0.975)
ERROR_HEADERS = ["error", "before", "after", "floor"]


def headline(loop: Loop) -> str:
    """The verdict in a few plain words.

    Args:
        loop: result of `lpvid.loop.close_the_loop`.

    Example:
        >>> headline(loop)  # doctest: +SKIP
        'Found: coulomb (force at joint)'
    """
    names = listed([title(effect) for effect in loop.effects])
    return {
        "nothing to add": "Nothing to add",
        "named": f"Found: {names}",
        "named, remainder unknown": f"Found: {names}; something else remains",
        "abstain": "No name: something may be missing that no effect explains",
    }.get(loop.verdict, loop.verdict)


def loop_text(loop: Loop) -> str:
    """Verdict, effects with their 95 % intervals, and errors before and after, for a terminal.

    Args:
        loop: result of `lpvid.loop.close_the_loop`.

    Example:
        >>> print(loop_text(loop))  # doctest: +SKIP
    """
    parts = [f"{headline(loop)}.\n{_wrapped(loop.advice)}".strip()]
    if loop.effects:
        parts.append("Effects, with 95 % intervals:")
    for number, effect in enumerate(loop.effects, 1):
        lines = [f"{number}. {title(effect)}, {effect.family}"]
        lines += [f"   {one.name} = {estimate(one)}" for one in effect.parameters]
        lines += [f"   {sentence}" for sentence in doubts(effect)]
        parts.append("\n".join(lines))
    for k in range(len(loop.output_names)):
        parts.append(f"{errors_of(loop, k)}\n{text_table(error_rows(loop, k), ERROR_HEADERS)}")
    parts.append(_wrapped(f"Floor of the noise: {loop.noise_floor_from}. {tests(loop)}"))
    return "\n\n".join(parts)


def _wrapped(text: str) -> str:
    return textwrap.fill(text, 100)


def summary(loop: Loop) -> str:
    """One sentence: how far the error over the horizon has fallen."""
    sentences = []
    for k, name in enumerate(loop.output_names):
        before, after = float(loop.before.horizon[k]), float(loop.after.horizon[k])
        if not (np.isfinite(before) and np.isfinite(after)):
            continue
        floor = float(loop.noise_floor[k])
        noise = quantity(floor, output_unit(loop, k))
        least = f"; noise alone makes {noise}" if floor > 0.0 else ""
        if loop.effects and before > 0.0:
            change = 100.0 * (after - before) / before
            sign = "−" if change < 0.0 else "+"
            sentences.append(
                f"Predicted {ahead(loop)} ahead, {name} was wrong by "
                f"{quantity(before, output_unit(loop, k))} (RMS) and is now wrong by "
                f"{quantity(after, output_unit(loop, k))} ({sign}{abs(change):.0f} %){least}."
            )
        else:
            sentences.append(
                f"Predicted {ahead(loop)} ahead, {name} is wrong by "
                f"{quantity(before, output_unit(loop, k))} (RMS){least}."
            )
    return " ".join(sentences)


def tests(loop: Loop) -> str:
    """How sure it is, and what it took."""
    return (
        f"{loop.tests_made} hypotheses were tried in {loop.seconds:.1f} s. If nothing were "
        f"missing, chance alone would find as much with {probability(loop.p_value)} in the model "
        f"without effects, and with {probability(loop.p_value_left)} in the final one."
    )


def title(effect: FoundEffect) -> str:
    """Name and port of an effect."""
    return f"{effect.name} ({effect.port})"


def doubts(effect: FoundEffect) -> list[str]:
    """What cannot be told from the effect, and what record would."""
    if not effect.confusable_with:
        return []
    names = [place(name) for name in effect.confusable_with]
    found = [f"These records cannot tell it from {listed(names, 'or')}."]
    if effect.separating_input:
        found.append(f"To tell them apart: {effect.separating_input}.")
    return found


def place(label: str) -> str:
    """`coulomb at load` of `coulomb at force at load`."""
    return label.replace(" at force at ", " at ").replace(" at input ", " at ")


def error_rows(loop: Loop, k: int) -> list[list[Any]]:
    """One step, horizon, free run and best fit of output k; not known where not finite."""
    floor = float(loop.noise_floor[k])
    lasting = f"{loop.horizon} steps"
    rows = [
        ["one step", loop.before.one_step[k], loop.after.one_step[k], floor],
        [lasting, loop.before.horizon[k], loop.after.horizon[k], floor],
        ["free run", loop.before.free_run[k], loop.after.free_run[k], floor],
    ]
    # Three digits: a phone is narrow.
    short = [[name, *(known(float(f"{value:.3g}")) for value in values)] for name, *values in rows]
    fits = (loop.before.bft[k], loop.after.bft[k], floor_bft(loop)[k])
    return [*short, ["best fit, %", *(known(value) for value in fits)]]


def floor_bft(loop: Loop) -> np.ndarray:
    """Best fit rate of a model that errs by the noise floor alone, % (ny,)."""
    output = np.asarray(loop.series.output, float)
    spread = np.sqrt(np.mean((output - np.mean(output, axis=0)) ** 2, axis=0))
    floor = np.asarray(loop.noise_floor, float)
    share = np.full(floor.shape, np.nan)
    np.divide(floor, spread, out=share, where=spread > 0.0)
    return 100.0 * np.maximum(1.0 - share, 0.0)


def errors_of(loop: Loop, k: int) -> str:
    """Caption of the errors of output k."""
    first, last = loop.held_out
    name = quantity(loop.output_names[k], output_unit(loop, k, True))
    return f"{name}, held-out samples {first}–{last}"


def ablation_rows(loop: Loop) -> list[list[Any]]:
    """Error over the horizon with all effects, and without each of them."""
    names = ["with all", *(f"without {place(name)}" for name in loop.ablation)]
    values = [loop.after.horizon, *loop.ablation.values()]
    return [
        [name, *(known(one) for one in np.asarray(value, float))]
        for name, value in zip(names, values, strict=True)
    ]


def estimate(number: EstimatedNumber) -> str:
    """Value and half its 95 % interval, to as many digits as the interval says, with unit."""
    half = _NORMAL_95 * number.std
    # A pure number, or one of signals without units.
    unit = "" if number.unit == "1" else number.unit
    value = float(number.value)
    if not np.isfinite(half):
        return f"{quantity(value, unit)} (undecided)"
    if half <= 0.0 or not np.isfinite(value):
        return quantity(value, unit)
    digits = 1 - int(np.floor(np.log10(half)))
    if 0 <= digits <= 6 and abs(value) < 1e6:
        text = f"{value:.{digits}f} ± {half:.{digits}f}"
    else:
        places = max(0, digits + int(np.floor(np.log10(max(abs(value), half)))))
        text = f"{value:.{min(places, 15)}e} ± {half:.1e}"
    return f"{text} {unit}".rstrip()


def quantity(value: float | str, unit: str) -> str:
    """A number of three digits, or a name, with its unit."""
    text = value if isinstance(value, str) else f"{value:.3g}"
    return f"{text} {unit}".rstrip()


def output_unit(loop: Loop, k: int, brackets: bool = False) -> str:
    """Unit of output k, in brackets after a name; empty where it has none."""
    found = loop.output_units[k]
    return f"({found})" if found and brackets else found


def ahead(loop: Loop) -> str:
    """The horizon in samples and seconds."""
    return f"{loop.horizon} samples ({loop.horizon * loop.dt:.3g} s)"


def probability(value: float) -> str:
    """A p-value in words."""
    if not np.isfinite(value):
        return "p unknown"
    return "p < 0.0001" if value < 1e-4 else f"p = {value:.2g}"


def known(value: Any) -> float | None:
    """A number, or `None` where it is not finite."""
    return float(value) if np.isfinite(value) else None


def listed(names: Any, word: str = "and") -> str:
    """Names with commas and a word between them."""
    names = list(names)
    if len(names) < 2:
        return "".join(names)
    return f"{', '.join(names[:-1])} {word} {names[-1]}"
