"""Estimates by name, with unit and standard error, out of a fitted model's arrays."""

import numpy as np

from lpvid.effects import Units, fill
from lpvid.loop._assess import standard_errors
from lpvid.loop._candidates import Place, port_name
from lpvid.loop._ported import AbstractPortedStructure
from lpvid.loop._result import EstimatedNumber, SeatedEffect
from lpvid.loop._tune import Fitted, free_unknowns


def parameter_numbers(fitted: Fitted, covariance: np.ndarray) -> tuple[EstimatedNumber, ...]:
    """The structure's parameters.

    Args:
        fitted: the model.
        covariance: of its free unknowns.
    """
    structure, theta = fitted.setting.structure, np.asarray(fitted.unknowns.theta)
    spread = standard_errors(covariance)[: theta.size]
    rows = zip(structure.parameter_names, theta, spread, structure.parameter_units, strict=True)
    return tuple(
        EstimatedNumber(name, float(value), float(std), unit) for name, value, std, unit in rows
    )


def seated_effect(
    fitted: Fitted, covariance: np.ndarray, slot: int, schedules: tuple[str, ...]
) -> SeatedEffect:
    """The effect in a slot.

    Args:
        fitted: the model.
        covariance: of its free unknowns.
        slot: which effect.
        schedules: names of what a strength may follow.
    """
    setting, unknowns, place = fitted.setting, fitted.unknowns, fitted.places[slot]
    law, units = setting.laws[place.law], _units(setting.structure, place)
    where, _, _ = free_unknowns(setting, fitted.places, fitted.scales, unknowns)
    spread = np.full(int(where.max()) + 1, np.nan)
    spread[where] = standard_errors(covariance)
    directions = unknowns.amplitude.shape[2]
    along = directions if place.port == "force" else 1
    amplitudes, shapes = unknowns.amplitude[slot], unknowns.shape[slot]
    start = unknowns.theta.size + slot * unknowns.amplitude[0].size
    numbers = []
    if not law.whole:
        for number, amplitude in enumerate(law.amplitudes):
            for direction in range(along):
                suffix = f"[{direction + 1}]" if along > 1 else ""
                numbers.append(
                    EstimatedNumber(
                        amplitude.name + suffix,
                        float(amplitudes[number, direction]),
                        float(spread[start + number * directions + direction]),
                        fill(amplitude.unit, units),
                    )
                )
    start = unknowns.theta.size + unknowns.amplitude.size + slot * unknowns.shape.shape[1]
    for number, shape in enumerate(law.shapes):
        numbers.append(
            EstimatedNumber(
                shape.name,
                float(shapes[number]),
                float(spread[start + number]),
                fill(shape.unit, units),
            )
        )
    port = port_name(setting.structure, place, schedules)
    return SeatedEffect(law.name, law.family, port, tuple(numbers))


def _units(structure: AbstractPortedStructure, place: Place) -> Units:
    if place.port == "force":
        return Units(structure.force_units[place.where], structure.coordinate_units[place.where])
    if place.port == "input":
        return Units(structure.input_units[place.where])
    if place.port == "output":
        return Units(structure.output_units[place.where])
    return Units("")
