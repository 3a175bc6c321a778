"""Units of what is estimated, from those at the port."""

import re

from lpvid.effects._law import Units


def fill(unit: str, units: Units) -> str:
    """A law's unit with the port's own ones in place of `{acts_on}`, `{position}` and `{time}`.

    Args:
        unit: of a shape or an amplitude.
        units: at the port; an empty one counts as 1.

    Example:
        >>> fill("{acts_on}/{position}^3", Units(acts_on="N·m", position="rad"))
        'N·m/rad^3'
        >>> fill("1/{acts_on}^2", Units(acts_on="N·m"))
        '1/(N·m)^2'
    """

    def put(match: re.Match[str]) -> str:
        value = getattr(units, match["name"]) or "1"
        tight = (
            match.start() > 0 and unit[match.start() - 1] == "/" or unit[match.end() :][:1] == "^"
        )
        return f"({value})" if tight and re.search(r"[·*/ ]", value) else value

    filled = re.sub(r"\{(?P<name>\w+)\}", put, unit)
    # What is left of units that are 1: "1·s" → "s", "m/1" → "m".
    filled = re.sub(r"1(\^\d+)?·", "", filled) if filled.startswith("1") else filled
    return re.sub(r"/1(\^\d+)?(?!\w)", "", filled)
