"""The effects that are tried unless others are given."""

from collections.abc import Sequence

from lpvid.effects._backlash import Backlash
from lpvid.effects._bias import SensorBias, TorqueBias
from lpvid.effects._delay import InputDelay
from lpvid.effects._disturbance import PeriodicDisturbance
from lpvid.effects._drag import QuadraticDrag
from lpvid.effects._drift import ParameterDrift, SensorDrift
from lpvid.effects._friction import (
    AsymmetricCoulomb,
    AsymmetricViscous,
    Coulomb,
    Dahl,
    LoadDependentFriction,
    Stribeck,
)
from lpvid.effects._gain import CubicGain, GainAsymmetry, SquareGain
from lpvid.effects._gravity import Gravity
from lpvid.effects._hysteresis import BoucWen, Play
from lpvid.effects._inertia import Centrifugal, PositionInertia
from lpvid.effects._lag import ActuatorLag, SensorLag
from lpvid.effects._law import AbstractLaw
from lpvid.effects._mode import MissingMode
from lpvid.effects._ripple import TorqueRipple
from lpvid.effects._saturation import Saturation
from lpvid.effects._scheduling import Scheduling
from lpvid.effects._sensor import AbsoluteValueSensor, CubicSensor
from lpvid.effects._stiffness import CubicStiffness, OddQuadraticStiffness, QuadraticStiffness

LIBRARY: tuple[AbstractLaw, ...] = (
    Coulomb(),
    Stribeck(),
    AsymmetricViscous(),
    AsymmetricCoulomb(),
    LoadDependentFriction(),
    Dahl(),
    QuadraticDrag(),
    BoucWen(),
    Play(),
    CubicStiffness(),
    QuadraticStiffness(),
    OddQuadraticStiffness(),
    Backlash(),
    Saturation(),
    CubicGain(),
    GainAsymmetry(),
    SquareGain(),
    InputDelay(),
    ActuatorLag(),
    SensorLag(),
    MissingMode(),
    Gravity(),
    TorqueRipple(),
    PeriodicDisturbance(),
    TorqueBias(),
    SensorBias(),
    SensorDrift(),
    AbsoluteValueSensor(),
    CubicSensor(),
    Scheduling(),
    ParameterDrift(),
    PositionInertia(),
    Centrifugal(),
)
"""All laws of this room, one of each."""


def law(name: str, library: Sequence[AbstractLaw] = LIBRARY) -> AbstractLaw:
    """The law of a name.

    Args:
        name: as in the report.
        library: laws to look among.

    Raises:
        ValueError: no law of that name.

    Example:
        >>> law("coulomb").family
        'friction'
    """
    for one in library:
        if one.name == name:
            return one
    names = ", ".join(one.name for one in library)
    raise ValueError(f"name={name!r} is no law of the library; its laws are: {names}.")
