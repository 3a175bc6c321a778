"""Known constants taken out of inputs and outputs."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.data._io_data import IOData
from lpvid.data._preprocess import AbstractReversal, AbstractStep, check_output, check_restorable


class Offset(AbstractStep):
    """Take given constants out of each channel of inputs and outputs, record by record.

    `Detrend` estimates its means on whatever it is applied to; this step keeps those it was made
    with, so that what is learned on training data alone is taken out of test data too.

    Attributes:
        u: one value for each record and input.
        y: one value for each record and output.

    Example:
        >>> from lpvid.data import IOData, Offset, preprocess
        >>> data = IOData(u=[1.0, 3.0, 4.0, 4.0], y=[5.0, 9.0, 8.0, 8.0], dt=0.1)
        >>> train, test = data.split(0.5)
        >>> clean, undo = preprocess(train, Offset.mean_of(train))
        >>> clean_test, _ = preprocess(test, *undo.steps)
        >>> clean_test.y[:, 0].tolist()
        [1.0, 1.0]
    """

    u: Float[Array, "record nu"]
    y: Float[Array, "record ny"]

    @classmethod
    def mean_of(cls, data: IOData) -> "Offset":
        """The mean of each channel in each record."""
        return cls(
            u=jnp.stack([jnp.mean(record.u, axis=0) for record in data.records]),
            y=jnp.stack([jnp.mean(record.y, axis=0) for record in data.records]),
        )

    def apply(self, data: IOData) -> tuple[IOData, "OffsetReversal"]:
        """Data without the offsets.

        Raises:
            ValueError: `data` has another number of records or channels than the offsets.
        """
        wanted = (len(data.lengths), data.nu, data.ny)
        given = (self.u.shape[0], self.u.shape[1], self.y.shape[1])
        if wanted != given:
            raise ValueError(
                f"Offset: there are offsets for {given[0]} record(s), {given[1]} input(s) and "
                f"{given[2]} output(s), but the data have {wanted}; make them from data alike."
            )
        u, y = self._over_time(data.lengths)
        return data.replace(u=data.u - u, y=data.y - y), OffsetReversal(self, data.lengths)

    def _over_time(self, lengths: tuple[int, ...]) -> tuple[Array, Array]:
        record = np.repeat(np.arange(len(lengths)), lengths)
        return self.u[record], self.y[record]


class OffsetReversal(AbstractReversal):
    """The offsets, and the lengths of the records they were taken out of.

    Attributes:
        step: the step that is undone, which holds the offsets.
        lengths: lengths of the records.
    """

    # The offsets themselves are the step's.
    step: AbstractStep
    lengths: tuple[int, ...] = eqx.field(static=True)

    def restore(self, data: IOData) -> IOData:
        """Data with their offsets."""
        u, y = self._offsets()
        check_restorable(data, self.lengths, (u.shape[1], y.shape[1]), self.step)
        return data.replace(u=data.u + u, y=data.y + y)

    def output(self, y: Float[Array, "_ ny"], trend: bool) -> Float[Array, "_ ny"]:
        """Output with its offset, if wanted."""
        offset = self._offsets()[1]
        check_output(y, self.lengths, offset.shape[1], self.step)
        return y + offset if trend else y

    def _offsets(self) -> tuple[Array, Array]:
        assert isinstance(self.step, Offset)
        return self.step._over_time(self.lengths)
