"""The two-link arm by its physical parameters, for direct estimation from records."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.mechanics._study_records import OPERATING_POINTS
from lpvid.mechanics._two_link_arm import TwoLinkFlexibleArm
from lpvid.models import GrayBoxLPV, StateSpace

_FIELDS = (
    ("linear_densities", "linear density", 2),
    ("bending_stiffnesses", "bending stiffness", 2),
    ("hub_inertias", "hub inertia", 2),
    ("joint_mass", "joint mass", 0),
    ("payload_mass", "payload mass", 0),
    ("velocity_gains", "velocity gain", 2),
)


class LinearisedTwoLinkArm(eqx.Module):
    """(Physical parameters, cos θ2) → the arm linearised at rest.

    Attributes:
        link_lengths: ℓ, m, which are known.

    Example:
        >>> from lpvid.mechanics import reference_two_link_arm, two_link_arm_gray_box
        >>> model = two_link_arm_gray_box(reference_two_link_arm())
        >>> model.function.arm(model.parameters).joint_mass.round(6).item()
        1.0
    """

    link_lengths: Float[Array, "2"]

    def arm(self, parameters: Float[Array, "10"]) -> TwoLinkFlexibleArm:
        """The arm of these parameters."""
        values, first = {}, 0
        for field, _, count in _FIELDS:
            part = parameters[first : first + max(count, 1)]
            values[field] = part if count else part[0]
            first += max(count, 1)
        return TwoLinkFlexibleArm(link_lengths=self.link_lengths, **values)

    def __call__(self, parameters: Float[Array, "10"], kappa: Float[Array, "1"]) -> StateSpace:
        """The linearised model at θ2 = arccos κ."""
        return self.arm(parameters).linearised(jnp.arccos(kappa[0]))


def two_link_arm_gray_box(
    start: TwoLinkFlexibleArm, *, theta2: Sequence[float] = OPERATING_POINTS
) -> GrayBoxLPV:
    """An LPV model of a two-link flexible arm in its physical parameters, κ = cos θ2.

    The parameters are ρ, EI, J, m_j, m_p and Λ in SI units; the lengths are known. Records of
    velocity references and velocities show masses, stiffnesses and gains only up to one common
    factor: fix one of them, such as a gain, when refining.

    Args:
        start: the arm at the start; a guess within a factor of about 1.5 is good enough.
        theta2: operating points, whose range the model is for, rad.

    Source: 001, section 3 (equations 20 to 32).

    Example:
        >>> from lpvid.mechanics import reference_two_link_arm
        >>> model = two_link_arm_gray_box(reference_two_link_arm())
        >>> model.parameter_names[-1], model.at(0.0).nx
        ('velocity gain 2', 6)
    """
    names, values = [], []
    for field, name, count in _FIELDS:
        names += [f"{name} {i + 1}" for i in range(count)] or [name]
        values.append(jnp.atleast_1d(getattr(start, field)))
    kappas = np.cos(np.asarray(theta2, float))
    return GrayBoxLPV(
        LinearisedTwoLinkArm(start.link_lengths),
        jnp.concatenate(values),
        names,
        kappa_low=kappas.min(),
        kappa_high=kappas.max(),
    )
