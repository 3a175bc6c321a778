"""Means or straight lines taken out of inputs and outputs."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lpvid.data._io_data import IOData
from lpvid.data._preprocess import AbstractReversal, AbstractStep, check_output, check_restorable


class Detrend(AbstractStep):
    """Take the mean (`order=0`) or the least-squares line (`order=1`) out of each channel of `u`
    and `y`, in each record on its own. `kappa` keeps its values. Differentiable.

    **Raises:** `ValueError` for another order.
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
    """The trends that were taken out, sample by sample."""

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
