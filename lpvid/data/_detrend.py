"""Means or straight lines taken out of inputs and outputs."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lpvid.data._io_data import IOData
from lpvid.data._preprocess import AbstractReversal, AbstractStep, check_output, check_restorable


class Detrend(AbstractStep):
    """Take the mean or the straight line of each channel out of inputs and outputs.

    Each record has its own trend, estimated by least squares. The scheduling keeps its values.
    Differentiable.

    Attributes:
        order: 0 for the mean, 1 for a straight line.

    Raises:
        ValueError: another order.

    Example:
        >>> from lpvid.data import Detrend, IOData, preprocess
        >>> data = IOData(u=[1.0, 3.0], y=[5.0, 9.0], dt=0.1)
        >>> moving, undo = preprocess(data, Detrend())
        >>> moving.y[:, 0].tolist(), undo(moving).y[:, 0].tolist()
        ([-2.0, 2.0], [5.0, 9.0])
    """

    order: int = eqx.field(static=True, default=0)

    def __check_init__(self):
        if self.order not in (0, 1):
            raise ValueError(f"Detrend: order is {self.order}: 0 is the mean, 1 a straight line.")

    def apply(self, data: IOData) -> tuple[IOData, "DetrendReversal"]:
        """Data without its trends, and the trends."""
        trends = [
            (_trend(record.u, self.order), _trend(record.y, self.order)) for record in data.records
        ]
        u_trend = jnp.concatenate([u for u, _ in trends])
        y_trend = jnp.concatenate([y for _, y in trends])
        reversal = DetrendReversal(self, u_trend, y_trend, data.lengths)
        return data.replace(u=data.u - u_trend, y=data.y - y_trend), reversal


class DetrendReversal(AbstractReversal):
    """The trends that were taken out, sample by sample.

    Attributes:
        step: the step that is undone.
        u_trend: trends of the inputs.
        y_trend: trends of the outputs.
        lengths: lengths of the records they were taken out of.
    """

    step: AbstractStep
    u_trend: Float[Array, "time nu"]
    y_trend: Float[Array, "time ny"]
    lengths: tuple[int, ...] = eqx.field(static=True)

    def restore(self, data: IOData) -> IOData:
        """Data with its trends."""
        channels = (self.u_trend.shape[1], self.y_trend.shape[1])
        check_restorable(data, self.lengths, channels, self.step)
        return data.replace(u=data.u + self.u_trend, y=data.y + self.y_trend)

    def output(self, y: Float[Array, "_ ny"], trend: bool) -> Float[Array, "_ ny"]:
        """Output with its trend, if wanted."""
        check_output(y, self.lengths, self.y_trend.shape[1], self.step)
        return y + self.y_trend if trend else y


def _trend(signal: Float[Array, "time channel"], order: int) -> Float[Array, "time channel"]:
    mean = jnp.broadcast_to(jnp.mean(signal, axis=0, keepdims=True), signal.shape)
    if order == 0:
        return mean
    # Time from -1 to 1 is orthogonal to the constant: the two coefficients decouple.
    time = jnp.linspace(-1.0, 1.0, signal.shape[0])
    slope = time @ signal / (time @ time)
    return mean + time[:, None] * slope[None, :]
