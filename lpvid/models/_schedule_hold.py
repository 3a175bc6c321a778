"""What the scheduling does between the samples of a continuous-time LPV model."""

import abc
import math
from collections.abc import Callable
from typing import TypeAlias

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lpvid._linalg import expm
from lpvid.models._state_space import StateSpace

Frozen: TypeAlias = Callable[[Array], StateSpace]


class AbstractScheduleHold(eqx.Module):
    """A rule for κ between samples; the input is held constant over each sample throughout."""

    @abc.abstractmethod
    def transitions(
        self, frozen: Frozen, schedule: Float[Array, "*batch time scheduling"], dt: float
    ) -> tuple[Float[Array, "*batch time nx nx"], Float[Array, "*batch time nx nu"]]:
        """State and input matrices from each sample to the next.

        Args:
            frozen: continuous-time models at κ of shape (…, scheduling).
            schedule: κ at the samples.
            dt: sample time, s.
        """


class HeldSchedule(AbstractScheduleHold):
    """κ constant over each sample: the frozen model's zero-order hold, exact.

    Example:
        >>> HeldSchedule() == HeldSchedule()
        True
    """

    def transitions(
        self, frozen: Frozen, schedule: Float[Array, "*batch time scheduling"], dt: float
    ) -> tuple[Float[Array, "*batch time nx nx"], Float[Array, "*batch time nx nu"]]:
        """One matrix exponential a sample."""
        # Batched, not vmapped: so the exponential skips the squarings that no sample needs.
        discrete = frozen(schedule).discretise(dt)
        return discrete.A, discrete.B


class LinearSchedule(AbstractScheduleHold):
    r"""κ on a straight line from each sample to the next (constant after the last).

    With the input held, $\dot z = M(t) z$ for z = (x, u). Each substep takes the exponential of the
    fourth-order Magnus expansion, $\Omega = \frac{h}{2}(M_1 + M_2) + \frac{\sqrt 3}{12} h^2 [M_2,
    M_1]$ with M at the two Gauss points (Blanes et al. 2009): the error falls with the fourth power
    of `substeps`, and is zero for constant κ.

    Attributes:
        substeps: of each sample.

    Raises:
        ValueError: fewer than one substep.

    Example:
        >>> LinearSchedule(substeps=2).substeps
        2
    """

    substeps: int = eqx.field(static=True, default=1)

    def __check_init__(self):
        if self.substeps < 1:
            raise ValueError(f"substeps: one at least is needed, got {self.substeps}.")

    def transitions(
        self, frozen: Frozen, schedule: Float[Array, "*batch time scheduling"], dt: float
    ) -> tuple[Float[Array, "*batch time nx nx"], Float[Array, "*batch time nx nu"]]:
        """Products of the substeps' exponentials."""
        following = jnp.concatenate([schedule[..., 1:, :], schedule[..., -1:, :]], axis=-2)
        step = dt / self.substeps
        reach = math.sqrt(3.0) / 6.0
        total, nx = None, 0
        for index in range(self.substeps):
            early, late = (
                frozen(schedule + ((index + 0.5 + side) / self.substeps) * (following - schedule))
                for side in (-reach, reach)
            )
            nx = early.nx
            first, second = _augmented(early), _augmented(late)
            commutator = second @ first - first @ second
            exponent = (0.5 * step) * (first + second) + (0.5 * reach * step**2) * commutator
            moved = expm(exponent)
            total = moved if total is None else moved @ total
        assert total is not None
        return total[..., :nx, :nx], total[..., :nx, nx:]


def _augmented(system: StateSpace) -> Array:
    upper = jnp.concatenate([system.A, system.B], axis=-1)
    lower = jnp.zeros((*system.batch_shape, system.nu, system.nx + system.nu))
    return jnp.concatenate([upper, lower], axis=-2)
