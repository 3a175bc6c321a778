"""A constant in each output, estimated with the model: the zero of a sensor that nobody knows."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float

from lpvid.identify import Fit
from lpvid.refinement._parameterisation import AbstractParameterisation, Record, Values
from lpvid.refinement._refined import Refined


class WithOffset(AbstractParameterisation):
    """A model's values, then one constant for each output, common to all records.

    Attributes:
        model: the parameterisation of the model itself.
        reference: constants that were taken out of the records beforehand, so that what is left
            of a large one is not lost in rounding.
        units: sizes of the outputs.
    """

    model: AbstractParameterisation
    reference: Float[Array, " ny"]
    units: Float[Array, " ny"]

    def _parts(self, values: Values) -> tuple[Array, Array]:
        count = self.reference.shape[0]
        return values[:-count], values[-count:]

    @property
    def names(self) -> tuple[str, ...]:
        """The model's names, then `offset[k]`."""
        return (*self.model.names, *(f"offset[{k}]" for k in range(self.reference.shape[0])))

    @property
    def n_states(self) -> int:
        """Of the model."""
        return self.model.n_states

    @property
    def scale(self) -> Values:
        """Sizes of the values."""
        return jnp.concatenate([self.model.scale, self.units])

    @property
    def overlap(self) -> int:
        """Of the model."""
        return self.model.overlap

    def bounds(self) -> tuple[Values, Values]:
        """The model's; the constants are free."""
        lower, upper = self.model.bounds()
        free = jnp.full_like(self.reference, jnp.inf)
        return jnp.concatenate([lower, -free]), jnp.concatenate([upper, free])

    def prepare(self, values: Values) -> Any:
        """What the model prepares, and what is left of the constants in the records."""
        own, offset = self._parts(values)
        return self.model.prepare(own), offset - self.reference

    def forgets(self, prepared: Any) -> Bool[Array, ""]:
        """As the model says."""
        return self.model.forgets(prepared[0])

    def respond(self, prepared: Any, record: Record, x0: Array) -> Float[Array, "time ny"]:
        """The model's output for a record without the constant, and the constant."""
        model, rest = prepared
        return self.model.respond(model, _without(record, rest), x0) + rest[None]

    def shoot(
        self, prepared: Any, record: Record, x0: Array, size: int
    ) -> tuple[Float[Array, "time ny"], Float[Array, " row"], Float[Array, " row"]]:
        """The same of a piece; its ends meet without the constant."""
        model, rest = prepared
        y, first, last = self.model.shoot(model, _without(record, rest), x0, size)
        return y + rest[None], first, last

    def build(self, values: Values) -> Any:
        """The model without the constants."""
        return self.model.build(self._parts(values)[0])

    def gauge(self, values: Values) -> Float[Array, "value direction"] | None:
        """The model's; no change of basis moves the constants."""
        directions = self.model.gauge(self._parts(values)[0])
        if directions is None:
            return None
        still = jnp.zeros((self.reference.shape[0], directions.shape[1]))
        return jnp.concatenate([directions, still])

    def innovation_gain(self, values: Values) -> Float[Array, "nx ny"] | None:
        """The model's K."""
        return self.model.innovation_gain(self._parts(values)[0])

    def output_offset(self, values: Values) -> Float[Array, " ny"]:
        """The constants."""
        return self._parts(values)[1]


def _without(record: Record, rest: Float[Array, " ny"]) -> Record:
    return Record(record.u, record.y - rest[None], record.kappa)


def starting_offset(
    model: Any, given: str | ArrayLike | None, y: Float[Array, "time ny"]
) -> tuple[Float[Array, " ny"] | None, bool]:
    """The outputs' constants to begin with, and whether they are estimated.

    Raises:
        ValueError: `given` is none of what `refine` takes.
    """
    found = getattr(model, "output_offset", None)
    if given is None:
        return found, _was_estimated(model)
    if isinstance(given, str):
        if given != "free":
            raise ValueError(
                f"output_offset={given!r}: give 'free', constants (ny,), or None for what the fit "
                "that is refined did."
            )
        # From the mean: a slow model would take what is left of a large constant for its own.
        return (found if _was_estimated(model) else jnp.mean(y, axis=0)), True
    known = jnp.asarray(given, float)
    if known.shape != y.shape[1:]:
        raise ValueError(f"output_offset: shape {known.shape} given; {y.shape[1:]} is needed.")
    return known, False


def taken_out(refined: Refined) -> Float[Array, " ny"] | None:
    """The constants that were taken out of the records before they were fitted."""
    kind = refined.task.parameterisation
    return kind.reference if isinstance(kind, WithOffset) else refined.output_offset


def _was_estimated(model: Any) -> bool:
    """Said by the fit, so that it is known under jit too."""
    if isinstance(model, Fit):
        return model.moments is not None and model.moments.offset
    if not isinstance(model, Refined) or not isinstance(model.task.parameterisation, WithOffset):
        return False
    # One that was held is held again.
    chosen = model.task.selection.matrix[-model.task.parameterisation.reference.shape[0] :]
    return isinstance(chosen, Tracer) or bool(np.any(np.asarray(chosen) > 0.0))
