"""LPV models from physical parameters: the user's own function of them and of the scheduling."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from lpvid.models._lpv import LPVStateSpace
from lpvid.models._schedule_hold import AbstractScheduleHold
from lpvid.models._scheduling import PolynomialBasis
from lpvid.models._state_space import Numbers, StateSpace
from lpvid.models._structures import AbstractStructure, Parameters


class ScheduledStructure(AbstractStructure):
    """A model as a function of scheduling and physical parameters, both counted as parameters.

    Attributes:
        function: (physical parameters, κ) → the model frozen at κ.
        names: of the physical parameters.
        n_scheduling: number of scheduling variables, which come first among the parameters.

    Example:
        >>> def lag(p, kappa):
        ...     return StateSpace(-p[:1, None] * kappa[0], jnp.eye(1), jnp.eye(1))
        >>> ScheduledStructure(lag, ("rate",), 1).matrices(jnp.array([2.0, 3.0])).A.item()
        -6.0
    """

    function: Callable[[Parameters, Array], StateSpace]
    names: tuple[str, ...] = eqx.field(static=True)
    n_scheduling: int = eqx.field(static=True)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """The scheduling variables, then the physical parameters."""
        return (*(f"kappa {i + 1}" for i in range(self.n_scheduling)), *self.names)

    def matrices(self, parameters: Parameters) -> StateSpace:
        """The model of these parameters, frozen."""
        return self.function(parameters[self.n_scheduling :], parameters[: self.n_scheduling])


class GrayBoxLPV(eqx.Module):
    """An LPV model by a few physical parameters that hold at every κ.

    `refine` estimates the parameters from records at constant and at moving κ, all at once.

    Attributes:
        function: (parameters, κ of shape (n_scheduling,)) → the `StateSpace` frozen at κ.
        parameters: one value for each name.
        parameter_names: of the parameters.
        kappa_low: lower end of each scheduling variable's range.
        kappa_high: its upper end.

    Raises:
        ValueError: names and parameters, or the two ends of the range, do not match.

    Example:
        >>> def spring(p, kappa):
        ...     A = jnp.array([[0.0, 1.0], [-p[0] - p[1] * kappa[0], -p[2]]])
        ...     return StateSpace(A, jnp.array([[0.0], [1.0]]), jnp.array([[1.0, 0.0]]))
        >>> names = ("stiffness", "hardening", "damping")
        >>> model = GrayBoxLPV(spring, [4.0, 1.0, 0.1], names, kappa_low=0.0, kappa_high=2.0)
        >>> model.at(2.0).A[1].tolist()
        [-6.0, -0.1]
    """

    function: Callable[[Parameters, Array], StateSpace]
    parameters: Float[Array, " parameter"]
    parameter_names: tuple[str, ...] = eqx.field(static=True)
    kappa_low: tuple[float, ...] = eqx.field(static=True)
    kappa_high: tuple[float, ...] = eqx.field(static=True)

    def __init__(
        self,
        function: Callable[[Parameters, Array], StateSpace],
        parameters: ArrayLike | Sequence[float],
        parameter_names: Sequence[str],
        *,
        kappa_low: ArrayLike | Sequence[float],
        kappa_high: ArrayLike | Sequence[float],
    ):
        self.function = function
        self.parameters = jnp.asarray(parameters, float)
        self.parameter_names = tuple(parameter_names)
        self.kappa_low, self.kappa_high = (
            tuple(float(end) for end in np.atleast_1d(np.asarray(ends, float)))
            for ends in (kappa_low, kappa_high)
        )
        if self.parameters.shape != (len(self.parameter_names),):
            raise ValueError(
                f"parameter_names: {len(self.parameter_names)} given for parameters of shape "
                f"{self.parameters.shape}; one name a parameter is needed."
            )
        if len(self.kappa_low) != len(self.kappa_high) or any(
            low > high for low, high in zip(self.kappa_low, self.kappa_high, strict=True)
        ):
            raise ValueError(
                f"kappa_low, kappa_high: {self.kappa_low} and {self.kappa_high} are no range; give "
                "one lower and one upper end for each scheduling variable."
            )

    @property
    def lpv(self) -> LPVStateSpace:
        """The same as an `LPVStateSpace`, to freeze, discretise and connect."""
        count, size = len(self.kappa_low), len(self.parameter_names)
        # ϑ(κ) = (κ, p): the basis is 1 and every κ as it is.
        units = np.eye(count, dtype=int)
        exponents = ((0,) * count, *(tuple(int(power) for power in row) for row in units))
        basis = PolynomialBasis(jnp.zeros(count), jnp.ones(count), exponents)
        coefficients = jnp.zeros((1 + count, count + size))
        coefficients = coefficients.at[0, count:].set(self.parameters)
        coefficients = coefficients.at[1:, :count].set(jnp.eye(count))
        return LPVStateSpace(
            ScheduledStructure(self.function, self.parameter_names, count),
            basis,
            coefficients,
            jnp.asarray(self.kappa_low),
            jnp.asarray(self.kappa_high),
        )

    @property
    def nx(self) -> int:
        """Number of states."""
        return self.lpv.nx

    def at(self, kappa: Numbers) -> StateSpace:
        """The model frozen at κ, see `LPVStateSpace.at`."""
        return self.lpv.at(kappa)

    def is_stable(self, kappa: Numbers) -> Array:
        """Whether the frozen model is stable, see `LPVStateSpace.is_stable`."""
        return self.lpv.is_stable(kappa)

    def simulate(
        self,
        *,
        u: Numbers,
        kappa: Numbers,
        dt: float | None = None,
        x0: Numbers | None = None,
        hold: AbstractScheduleHold | None = None,
    ) -> Float[Array, "*batch time output"]:
        """Response to an input along a schedule, see `LPVStateSpace.simulate`."""
        options: dict[str, Any] = {"dt": dt, "x0": x0, "hold": hold}
        return self.lpv.simulate(u=u, kappa=kappa, **options)
