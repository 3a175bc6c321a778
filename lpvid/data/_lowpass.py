"""Noise above a cutoff taken out of inputs and outputs alike."""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy  # its parts load when first used
from jaxtyping import Array, Float

from lpvid.data._io_data import IOData
from lpvid.data._preprocess import (
    AbstractReversal,
    AbstractStep,
    check_output,
    check_restorable,
    to_numpy,
)
from lpvid.data._signals import split_records


class Lowpass(AbstractStep):
    """Butterworth low-pass of inputs and outputs alike, so that a linear plant stays what it was.

    Run forwards and backwards over each record (`scipy.signal.sosfiltfilt`): no delay, and twice
    the attenuation, -6 dB at `cutoff_hz`. The scheduling keeps its values. Not differentiable.

    Attributes:
        cutoff_hz: cutoff frequency in Hz.
        order: order of the filter that is run twice.

    Raises:
        ValueError: a cutoff that is not positive, an order below 1; when applied, a cutoff not
            below the Nyquist frequency, a record too short for the filter, and tracers.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData, Lowpass, preprocess
        >>> t = 0.01 * np.arange(400)
        >>> slow, fast = np.sin(2 * np.pi * t), np.sin(2 * np.pi * 40 * t)
        >>> clean, undo = preprocess(IOData(u=slow, y=slow + fast, dt=0.01), Lowpass(10.0))
        >>> bool(np.abs(clean.y - clean.u)[50:-50].max() < 1e-3)
        True
    """

    cutoff_hz: float = eqx.field(static=True)
    order: int = eqx.field(static=True, default=4)

    def __check_init__(self):
        if not (math.isfinite(self.cutoff_hz) and self.cutoff_hz > 0):
            raise ValueError(f"Lowpass: cutoff_hz is {self.cutoff_hz}: give a positive frequency.")
        if self.order < 1:
            raise ValueError(f"Lowpass: order is {self.order}: give 1 or more.")

    def apply(self, data: IOData) -> tuple[IOData, "LowpassReversal"]:
        """Filtered data, and what the filter took out.

        Raises:
            ValueError: a cutoff not below the Nyquist frequency, a record too short for the filter,
                or tracers.
        """
        nyquist = 0.5 / data.dt
        if self.cutoff_hz >= nyquist:
            raise ValueError(
                f"Lowpass: cutoff_hz={self.cutoff_hz:g} is not below the Nyquist frequency "
                f"{nyquist:g} Hz of dt={data.dt:g} s; lower it."
            )
        sections = np.asarray(
            scipy.signal.butter(self.order, self.cutoff_hz / nyquist, output="sos")
        )
        u, y = self._filter(data.u, data, sections), self._filter(data.y, data, sections)
        u_removed = jnp.asarray(to_numpy(data.u, self) - u)
        y_removed = jnp.asarray(to_numpy(data.y, self) - y)
        reversal = LowpassReversal(self, u_removed, y_removed, data.lengths)
        return data.replace(u=u, y=y), reversal

    def _filter(
        self, signal: Float[Array, "time channel"], data: IOData, sections: np.ndarray
    ) -> np.ndarray:
        # SciPy's own default is this or a little less; asked for, so that it can be checked.
        padding = 3 * (2 * len(sections) + 1)
        if min(data.lengths) <= padding:
            raise ValueError(
                f"Lowpass: the shortest record has {min(data.lengths)} samples, but order "
                f"{self.order} needs more than {padding}; lower the order."
            )
        samples = split_records(to_numpy(signal, self), data.lengths)
        filtered = [
            scipy.signal.sosfiltfilt(sections, piece, axis=0, padlen=padding) for piece in samples
        ]
        return np.concatenate(filtered)


class LowpassReversal(AbstractReversal):
    """What the filter took out, sample by sample.

    Attributes:
        step: the step that is undone.
        u_removed: what the inputs lost.
        y_removed: what the outputs lost.
        lengths: lengths of the records.
    """

    step: AbstractStep
    u_removed: Float[Array, "time nu"]
    y_removed: Float[Array, "time ny"]
    lengths: tuple[int, ...] = eqx.field(static=True)

    def restore(self, data: IOData) -> IOData:
        """Data with what the filter took out."""
        channels = (self.u_removed.shape[1], self.y_removed.shape[1])
        check_restorable(data, self.lengths, channels, self.step)
        return data.replace(u=data.u + self.u_removed, y=data.y + self.y_removed)

    def output(self, y: Float[Array, "_ ny"], trend: bool) -> Float[Array, "_ ny"]:
        """The output as it is: what the filter took out is not for a model to know."""
        del trend
        check_output(y, self.lengths, self.y_removed.shape[1], self.step)
        return y
