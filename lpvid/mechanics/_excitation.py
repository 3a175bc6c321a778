"""Test signals: binary sequences, multisines, measurement noise."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray


def prbs(
    key: PRNGKeyArray,
    n_samples: int,
    n_channels: int = 1,
    *,
    amplitude: float = 1.0,
    hold: int = 1,
) -> Float[Array, "time channel"]:
    """Uncorrelated pseudo-random binary sequences of levels ±amplitude.

    Each channel is a random order of equally many positive and negative bits (one more of either
    for an odd number), drawn independently. Like a maximum-length sequence it has an exact mean of
    zero over its bits and an autocorrelation of −1/bits in expectation away from lag zero; unlike
    one it has any length, and its running sum is a bridge that returns to zero: a velocity
    reference built from it brings the joint back.

    The spectrum falls by 3 dB at 2.8 / (hold · dt) rad/s and vanishes at 2π / (hold · dt).

    Args:
        key: random key.
        n_samples: length of the record; the last bit is cut where `hold` does not divide it.
        n_channels: number of signals.
        amplitude: level, in the input's unit.
        hold: samples for which each bit lasts.

    Raises:
        ValueError: if a count is below one.

    Example:
        >>> prbs(jax.random.key(0), 6, 2, amplitude=0.1, hold=3).shape
        (6, 2)
    """
    _check_counts(n_samples=n_samples, n_channels=n_channels, hold=hold)
    bits = -(-n_samples // hold)
    order_key, sign_key = jax.random.split(key)
    # A random sign as well: without it an odd number of bits would always favour the same level.
    alternating = jnp.where(jnp.arange(bits) % 2 == 0, amplitude, -amplitude)
    levels = alternating[:, None] * jax.random.rademacher(sign_key, (1, n_channels), float)
    shuffled = jax.random.permutation(order_key, levels, axis=0, independent=True)
    return jnp.repeat(shuffled, hold, axis=0)[:n_samples]


def multisine(
    key: PRNGKeyArray,
    n_samples: int,
    n_channels: int,
    dt: float,
    band: tuple[float, float],
    *,
    amplitude: float = 1.0,
) -> Float[Array, "time channel"]:
    """Random-phase multisines with a flat spectrum over a band, periodic in the record.

    The channels take turns at the record's frequencies 2π k / (n_samples dt) inside the band, so
    that they are exactly uncorrelated over the record.

    Args:
        key: random key, for the phases.
        n_samples: length of the record, one period.
        n_channels: number of signals.
        dt: sample time, s.
        band: lowest and highest frequency, rad/s.
        amplitude: root mean square of each channel, in the input's unit.

    Raises:
        ValueError: if the band is empty, exceeds the Nyquist frequency or holds fewer lines than
            there are channels.

    Example:
        >>> multisine(jax.random.key(0), 1000, 2, 1e-3, (10.0, 200.0)).shape
        (1000, 2)
    """
    _check_counts(n_samples=n_samples, n_channels=n_channels)
    low, high = band
    if not (dt > 0.0 and 0.0 <= low < high <= np.pi / dt):
        raise ValueError(
            f"band={band} rad/s must lie between 0 and the Nyquist frequency "
            f"{np.pi / dt if dt > 0 else float('nan'):.6g} rad/s of dt={dt} s."
        )
    spacing = 2.0 * np.pi / (n_samples * dt)
    # Neither the mean nor the Nyquist line, whose phases are not free.
    first = max(1, int(np.ceil(low / spacing - 1e-9)))
    last = min((n_samples - 1) // 2, int(np.floor(high / spacing + 1e-9)))
    lines = np.arange(first, last + 1)
    if lines.size < n_channels:
        raise ValueError(
            f"band={band} rad/s holds {lines.size} lines of a record of {n_samples} samples, for "
            f"{n_channels} channels: widen the band or lengthen the record."
        )
    channels = np.arange(lines.size) % n_channels
    phases = jax.random.uniform(key, (lines.size,), float, maxval=2.0 * np.pi)
    lines_per_channel = jnp.asarray(np.bincount(channels, minlength=n_channels), float)
    size = amplitude * n_samples / jnp.sqrt(2.0 * lines_per_channel[channels])
    coefficients = jax.lax.complex(size * jnp.cos(phases), size * jnp.sin(phases))
    spectrum = jnp.zeros((n_samples // 2 + 1, n_channels), complex)
    spectrum = spectrum.at[lines, channels].set(coefficients)
    return jnp.fft.irfft(spectrum, n=n_samples, axis=0)


def add_noise(
    key: PRNGKeyArray, y: ArrayLike, snr_db: ArrayLike
) -> Float[Array, "*batch time channel"]:
    """Add white Gaussian noise to each channel at a signal-to-noise ratio of its own variance.

    Args:
        key: random key.
        y: noise-free outputs (time, channel) or a batch of records (…, time, channel); each
            record's own variance counts.
        snr_db: 10 log10(var y / var noise), one for all or one a channel (channel,).

    Raises:
        ValueError: if y is not at least two-dimensional.

    Example:
        >>> add_noise(jax.random.key(0), jnp.ones((5, 2)), 30.0)[0, 0]   # no variance, no noise
        Array(1., dtype=float64)
    """
    y = jnp.asarray(y, float)
    if y.ndim < 2:
        raise ValueError(f"y has shape {y.shape}: give (time, channel), for example y[:, None].")
    ratios = 10.0 ** (-jnp.broadcast_to(jnp.asarray(snr_db, float), y.shape[-1:]) / 20.0)
    scale = jnp.std(y, axis=-2, keepdims=True) * jnp.expand_dims(ratios, range(y.ndim - 1))
    return y + scale * jax.random.normal(key, y.shape, float)


def _check_counts(**counts: int) -> None:
    for name, count in counts.items():
        if count < 1:
            raise ValueError(f"{name}={count} must be at least 1.")
