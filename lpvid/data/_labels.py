"""Names and units of channels: given by the user, or u1, y1, kappa1."""

from collections.abc import Mapping, Sequence
from typing import TypeAlias

Labels: TypeAlias = Mapping[str, str | Sequence[str]]

_KEYS = ("u", "y", "kappa")


def channel_labels(
    given: Labels | None, argument: str, counts: Mapping[str, int]
) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """Labels of inputs, outputs and scheduling, in this order.

    Args:
        given: what the user gave.
        argument: its name, "names" or "units", for messages.
        counts: number of channels under "u", "y" and "kappa".

    Raises:
        ValueError: an unknown key, a number of labels that does not fit, a label that is no string,
            or a name twice.
    """
    given = {} if given is None else given
    unknown = sorted(set(given) - set(_KEYS))
    if unknown:
        raise ValueError(f"{argument} has the keys {unknown}: use 'u', 'y' and 'kappa'.")
    u, y, kappa = (_labels_of(given, argument, key, counts[key]) for key in _KEYS)
    return u, y, kappa


def positions(wanted: str | Sequence[str], names: tuple[str, ...], argument: str) -> list[int]:
    """Index of each wanted channel in `names`.

    Raises:
        ValueError: one is not there.
    """
    wanted = (wanted,) if isinstance(wanted, str) else tuple(wanted)
    missing = [name for name in wanted if name not in names]
    if missing:
        raise ValueError(f"{argument}: no channel {missing[0]!r}; there are {', '.join(names)}.")
    return [names.index(name) for name in wanted]


def _labels_of(given: Labels, argument: str, key: str, count: int) -> tuple[str, ...]:
    is_name = argument == "names"
    if key not in given:
        return tuple(f"{key}{index + 1}" if is_name else "" for index in range(count))
    value = given[key]
    labels = (value,) if isinstance(value, str) else tuple(value)
    if len(labels) != count:
        raise ValueError(
            f"{argument}[{key!r}] has {len(labels)} entries but {key} has {count} channel(s): "
            f"give one for each."
        )
    if not all(isinstance(label, str) for label in labels):
        raise ValueError(f"{argument}[{key!r}] holds {labels}: give strings.")
    if is_name and len(set(labels)) < count:
        raise ValueError(f"{argument}[{key!r}] repeats a name ({', '.join(labels)}): rename one.")
    return labels
