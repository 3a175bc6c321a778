"""Structures by name."""

from typing import Any

from lpvid.data import IOData
from lpvid.loop._ported import AbstractPortedStructure
from lpvid.loop.structures._black_box import BlackBox
from lpvid.loop.structures._flexible_joint import FlexibleJoint
from lpvid.loop.structures._mass_spring_damper import PortedMassSpringDamper
from lpvid.loop.structures._servo import Servo
from lpvid.loop.structures._single_link_arm import FlexibleLink
from lpvid.loop.structures._two_link_arm import PortedTwoLinkArm
from lpvid.loop.structures._unfold import unfolded

_STRUCTURES: dict[str, Any] = {
    "black-box": BlackBox,
    "servo": Servo,
    "mass-spring-damper": PortedMassSpringDamper,
    "flexible-joint": FlexibleJoint,
    "single-link-arm": FlexibleLink,
    "two-link-arm": PortedTwoLinkArm,
}

STRUCTURES = tuple(_STRUCTURES)
"""The names that `structure_named` knows."""


def structure_named(
    name: str, data: IOData, *, order: int | None = None, **options: Any
) -> AbstractPortedStructure:
    """A structure by its name, its channels named as in the records.

    - black-box: any linear model;
    - servo: an inertia with viscous friction; one input, one output;
    - mass-spring-damper: as many forces as displacements;
    - flexible-joint: motor and load on a spring; one input, motor's and perhaps load's position;
    - single-link-arm: a hub with flexible modes; one input, hub angle, perhaps strains;
    - two-link-arm: velocity references in, velocities out, scheduled by cos θ2 or θ2.

    Args:
        name: one of `STRUCTURES`.
        data: records, of which a black box is identified, and which give signs, names and units; an
            output whose sensor folds it, y = |z|, is straightened for that.
        order: states of a black box, or of the single-link arm (4, 6 or 8); by default as many as
            the prediction error asks for.
        options: of the structure, such as `output="velocity"` of a servo.

    Raises:
        ValueError: an unknown name, channels that do not fit, an order for a structure that has
            its own.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.loop.structures import structure_named
        >>> data = IOData(u=np.zeros((9, 2)), y=np.zeros((9, 2)), dt=0.1)
        >>> structure_named("mass-spring-damper", data).parameter_names[0]
        'mass[1,1]'
    """
    if name not in _STRUCTURES:
        raise ValueError(
            f"structure {name!r} is not known: give one of {', '.join(STRUCTURES)}, or an object "
            f"of your own such as FunctionPorted."
        )
    if order is not None:
        if name == "black-box":
            options["order"] = order
        elif name == "single-link-arm":
            if order not in (4, 6, 8):
                raise ValueError(
                    f"order={order}: a single-link arm has 4, 6 or 8 states (1, 2 or 3 modes)."
                )
            options["modes"] = order // 2 - 1
        else:
            raise ValueError(
                f"order={order}: structure {name!r} has an order of its own; leave it out, or take "
                f"'black-box'."
            )
    # A linear model of a folded output is none of the plant.
    return _STRUCTURES[name](unfolded(data)[0], **options)
