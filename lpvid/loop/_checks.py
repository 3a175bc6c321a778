"""What is refused before any work: records and choices that cannot give an answer."""

import numpy as np

from lpvid.data import DataError, IOData
from lpvid.loop._ported import AbstractPortedStructure
from lpvid.loop._program import SLOTS
from lpvid.loop._records import HOLDS

_LEAST_SAMPLES = 100
_LEAST_HELD_OUT = 50


def checked_options(
    test: IOData | None, split: float, most_effects: int, horizon: int | None, hold: str
) -> None:
    """Refuse choices that leave nothing to do.

    Args:
        test: other records, if any.
        split: share that estimates.
        most_effects: effects to add at most.
        horizon: samples of the horizon error, if given.
        hold: what the inputs do between samples.

    Raises:
        ValueError: an unusable split, number of effects or horizon, an unknown hold.
    """
    if hold not in HOLDS:
        raise ValueError(
            f'hold={hold!r} is not known: "zero" for inputs that a converter holds, "linear" for '
            "measured ones that are band-limited."
        )
    if horizon is not None and horizon < 1:
        raise ValueError(f"horizon={horizon} must be a number of samples, 1 or more.")
    if not 1 <= most_effects <= SLOTS:
        raise ValueError(f"most_effects={most_effects} must be 1 to {SLOTS}.")
    if test is None and not 0.2 <= split <= 0.9:
        raise ValueError(
            f"split={split} must lie between 0.2 and 0.9: it is the share of each record that "
            "estimates, the rest decides."
        )


def checked_records(
    structure: AbstractPortedStructure,
    data: IOData,
    test: IOData | None,
    split: float,
    horizon: int | None,
) -> None:
    """Refuse records that cannot give an answer, with the reason and the remedy.

    Args:
        structure: the base model.
        data: records.
        test: other records, if any.
        split: share that estimates.
        horizon: samples of the horizon error, if given.

    Raises:
        DataError: too short records, or ones that do not fit the structure or each other.
    """
    for name, one in (("data", data), ("test", test)):
        if one is not None:
            _check_count(name, one, structure)
    if test is not None and not np.isclose(test.dt, data.dt, rtol=1e-9):
        raise DataError(
            f"test has a sample time of {test.dt} s and data one of {data.dt} s: resample one."
        )
    if test is not None and (test.kappa is None) != (data.kappa is None):
        raise DataError("Either both of data and test need a scheduling signal or neither.")
    shortest = min(data.lengths)
    estimate = shortest if test is not None else round(shortest * split)
    decide = min(test.lengths) if test is not None else shortest - estimate
    if estimate < _LEAST_SAMPLES or decide < _LEAST_HELD_OUT:
        raise DataError(
            f"Records of {estimate} samples to estimate and {decide} to decide are too short: "
            f"give at least {_LEAST_SAMPLES} and {_LEAST_HELD_OUT}."
        )
    if horizon is not None and 2 * horizon > decide:
        raise DataError(
            f"horizon={horizon} is more than half of a held-out record of {decide} samples: give a "
            "shorter one, or more data."
        )


def checked_signals(data: IOData, test: IOData | None) -> None:
    """Refuse signals that tell nothing, before a structure is made from them.

    Args:
        data: records.
        test: other records, if any.

    Raises:
        DataError: non-finite or constant signals.
    """
    for name, one in (("data", data), ("test", test)):
        if one is not None:
            _check_signals(name, one)


def checked_fit(log_likelihood: float, structure: AbstractPortedStructure) -> None:
    """Refuse to go on from a model that the records could not be fitted with.

    Args:
        log_likelihood: of the model without effects.
        structure: the base model.

    Raises:
        DataError: it is not finite.
    """
    if not np.isfinite(log_likelihood):
        raise DataError(
            f"The structure '{structure.name}' cannot be fitted to these records: its prediction "
            "errors are not finite, or those of two outputs are the same. Check the sample time "
            "and the channels' units, leave out an output that repeats another, or give another "
            "structure."
        )


def _check_count(name: str, data: IOData, structure: AbstractPortedStructure) -> None:
    wanted = (len(structure.input_names), len(structure.output_names))
    if (data.nu, data.ny) != wanted:
        raise DataError(
            f"{name} has {data.nu} inputs and {data.ny} outputs; the structure "
            f"'{structure.name}' has {wanted[0]} and {wanted[1]}."
        )


def _check_signals(name: str, data: IOData) -> None:
    for kind, signals, names in (
        ("input", np.asarray(data.u), data.input_names),
        ("output", np.asarray(data.y), data.output_names),
    ):
        if not np.all(np.isfinite(signals)):
            raise DataError(f"{name}: an {kind} has non-finite samples; cut or repair them.")
        still = np.ptp(signals, axis=0) <= 1e-12 * np.max(np.abs(signals), axis=0)
        if np.any(still):
            channel = names[int(np.argmax(still))]
            raise DataError(
                f"{name}: {kind} '{channel}' is constant, so it tells nothing. Leave it out with "
                "data.select, or excite it."
            )
