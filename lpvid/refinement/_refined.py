"""The record that a refinement returns."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid._results import Status, is_successful
from lpvid.refinement._search import Task


class Refined(eqx.Module):
    """A model fitted to records, and how sure one can be of it.

    Attributes:
        model: of the kind that was given (a `StateSpace` for a `Fit`).
        parameters: every value of the model, fixed ones too.
        parameter_names: one for each.
        covariance: of the parameters, for white noise. A black box's has the rank of what can be
            told: changes of the state's basis are left out, so that functions that do not depend
            on the basis (poles, responses) get the right variance by
            `lpvid.analysis.propagate(function, parameters, covariance)`.
        robust_covariance: the same for noise of any colour that is independent of the input.
        x0: initial states, (record, nx).
        output_offset: constant to add to the model's outputs, (ny,), or (record, ny) where each
            record has its own; one of the parameters where it is estimated, None where there is
            none.
        innovation_gain: K, (nx, ny), constant along moving schedules too; None where it was not
            estimated.
        noise_covariance: of the residual, corrected for the unknowns estimated, (ny, ny).
        residual: y − ŷ, records one after the other as in the data, (time, ny).
        cost: the loss; of `SquaredLoss` a negative log likelihood up to a constant.
        initial_cost: the loss at the start.
        status: how it ended; `advice` says it with the parameters' names.
        stats: arrays by name: `steps`, `degrees_of_freedom` (unknowns estimated), `unidentified`
            and `at_bound`, (parameter,), `largest_gap` between the pieces of a shooting search
            (over the root mean square of the state there; zero without).
        task: what was fitted, for `profile_likelihood`.
    """

    model: Any
    parameters: Float[Array, " parameter"]
    parameter_names: tuple[str, ...] = eqx.field(static=True)
    covariance: Float[Array, "parameter parameter"]
    robust_covariance: Float[Array, "parameter parameter"]
    x0: Float[Array, "record nx"]
    output_offset: Float[Array, "*record ny"] | None
    innovation_gain: Float[Array, "nx ny"] | None
    noise_covariance: Float[Array, "ny ny"]
    residual: Float[Array, "time ny"]
    cost: Float[Array, ""]
    initial_cost: Float[Array, ""]
    status: Status
    stats: dict[str, Array]
    task: Task

    def model_at(self, parameters: Float[Array, " parameter"]) -> Any:
        """The model at other parameters; differentiable."""
        return self.task.parameterisation.build(parameters)

    @property
    def standard_errors(self) -> Float[Array, " parameter"]:
        """Square roots of the covariance's diagonal, infinite for unidentified parameters."""
        return self._errors(self.covariance)

    def _errors(self, covariance: Array) -> Array:
        variance = jnp.maximum(jnp.diagonal(covariance), 0.0)
        return jnp.where(self.stats["unidentified"], jnp.inf, jnp.sqrt(variance))

    def confidence_intervals(
        self, level: float = 0.95, *, robust: bool = False
    ) -> Float[Array, "parameter 2"]:
        """Lower and upper ends of each parameter's interval, from a normal distribution.

        Fixed parameters and those at a bound get an interval of no width, unidentified ones an
        infinite one.

        Args:
            level: share of intervals that contain the truth, between 0 and 1.
            robust: for noise of any colour.

        Raises:
            ValueError: the level is not between 0 and 1.
        """
        if not 0.0 < level < 1.0:
            raise ValueError(f"level: a share between 0 and 1 is needed, got {level}.")
        errors = self._errors(self.robust_covariance if robust else self.covariance)
        reach = jax.scipy.stats.norm.ppf(0.5 + 0.5 * level) * errors
        return jnp.stack([self.parameters - reach, self.parameters + reach], axis=1)

    @property
    def advice(self) -> str:
        """What happened and what to do about it, with the parameters' names."""
        text = Status[self.status]
        for name, what in (("at_bound", "At a bound"), ("unidentified", "Not identified")):
            flagged = np.flatnonzero(np.asarray(self.stats[name]))
            if flagged.size and not bool(is_successful(self.status)):
                listed = ", ".join(self.parameter_names[i] for i in flagged)
                text = f"{text} {what}: {listed}."
        return text
