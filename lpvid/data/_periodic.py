"""Periodic records: one band of excited lines, at a lower rate, without leakage or filters."""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from lpvid.data._io_data import IOData
from lpvid.data._preprocess import (
    AbstractReversal,
    AbstractStep,
    check_output,
    check_restorable,
)
from lpvid.data._signals import Samples, split_records

# Share of the input's power that may differ from period to period; more than noise ever does.
_UNREPEATED = 0.1


class PeriodicBand(AbstractStep):
    """Keep one band of a periodic record and resample it, by cutting its discrete Fourier series.

    A response in steady state to a periodic input is a finite sum of harmonics: dropping those
    outside the band and writing the others on another number of samples is exact. There are no
    filter's edges and there is no leakage, and inputs and outputs are treated alike. What lay
    outside the band (noise, drift, distortion, the mean) is gone. `kappa` is resampled without
    the band. Works under `jit` and `vmap` and differentiates.

    An input that was held between samples is not held any more: identify at the new rate as a
    discrete-time model, then take its response at e^{jωT} (`restructure(..., omega=...)` does).

    Args:
        low_hz: lowest frequency kept; 0 keeps the mean.
        high_hz: highest frequency kept.
        samples_per_period: samples that the band is written on; as recorded when left out.
        periods: how often the period is repeated. From two on, a subspace method meets every
            window of the period, that across its ends included.
        recorded_periods: whole periods in each record, which are averaged first.

    Raises:
        ValueError: the band is empty or holds no line, its top reaches the Nyquist frequency of
            either rate, the record is no whole number of periods, the input does not repeat, or
            the band holds nothing of an input.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData, PeriodicBand, preprocess
        >>> wave = np.cos(2 * np.pi * 3 * np.arange(400) / 400)
        >>> data = IOData(u=wave, y=2 * wave, dt=0.01)
        >>> preprocess(data, PeriodicBand(0.5, 2.0, samples_per_period=20))[0]
        IOData(40 samples, 1 input (u1), 1 output (y1), dt=0.2 s)
    """

    low_hz: float | int = eqx.field(static=True)
    high_hz: float | int = eqx.field(static=True)
    samples_per_period: int | None = eqx.field(static=True, default=None)
    periods: int = eqx.field(static=True, default=2)
    recorded_periods: int = eqx.field(static=True, default=1)

    def __check_init__(self):
        if not (0 <= self.low_hz <= self.high_hz and math.isfinite(self.high_hz)):
            raise ValueError(
                f"PeriodicBand: {self.low_hz:g} to {self.high_hz:g} Hz is no band; give "
                "0 <= low_hz <= high_hz."
            )
        for name in ("samples_per_period", "periods", "recorded_periods"):
            value = getattr(self, name)
            if value is not None and (not isinstance(value, int) or value < 1):
                raise ValueError(f"PeriodicBand: {name} is {value!r}: give an integer from 1.")

    def apply(self, data: IOData) -> tuple[IOData, "PeriodicBandReversal"]:
        """Data of the band alone, and what lay outside it."""
        recorded = self._recorded(data)
        samples = self.samples_per_period or recorded
        lines = self._lines(data, recorded, samples)
        kept, removed = {}, {}
        for key, signal in (("u", data.u), ("y", data.y), ("kappa", data.kappa)):
            if signal is None:
                kept[key] = removed[key] = None
                continue
            wanted = lines if key != "kappa" else slice(0, (min(recorded, samples) + 1) // 2)
            pieces = split_records(signal, data.lengths)
            periods = [self._averaged(piece, recorded) for piece in pieces]
            if key == "u":
                self._check_input(data, pieces, periods, lines)
            kept[key] = [
                _repeated(resampled(period, samples, wanted), self.periods) for period in periods
            ]
            left = [
                piece - _repeated(resampled(period, recorded, wanted), self.recorded_periods)
                for piece, period in zip(pieces, periods, strict=True)
            ]
            removed[key] = jnp.asarray(_numpy_of(left[0]).concatenate(left))
        dt = data.dt * recorded / samples
        processed = IOData(**kept, dt=dt, names=data.names, units=data.units)
        reversal = PeriodicBandReversal(
            self,
            removed["u"],
            removed["y"],
            removed["kappa"],
            data.dt,
            data.lengths,
            self.recorded_periods,
            processed.lengths,
            self.periods,
        )
        return processed, reversal

    def _recorded(self, data: IOData) -> int:
        """Samples of one recorded period."""
        lengths = set(data.lengths)
        if len(lengths) > 1:
            raise ValueError(
                f"PeriodicBand: records of {sorted(lengths)} samples have no period in common; "
                "preprocess them one by one."
            )
        samples, rest = divmod(data.lengths[0], self.recorded_periods)
        if rest:
            raise ValueError(
                f"PeriodicBand: {data.lengths[0]} samples are no {self.recorded_periods} whole "
                "periods; cut the record to whole periods (and leave the first, transient ones "
                "out), or correct recorded_periods."
            )
        return samples

    def _lines(self, data: IOData, recorded: int, samples: int) -> slice:
        """Multiples of the fundamental frequency that lie in the band."""
        spacing = 1 / (recorded * data.dt)
        # A line named by its rounded frequency belongs to the band that ends there.
        first = math.ceil(self.low_hz / spacing - 1e-6)
        last = math.floor(self.high_hz / spacing + 1e-6)
        if last < first:
            raise ValueError(
                f"PeriodicBand: no line lies from {self.low_hz:g} to {self.high_hz:g} Hz; the "
                f"period of {recorded * data.dt:g} s has lines every {spacing:g} Hz."
            )
        if 2 * last >= recorded:
            raise ValueError(
                f"PeriodicBand: high_hz={self.high_hz:g} is not below the record's Nyquist "
                f"frequency, {0.5 / data.dt:g} Hz; lower it."
            )
        if 2 * last >= samples:
            raise ValueError(
                f"PeriodicBand: {samples} samples per period would alias {self.high_hz:g} Hz; "
                f"at least {2 * last + 1} are needed."
            )
        return slice(first, last + 1)

    def _averaged(self, piece: Samples, recorded: int) -> Samples:
        return piece.reshape(self.recorded_periods, recorded, -1).mean(axis=0)

    def _check_input(self, data: IOData, pieces, periods, lines: slice) -> None:
        if isinstance(data.u, Tracer):
            return
        for piece, period in zip(map(np.asarray, pieces), map(np.asarray, periods), strict=True):
            moving = np.sum((piece - piece.mean(axis=0)) ** 2, axis=0)
            left = piece - np.tile(period, (self.recorded_periods, 1))
            share = np.sum(left**2, axis=0) / np.maximum(moving, np.finfo(float).tiny)
            if np.any(share > _UNREPEATED):
                channel = int(np.argmax(share))
                raise ValueError(
                    f"PeriodicBand: input {data.input_names[channel]!r} does not repeat: "
                    f"{100 * share[channel]:.0f} % of its power changes between the "
                    f"{self.recorded_periods} recorded_periods of {len(period)} samples; check "
                    "their number and that the record holds whole periods."
                )
            power = np.abs(np.fft.rfft(period, axis=0)) ** 2
            empty = power[lines].sum(axis=0) <= 1e-20 * power.sum(axis=0)
            if np.any(empty):
                channel = int(np.argmax(empty))
                raise ValueError(
                    f"PeriodicBand: input {data.input_names[channel]!r} has nothing from "
                    f"{self.low_hz:g} to {self.high_hz:g} Hz; take the band that was excited."
                )


class PeriodicBandReversal(AbstractReversal):
    """What lay outside the band, and the recorded rate and periods."""

    step: AbstractStep
    u_removed: Float[Array, "time nu"]
    y_removed: Float[Array, "time ny"]
    kappa_removed: Float[Array, "time nk"] | None
    dt: float = eqx.field(static=True)
    lengths: tuple[int, ...] = eqx.field(static=True)
    recorded_periods: int = eqx.field(static=True)
    processed: tuple[int, ...] = eqx.field(static=True)
    processed_periods: int = eqx.field(static=True)

    def restore(self, data: IOData) -> IOData:
        """Data at the recorded rate, from the mean of its periods, with what lay outside."""
        channels = (self.u_removed.shape[1], self.y_removed.shape[1])
        check_restorable(data, self.processed, channels, self.step)
        restored = {}
        for key, signal, removed in (
            ("u", data.u, self.u_removed),
            ("y", data.y, self.y_removed),
            ("kappa", data.kappa, self.kappa_removed),
        ):
            if signal is None or removed is None:
                restored[key] = None
                continue
            back = self._back(signal, None) + removed
            restored[key] = split_records(back, self.lengths)
        return IOData(**restored, dt=self.dt, names=data.names, units=data.units)

    def output(self, y: Float[Array, "_ ny"], trend: bool) -> Float[Array, "_ ny"]:
        """The output's last period, nearest to the steady state, repeated at the recorded rate."""
        del trend
        check_output(y, self.processed, self.y_removed.shape[1], self.step)
        return self._back(y, -1)

    def _back(self, signal: Float[Array, "_ channel"], which: int | None):
        """Periods of every record (their mean, or one of them) at the recorded rate."""
        recorded = self.lengths[0] // self.recorded_periods
        samples = self.processed[0] // self.processed_periods
        lines = slice(0, (min(recorded, samples) + 1) // 2)
        back = []
        for piece in split_records(signal, self.processed):
            periods = piece.reshape(self.processed_periods, samples, -1)
            period = periods.mean(axis=0) if which is None else periods[which]
            back.append(_repeated(resampled(period, recorded, lines), self.recorded_periods))
        return jnp.asarray(_numpy_of(back[0]).concatenate(back))


def resampled(period: Samples, samples: int, lines: slice) -> Samples:
    """One period on another number of samples, of the given lines alone (below both Nyquists)."""
    xp, recorded = _numpy_of(period), period.shape[0]
    spectrum = xp.fft.rfft(period, axis=0)[lines]
    padding = (lines.start, samples // 2 + 1 - lines.stop)
    spectrum = xp.pad(spectrum, (padding, (0, 0))) * (samples / recorded)
    return xp.fft.irfft(spectrum, samples, axis=0)


def _repeated(period: Samples, times: int) -> Samples:
    return _numpy_of(period).tile(period, (times, 1))


def _numpy_of(signal: Samples) -> Any:
    """NumPy for samples, which compiles nothing for each new length; JAX for tracers."""
    return jnp if isinstance(signal, Tracer) else np
