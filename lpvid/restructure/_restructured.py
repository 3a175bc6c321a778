"""What a restructuring returns."""

import equinox as eqx
import jax
from jaxtyping import Array, Float, Int

from lpvid._results import Status
from lpvid.models import AbstractStructure, StateSpace
from lpvid.restructure._certificate import Certificate
from lpvid.restructure._identifiability import identifiability


class Restructured(eqx.Module):
    """A structured model and how sure one can be of it.

    Attributes:
        structure: the structure it was matched in.
        parameters: ϑ, in the order of `structure.parameter_names`.
        error_norm: ‖G(ϑ) − G_i‖∞ (L∞ where a pole is unstable).
        peak_frequency: where the norm is reached, rad/s.
        match_costs: least-squares cost that each start ended with, sorted. Where the structure is
            searched in another parameterisation, these are the starts of its start rule.
        hits: how many of them ended in the best minimum: one cost and one model.
        margin: cost of the next distinct minimum over the best one (infinite where there is none).
        history: norm before the surrogate stage, after each of its passes, and after the
            non-smooth stage.
        status: `successful`, or what is wrong: `uncertified` where the non-smooth stage ended
            without its certificate, a `poor_match`, an L∞ norm, or `nonfinite`.
        minima: how many distinct minima the starts ended in (those that converged); None for a
            result that no search made.
        certificate: of the minimum; None where the non-smooth stage was left out.
        omega: the frequencies that it was matched at; None where those are all.
        fixed: names of the parameters that were given.
        tied: names of those that share one value, a tuple for each group.
    """

    structure: AbstractStructure
    parameters: Float[Array, "*batch parameter"]
    error_norm: Float[Array, "*batch"]
    peak_frequency: Float[Array, "*batch"]
    match_costs: Float[Array, "*batch start"]
    hits: Int[Array, "*batch"]
    margin: Float[Array, "*batch"]
    history: Float[Array, "*batch pass"]
    status: Status
    minima: Int[Array, "*batch"] | None = None
    certificate: Certificate | None = None
    omega: Float[Array, "*batch frequency"] | None = None
    fixed: tuple[str, ...] = eqx.field(static=True, default=())
    tied: tuple[tuple[str, ...], ...] = eqx.field(static=True, default=())

    @property
    def model(self) -> StateSpace:
        """The structured model."""
        build = self.structure.matrices
        for _ in range(self.parameters.ndim - 1):
            build = jax.vmap(build)
        return build(self.parameters)

    @property
    def cost(self) -> Float[Array, "*batch"]:
        """F(ϑ) = ‖G(ϑ) − G_i‖∞² (001, equation 6)."""
        return self.error_norm**2

    @property
    def unidentifiable(self) -> tuple[str, ...]:
        """Names of parameters that the response at `omega` does not tell, with what was given.

        `identifiability` says which combinations.
        """
        seen = identifiability(
            self.structure,
            self.parameters,
            omega=self.omega,
            fixed=self.fixed,
            tied=self.tied,
        )
        return seen.names
