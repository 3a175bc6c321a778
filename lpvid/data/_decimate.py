"""Every n-th sample, after what would alias has been filtered out."""

import functools
from typing import Any

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

# Half the filter's length, in samples after decimation: with a Kaiser window, 80 dB from 0.8 to
# 1.0 times the new Nyquist frequency.
_REACH = 26


class Decimate(AbstractStep):
    """Keep every `factor`-th sample of inputs, outputs and scheduling, after a low-pass filter.

    The filter has no phase and leaves 80 dB below what would alias. It is a symmetric FIR filter
    (Kaiser window; pass band to 0.8, stop band from 1.0 of the new Nyquist frequency; ripple 1e-4),
    run over each record extended by point reflection at its ends: constants and straight lines pass
    unchanged. The first sample of a record stays its first. Inputs and outputs are filtered alike;
    an input that was held between samples is not held any more, so identify at a rate well above
    the dynamics. Not differentiable.

    Attributes:
        factor: one sample in so many is kept.

    Raises:
        ValueError: a factor below 1; when applied, a record not longer than 27 samples after
            decimation, and tracers.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import Decimate, IOData, preprocess
        >>> ramp = np.arange(200.0)
        >>> slow, undo = preprocess(IOData(u=ramp, y=ramp, dt=0.01), Decimate(4))
        >>> slow
        IOData(50 samples, 1 input (u1), 1 output (y1), dt=0.04 s)
        >>> undo(slow).n_samples
        200
    """

    factor: int = eqx.field(static=True)

    def __check_init__(self):
        if self.factor < 1:
            raise ValueError(f"Decimate: factor is {self.factor}: give an integer of 1 or more.")

    def apply(self, data: IOData) -> tuple[IOData, "DecimateReversal"]:
        """Data at the lower rate, and what is lost by interpolating back.

        Raises:
            ValueError: a record too short for the filter, or tracers.
        """
        shortest = min(data.lengths)
        if shortest <= (_REACH + 1) * self.factor:
            raise ValueError(
                f"Decimate: the shortest record has {shortest} samples, but factor {self.factor} "
                f"needs more than {(_REACH + 1) * self.factor}; lower the factor."
            )
        low, removed = {}, {}
        for key, signal in (("u", data.u), ("y", data.y), ("kappa", data.kappa)):
            if signal is None:
                low[key] = removed[key] = None
                continue
            samples = to_numpy(signal, self)
            pieces = split_records(samples, data.lengths)
            low[key] = [_decimated(piece, self.factor) for piece in pieces]
            back = [
                _interpolated(piece, self.factor, length)
                for piece, length in zip(low[key], data.lengths, strict=True)
            ]
            removed[key] = jnp.asarray(samples - np.concatenate(back))
        processed = IOData(**low, dt=data.dt * self.factor, names=data.names, units=data.units)
        reversal = DecimateReversal(
            self, removed["u"], removed["y"], removed["kappa"], self.factor, data.dt, data.lengths
        )
        return processed, reversal


class DecimateReversal(AbstractReversal):
    """Original minus interpolated signals, and the original rate.

    Attributes:
        step: the step that is undone.
        u_removed: what the inputs lost.
        y_removed: what the outputs lost.
        kappa_removed: what the scheduling lost.
        factor: one sample in so many was kept.
        dt: original sample time in seconds.
        lengths: original lengths of the records.
    """

    step: AbstractStep
    u_removed: Float[Array, "time nu"]
    y_removed: Float[Array, "time ny"]
    kappa_removed: Float[Array, "time nk"] | None
    factor: int = eqx.field(static=True)
    dt: float = eqx.field(static=True)
    lengths: tuple[int, ...] = eqx.field(static=True)

    def restore(self, data: IOData) -> IOData:
        """Data at the original rate, with what decimation lost."""
        channels = (self.u_removed.shape[1], self.y_removed.shape[1])
        check_restorable(data, self._low_lengths(), channels, self.step)
        kappa = None
        if self.kappa_removed is not None and data.kappa is not None:
            kappa = self._interpolate(data.kappa) + self.kappa_removed
        return IOData(
            u=split_records(self._interpolate(data.u) + self.u_removed, self.lengths),
            y=split_records(self._interpolate(data.y) + self.y_removed, self.lengths),
            kappa=None if kappa is None else split_records(kappa, self.lengths),
            dt=self.dt,
            names=data.names,
            units=data.units,
        )

    def output(self, y: Float[Array, "_ ny"], trend: bool) -> Float[Array, "_ ny"]:
        """The output interpolated to the original rate, band-limited."""
        del trend
        check_output(y, self._low_lengths(), self.y_removed.shape[1], self.step)
        return self._interpolate(y)

    def _low_lengths(self) -> tuple[int, ...]:
        return tuple(-(-length // self.factor) for length in self.lengths)

    def _interpolate(self, signal: Float[Array, "_ channel"]) -> Float[Array, "_ channel"]:
        pieces = split_records(to_numpy(signal, self.step), self._low_lengths())
        back = [
            _interpolated(piece, self.factor, length)
            for piece, length in zip(pieces, self.lengths, strict=True)
        ]
        return jnp.asarray(np.concatenate(back))


@functools.cache
def _taps(factor: int) -> np.ndarray:
    window: Any = ("kaiser", scipy.signal.kaiser_beta(80.0))
    taps = np.array(scipy.signal.firwin(2 * _REACH * factor + 1, 0.9 / factor, window=window))
    taps.flags.writeable = False
    return taps


@functools.cache
def _interpolation_taps(factor: int) -> np.ndarray:
    taps = np.array(_taps(factor))
    # Each sample between two kept ones is a mean with its own weights: they must add up to one,
    # or a constant would come back rippled by the stop band's 1e-4.
    for phase in range(factor):
        taps[phase::factor] /= taps[phase::factor].sum()
    taps.flags.writeable = False
    return taps


def _decimated(signal: np.ndarray, factor: int) -> np.ndarray:
    if factor == 1:
        return signal
    extended = _extended(signal, _REACH * factor)
    # With the reflected ends cut off again, output k is centred on sample k * factor.
    filtered = scipy.signal.upfirdn(_taps(factor), extended, down=factor, axis=0)
    start = 2 * _REACH
    return filtered[start : start + -(-len(signal) // factor)]


def _interpolated(signal: np.ndarray, factor: int, length: int) -> np.ndarray:
    if factor == 1:
        return signal
    extended = _extended(signal, _REACH)
    filtered = scipy.signal.upfirdn(_interpolation_taps(factor), extended, up=factor, axis=0)
    start = 2 * _REACH * factor
    return filtered[start : start + length]


def _extended(signal: np.ndarray, samples: int) -> np.ndarray:
    """Both ends continued by point reflection, so that offset and slope go on."""
    head = 2 * signal[:1] - signal[samples:0:-1]
    tail = 2 * signal[-1:] - signal[-2 : -samples - 2 : -1]
    return np.concatenate([head, signal, tail])
