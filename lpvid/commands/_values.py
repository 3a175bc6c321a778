"""What options accept: numbers and names from text, faults in plain words."""

import argparse
import math


def whole(text: str, least: int, most: int | None = None) -> int:
    """A whole number between `least` and `most`."""
    try:
        value = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text.strip()!r} is no whole number") from None
    if value < least:
        raise argparse.ArgumentTypeError(f"{value} is below {least}")
    if most is not None and value > most:
        raise argparse.ArgumentTypeError(f"{value} is above {most}")
    return value


def count(text: str) -> int:
    """A positive whole number."""
    return whole(text, 1)


def seed(text: str) -> int:
    """A seed of random numbers."""
    return whole(text, 0, 2**32 - 1)


def block_rows(text: str) -> int:
    """A number of block rows."""
    return whole(text, 2)


def order(text: str) -> int | str:
    """A number of states, or "auto"."""
    try:
        return text if text == "auto" else whole(text, 1)
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(f"{error}; give a positive one, or auto") from None


def degree(text: str) -> int | str:
    """A degree from 0, or "auto"."""
    try:
        return text if text == "auto" else whole(text, 0)
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(f"{error}; give one from 0, or auto") from None


def number(text: str) -> float:
    """A finite number."""
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text.strip()!r} is no number") from None
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text.strip()} is not finite")
    return value


def seconds(text: str) -> float:
    """A positive time."""
    value = number(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"{value:g} is no positive number of seconds")
    return value


def fraction(text: str) -> float:
    """A share between 0 and 1."""
    value = number(text)
    if not 0 < value < 1:
        raise argparse.ArgumentTypeError(f"{value:g} does not lie between 0 and 1")
    return value


def radius(text: str) -> float:
    """A radius of poles between 0 and 1."""
    value = number(text)
    if not 0 < value < 1:
        raise argparse.ArgumentTypeError(f"the radius {value:g} does not lie between 0 and 1")
    return value


def columns(text: str) -> list[str]:
    """Names of columns with commas between them."""
    names = [name.strip() for name in text.split(",")]
    if not all(names):
        raise argparse.ArgumentTypeError(f"{text!r} has an empty column name")
    return names


def lengths(text: str) -> tuple[float, float]:
    """Two positive lengths."""
    values = [number(part) for part in text.split(",")]
    if len(values) != 2 or min(values) <= 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not two positive lengths such as 0.35,0.30")
    return values[0], values[1]
