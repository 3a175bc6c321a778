"""A structure with some parameters fixed, tied or bounded: the same structure of fewer."""

from collections.abc import Mapping
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from lpvid.models import AbstractStructure, StateSpace
from lpvid.refinement import Selection, Ties, matching, select
from lpvid.restructure._restructured import Restructured


class ConstrainedStructure(AbstractStructure):
    """A structure as a function of the parameters that are neither fixed nor tied to others.

    Attributes:
        structure: the structure itself.
        selection: its parameters from the chosen ones.
        lower: lower bounds of all its parameters.
        upper: upper bounds.
        members: indices of the parameters that each chosen one stands for, without those that
            bounds leave one value.
    """

    structure: AbstractStructure
    selection: Selection
    lower: Float[Array, " parameter"]
    upper: Float[Array, " parameter"]
    members: tuple[tuple[int, ...], ...] = eqx.field(static=True)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Numbers: of tied parameters no name is the right one."""
        return tuple(f"free {index + 1}" for index in range(self.selection.matrix.shape[1]))

    def matrices(self, parameters: Float[Array, " chosen"]) -> StateSpace:
        """The structure's model."""
        return self.structure.matrices(self.selection.values(parameters))

    def bounds(self) -> tuple[Float[Array, " chosen"], Float[Array, " chosen"]]:
        """The narrowest bounds of what is tied."""
        member = self.selection.matrix > 0.0
        lower = jnp.max(jnp.where(member, self.lower[:, None], -jnp.inf), axis=0)
        return lower, jnp.min(jnp.where(member, self.upper[:, None], jnp.inf), axis=0)

    def search_structure(self) -> AbstractStructure | None:
        """The structure's own, which knows of no constraint."""
        return self.structure.search_structure()

    def from_search(self, parameters: Float[Array, " searched"]) -> Float[Array, " chosen"]:
        """What is left of a vector of the search parameterisation."""
        return self.reduced(self.structure.from_search(parameters))

    def reduced(self, parameters: Float[Array, " parameter"]) -> Float[Array, " chosen"]:
        """The chosen ones of all parameters, of tied ones the mean, within their bounds."""
        return jnp.clip(self.selection.chosen(parameters), *self.bounds())

    def restored(self, found: Restructured) -> Restructured:
        """The result in the structure's own parameters."""
        matrix, certificate = self.selection.matrix, found.certificate
        names, members = self.structure.parameter_names, self.members
        free = {index for group in members for index in group}
        if certificate is not None:
            certificate = replace(
                certificate,
                at_bound=matrix @ certificate.at_bound.astype(float) > 0.0,
                scaling=matrix @ certificate.scaling,
            )
        return replace(
            found,
            structure=self.structure,
            parameters=self.selection.values(found.parameters),
            certificate=certificate,
            fixed=tuple(name for index, name in enumerate(names) if index not in free),
            tied=tuple(tuple(names[k] for k in group) for group in members if len(group) > 1),
        )


def constrain(
    structure: AbstractStructure,
    bounds: Mapping[str, tuple[float, float]] | None,
    fixed: Mapping[str, float] | None,
    tied: Ties,
) -> ConstrainedStructure | None:
    """Read the constraints; None where there are none.

    Raises:
        ValueError: a pattern matches nothing, bounds are in the wrong order, exclude each other or
            name a fixed parameter, or nothing is left to search.
    """
    if not bounds and not fixed and not tied:
        return None
    if fixed is not None and not isinstance(fixed, Mapping):
        raise ValueError("fixed: give values by name, such as {'mass *': 1.0}.")
    names = structure.parameter_names
    values = np.zeros(len(names))
    for pattern, value in (fixed or {}).items():
        values[matching(names, pattern, "fixed")] = float(value)
    selection = select(names, jnp.asarray(values), tuple(fixed or ()), tied)
    lower, upper = structure.bounds()
    single: set[int] = set()
    for pattern, ends in (bounds or {}).items():
        low, high = (float(end) for end in ends)
        rows = matching(names, pattern, "bounds")
        if not low <= high:
            raise ValueError(f"bounds[{pattern!r}]: {low} lies above {high}.")
        if not np.all(np.any(np.asarray(selection.matrix)[rows] > 0.0, axis=1)):
            raise ValueError(
                f"bounds[{pattern!r}]: names a parameter that is fixed; leave one of the two out."
            )
        single = single.difference(rows).union(rows if low == high else ())
        at = jnp.asarray(rows)
        lower, upper = lower.at[at].set(low), upper.at[at].set(high)
    columns = [np.flatnonzero(column).tolist() for column in np.asarray(selection.matrix).T]
    members = tuple(tuple(group) for group in columns if not single.intersection(group))
    constrained = ConstrainedStructure(structure, selection, lower, upper, members)
    low, high = constrained.bounds()
    if not isinstance(low, Tracer) and not np.all(np.asarray(low) <= np.asarray(high)):
        raise ValueError("bounds, tied: no value is left for parameters that share one.")
    return constrained
