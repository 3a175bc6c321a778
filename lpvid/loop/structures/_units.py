"""Units as text."""


def times(first: str, second: str) -> str:
    """The product of two units: `N·m`."""
    return "·".join(unit for unit in (first, second) if unit not in ("", "1"))


def per(first: str, second: str) -> str:
    """The quotient of two units: `N·s/m`."""
    if second in ("", "1"):
        return first
    below = f"({second})" if "·" in second or "/" in second else second
    above = f"({first})" if "/" in first else first or "1"
    return f"{above}/{below}"
