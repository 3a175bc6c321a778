"""A structure together with its parameters."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from lpvid.models._state_space import Numbers, StateSpace
from lpvid.models._structures import AbstractStructure


class StructuredModel(eqx.Module):
    """A structured model: a structure and its ϑ, in continuous time.

    Attributes:
        structure: ϑ → (A, B, C, D).
        parameters: ϑ, one value for each of `structure.parameter_names`.

    Raises:
        ValueError: the number of parameters is not the structure's.

    Example:
        >>> from lpvid.models import MechanicalStructure
        >>> StructuredModel(MechanicalStructure(n_degrees=1), [0.0, 0.0, 0.0]).state_space.nx
        2
    """

    structure: AbstractStructure
    parameters: Float[Array, " parameter"]

    def __init__(self, structure: AbstractStructure, parameters: ArrayLike | Numbers):
        self.structure = structure
        self.parameters = jnp.asarray(parameters, float)
        if self.parameters.shape != (structure.n_parameters,):
            raise ValueError(
                f"parameters: the structure has {structure.n_parameters}, one value for each of "
                f"parameter_names; got shape {self.parameters.shape}."
            )

    @property
    def state_space(self) -> StateSpace:
        """The continuous-time model at these parameters."""
        return self.structure.matrices(self.parameters)

    def simulate(
        self, *, u: Numbers, dt: float, x0: Numbers | None = None
    ) -> Float[Array, "*batch time ny"]:
        """Response to an input held over samples of `dt` seconds; see `StateSpace.simulate`."""
        return self.state_space.simulate(u=u, x0=x0, dt=dt)
