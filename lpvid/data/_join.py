"""Several data sets as one."""

import math
from collections.abc import Sequence

from lpvid.data._io_data import IOData
from lpvid.data._signals import split_records


def join(parts: Sequence[IOData]) -> IOData:
    """Several `IOData` as one, all their records in the order given.

    Args:
        parts: one or more of them.

    Raises:
        ValueError: nothing is given; sample times (to 1e-6 of them: measured time stamps are not
            better), channel names or units differ; only some have `kappa`.

    Example:
        >>> from lpvid.data import IOData, join
        >>> low = IOData(u=[0.0, 1.0], y=[0.0, 2.0], dt=0.1)
        >>> high = IOData(u=[0.0, 3.0, 4.0], y=[0.0, 6.0, 8.0], dt=0.1)
        >>> join([low, high]).lengths
        (2, 3)
    """
    parts = list(parts)
    if not parts:
        raise ValueError("join: no data given; give a list of one or more IOData.")
    first = parts[0]
    for number, part in enumerate(parts):
        if not math.isclose(part.dt, first.dt, rel_tol=1e-6):
            raise ValueError(
                f"join: part {number} has dt={part.dt:.9g} s but part 0 has dt={first.dt:.9g} s; "
                f"bring them to one sample time first."
            )
        for what, own, common in (
            ("names", part.names, first.names),
            ("units", part.units, first.units),
        ):
            if own != common:
                raise ValueError(
                    f"join: part {number} has the {what} {own} but part 0 has {common}; use "
                    f"data.select, or data.replace({what}=...)."
                )
    kappas = [part.kappa for part in parts if part.kappa is not None]

    def pieces(signals):
        return [
            piece
            for signal, part in zip(signals, parts, strict=True)
            for piece in split_records(signal, part.lengths)
        ]

    return IOData(
        u=pieces([part.u for part in parts]),
        y=pieces([part.y for part in parts]),
        # Equal scheduling names: either every part has kappa or none has.
        kappa=pieces(kappas) if kappas else None,
        dt=first.dt,
        names=first.names,
        units=first.units,
    )
