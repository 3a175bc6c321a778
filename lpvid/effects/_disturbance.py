"""Disturbances that follow the clock."""

from collections.abc import Callable
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
import scipy.ndimage
import scipy.optimize
from jaxtyping import Array, Float

from lpvid.effects._law import AbstractStaticLaw, Amplitude, Scales, Shape, Signals

_MOST = 32
_LOUDEST = 4
_GROUND = 25


class PeriodicDisturbance(AbstractStaticLaw):
    """A sinusoid in time, A sin ωt + B cos ωt: a rotor out of balance, the mains.

    Little is heard of it a fraction of a spectral line away, so `loudest` looks for the peaks of a
    residual's spectrum, between the lines too, and several frequencies for each of the `lines`
    count as tested; `grid` thins the lines out where there is no residual. With one output every
    port is alike but for amplitude and phase; several outputs tell them apart.

    Seen as: one spectral line that the input does not excite. Confused with torque ripple (follows
    the angle) and a missing mode (follows the input).

    Source: Brown and Zhang, Automatica 40 (2004) 1299–1305, periodic disturbances in control.

    Example:
        >>> law = PeriodicDisturbance()
        >>> law.regressors(at(time=0.25), jnp.array([2.0 * np.pi]), jnp.zeros(2)).round(9)
        Array([1., 0.], dtype=float64)
    """

    name: ClassVar[str] = "periodic-disturbance"
    family: ClassVar[str] = "disturbance"
    ports: ClassVar[tuple[str, ...]] = ("input", "force")
    amplitudes: ClassVar[tuple[Amplitude, ...]] = (
        Amplitude("A", "{acts_on}"),
        Amplitude("B", "{acts_on}"),
    )
    shapes: ClassVar[tuple[Shape, ...]] = (Shape("omega", "rad/s"),)
    whole: ClassVar[bool] = False

    def regressors(
        self, signals: Signals, shape: Float[Array, " shape"], memory: Float[Array, " memory"]
    ) -> Float[Array, " amplitude"]:
        """sin ωt, cos ωt."""
        del memory
        phase = shape[0] * signals.time
        return jnp.stack([jnp.sin(phase), jnp.cos(phase)])

    def lines(self, scales: Scales) -> np.ndarray:
        """Frequencies of whole periods in the record, two at least, up to 0.9 of Nyquist's, rad/s.

        Args:
            scales: sizes of the signals at the port.
        """
        count = int(0.45 * scales.duration / scales.dt)
        return 2.0 * np.pi / scales.duration * np.arange(2, max(count, 3) + 1)

    def grid(self, scales: Scales) -> np.ndarray:
        """At most 32 of the record's lines, in geometric progression."""
        lines = self.lines(scales)
        chosen = np.geomspace(1.0, lines.size, min(_MOST, lines.size)).round().astype(int) - 1
        return lines[np.unique(chosen)][:, None]

    def loudest(self, residual: np.ndarray, scales: Scales) -> np.ndarray:
        """Frequencies that stand out of a residual's spectrum most, (candidate, 1).

        Args:
            residual: (time, ny).
            scales: sizes of the signals at the port.
        """
        lines = self.lines(scales)
        power = np.abs(np.fft.rfft(residual / np.std(residual, axis=0), axis=0)) ** 2
        share = np.arange(power.shape[0]) * 2.0 * np.pi / (residual.shape[0] * scales.dt)
        total = np.interp(lines, share, np.sum(power, axis=1))
        # What the noise's colour or another effect puts into a whole band is not a line.
        ground = scipy.ndimage.median_filter(total, size=_GROUND, mode="nearest")
        contrast = total / np.maximum(ground, 1e-300)
        picked = lines[np.argsort(-contrast)[:_LOUDEST]]
        time = scales.dt * np.arange(residual.shape[0])
        whole = residual / np.std(residual, axis=0)
        # A strong line a tenth of the lines' distance off leaves most of itself behind.
        apart = 2.0 * np.pi / scales.duration

        def power_at(omega: float) -> float:
            return float(np.sum(np.abs(np.exp(-1j * omega * time) @ whole) ** 2))

        found = [_peak(power_at, max(one - apart, 0.5 * apart), one + apart) for one in picked]
        lower, upper = self.bounds(scales)
        return np.clip(np.asarray(found), lower[0], upper[0])[:, None]

    def bounds(self, scales: Scales) -> tuple[np.ndarray, np.ndarray]:
        """From one period in the record to 0.95 of Nyquist's frequency."""
        return (
            np.array([2.0 * np.pi / scales.duration]),
            np.array([max(0.95 * np.pi / scales.dt, 8.0 * np.pi / scales.duration)]),
        )


def _peak(power: Callable[[float], float], low: float, high: float) -> float:
    """Where the power is greatest between two frequencies."""
    near = 1e-3 * (high - low)
    best = scipy.optimize.fminbound(lambda omega: -power(omega), low, high, xtol=near)
    return float(np.asarray(best))
