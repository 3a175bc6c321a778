"""A constant in each output, estimated with the model: the zero of a sensor that nobody knows."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float

from lpvid.data import IOData, Offset
from lpvid.identify import Fit
from lpvid.refinement._parameterisation import AbstractParameterisation, Record, Values
from lpvid.refinement._refined import Refined

# Constants common to all records, or one row a record.
Constants = Float[Array, "*record ny"]


class WithOffset(AbstractParameterisation):
    """A model's values, then one constant for each output, common to all records or of each.

    Attributes:
        model: the parameterisation of the model itself.
        reference: constants that were taken out of the records beforehand, so that what is left
            of a large one is not lost in rounding; (ny,), or (record, ny) where each record has
            constants of its own.
        units: sizes of the outputs.
    """

    model: AbstractParameterisation
    reference: Constants
    units: Float[Array, " ny"]

    def _parts(self, values: Values) -> tuple[Array, Array]:
        count = self.reference.size
        return values[:-count], values[-count:].reshape(self.reference.shape)

    @property
    def names(self) -> tuple[str, ...]:
        """The model's names, then `offset[k]`, or `offset[r,k]` of every record r."""
        places = np.ndindex(self.reference.shape)
        return (*self.model.names, *(f"offset[{','.join(map(str, at))}]" for at in places))

    @property
    def n_states(self) -> int:
        """Of the model."""
        return self.model.n_states

    @property
    def scale(self) -> Values:
        """Sizes of the values."""
        units = jnp.broadcast_to(self.units, self.reference.shape)
        return jnp.concatenate([self.model.scale, units.reshape(-1)])

    @property
    def overlap(self) -> int:
        """Of the model."""
        return self.model.overlap

    def bounds(self) -> tuple[Values, Values]:
        """The model's; the constants are free."""
        lower, upper = self.model.bounds()
        free = jnp.full((self.reference.size,), jnp.inf)
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
        left = _of_record(rest, record)
        return self.model.respond(model, _without(record, left), x0) + left[None]

    def shoot(
        self, prepared: Any, record: Record, x0: Array, size: int
    ) -> tuple[Float[Array, "time ny"], Float[Array, " row"], Float[Array, " row"]]:
        """The same of a piece; its ends meet without the constant."""
        model, rest = prepared
        left = _of_record(rest, record)
        y, first, last = self.model.shoot(model, _without(record, left), x0, size)
        return y + left[None], first, last

    def build(self, values: Values) -> Any:
        """The model without the constants."""
        return self.model.build(self._parts(values)[0])

    def gauge(self, values: Values) -> Float[Array, "value direction"] | None:
        """The model's; no change of basis moves the constants."""
        directions = self.model.gauge(self._parts(values)[0])
        if directions is None:
            return None
        still = jnp.zeros((self.reference.size, directions.shape[1]))
        return jnp.concatenate([directions, still])

    def innovation_gain(self, values: Values) -> Float[Array, "nx ny"] | None:
        """The model's K."""
        return self.model.innovation_gain(self._parts(values)[0])

    def output_offset(self, values: Values) -> Constants:
        """The constants."""
        return self._parts(values)[1]


def _of_record(constants: Constants, record: Record) -> Float[Array, " ny"]:
    return constants if constants.ndim == 1 else constants[record.place]


def _without(record: Record, rest: Float[Array, " ny"]) -> Record:
    return Record(record.u, record.y - rest[None], record.kappa, record.place)


def without_constants(data: IOData, constants: Constants) -> IOData:
    """Records whose outputs have lost their constants.

    Raises:
        ValueError: constants of another number of records.
    """
    if constants.ndim == 1:
        return data.replace(y=data.y - constants[None])
    if constants.shape[0] != len(data.lengths):
        raise ValueError(
            f"output_offset: there are constants of {constants.shape[0]} records and "
            f"{len(data.lengths)} records; give as many as the fit was made from."
        )
    return data.replace(y=data.y - constants[np.repeat(range(len(data.lengths)), data.lengths)])


def starting_offset(
    model: Any, given: str | ArrayLike | None, data: IOData
) -> tuple[Constants | None, bool]:
    """The outputs' constants to begin with, and whether they are estimated.

    Raises:
        ValueError: `given` is none of what `refine` takes, or the fit that is refined has
            constants of other records.
    """
    found = getattr(model, "output_offset", None)
    estimated = _was_estimated(model)
    each = (len(data.lengths), data.ny)
    if given is None:
        if found is not None and found.ndim == 2 and found.shape != each:
            raise ValueError(
                f"output_offset: the fit that is refined has constants of {found.shape[0]} records "
                f"and {found.shape[1]} outputs, the data have {each[0]} and {each[1]}; say what "
                "these records' are: 'per record', 'free' or known constants."
            )
        return found, estimated
    if isinstance(given, str):
        if given not in ("free", "per record"):
            raise ValueError(
                f"output_offset={given!r}: give 'free', 'per record', constants (ny,) or (record, "
                "ny), or None for what the fit that is refined did."
            )
        # From the mean: a slow model would take what is left of a large constant for its own.
        mean = jnp.mean(data.y, axis=0)
        common = found if estimated and found is not None and found.ndim == 1 else mean
        if given == "free":
            return common, True
        if estimated and found is not None and found.shape == each:
            return found, True
        return Offset.mean_of(data).y + (common - mean)[None], True
    known = jnp.asarray(given, float)
    if known.shape not in (each[1:], each):
        raise ValueError(
            f"output_offset: shape {known.shape} given; {each[1:]}, or {each} for constants of "
            "each record, is needed."
        )
    return known, False


def taken_out(refined: Refined) -> Constants | None:
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
    chosen = model.task.selection.matrix[-model.task.parameterisation.reference.size :]
    return isinstance(chosen, Tracer) or bool(np.any(np.asarray(chosen) > 0.0))
