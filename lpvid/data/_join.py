"""Several data sets as one."""

import math
from collections.abc import Sequence

from lpvid.data._io_data import IOData
from lpvid.data._signals import split_records


def join(parts: Sequence[IOData]) -> IOData:
    """Several `IOData` as one, all their records in the order given.

    **Raises:** `ValueError` unless all have the same sample time (to 1e-6 of it: measured time
    stamps are not better), channel names and units, and all or none have `kappa`.

    !!! example

        ```python
        both = join([low_amplitude, high_amplitude])
        ```
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
