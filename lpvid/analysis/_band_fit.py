"""Fit of a model to a periodic record, in steady state and in a band of frequencies."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from lpvid.data import IOData
from lpvid.models import StateSpace

Band = tuple[float | int, float | int]


def band_lines(data: IOData, band: Band) -> Float[Array, " line"]:
    """Angular frequencies of the lines of a periodic record that lie in a band.

    Args:
        data: records of one length, each a whole number of periods.
        band: lowest and highest frequency in Hz, both included.

    Returns:
        Frequencies in rad/s, (line,), those of the discrete Fourier transform of a record.

    Raises:
        ValueError: no line lies in the band, it reaches the Nyquist frequency, or the records
            have different lengths.

    Example:
        >>> import numpy as np
        >>> from lpvid.analysis import band_lines
        >>> from lpvid.data import IOData
        >>> data = IOData(u=np.eye(100)[:, 0], y=np.ones(100), dt=0.01)
        >>> (band_lines(data, (2.0, 4.0)) / (2 * np.pi)).tolist()
        [2.0, 3.0, 4.0]
    """
    return 2.0 * jnp.pi * jnp.asarray(_indices(data, band), float) / (data.lengths[0] * data.dt)


def band_fit(
    model: StateSpace | Complex[Array, "line output input"],
    data: IOData,
    band: Band,
) -> Float[Array, " output"]:
    """Steady-state fit 100 (1 − ‖Y − G U‖ / ‖Y‖) per output over the lines in a band, in percent.

    U and Y are the discrete Fourier transforms of the records; in steady state and without noise
    Y = G U holds line by line for a linear system, with no transient and no start to estimate.
    Negative where zero would have been the better prediction. Differentiable in the model.

    Args:
        model: continuous or discrete model, or its response at `band_lines(data, band)`.
        data: records of one length, each a whole number of periods in steady state.
        band: lowest and highest frequency in Hz, both included.

    Returns:
        Percentages (ny,), over all records together.

    Raises:
        ValueError: channels do not fit, a response of the wrong shape, or as `band_lines`.

    Example:
        >>> import numpy as np
        >>> from lpvid.analysis import band_fit
        >>> from lpvid.data import IOData
        >>> from lpvid.models import StateSpace
        >>> u = np.random.default_rng(0).standard_normal(64)
        >>> gain = StateSpace([[-1.0]], [[0.0]], [[0.0]], [[2.0]])
        >>> band_fit(gain, IOData(u=u, y=2 * u, dt=0.1), (0.5, 3.0)).round(6).tolist()
        [100.0]
    """
    indices, omega = _indices(data, band), band_lines(data, band)
    response = model.frequency_response(omega) if isinstance(model, StateSpace) else model
    if response.shape != (omega.shape[0], data.ny, data.nu):
        raise ValueError(
            f"model: its response has shape {response.shape}, the data need "
            f"{(omega.shape[0], data.ny, data.nu)} (lines in the band, outputs, inputs)."
        )
    U, Y = _lines(data.u, data, indices), _lines(data.y, data, indices)
    error = Y - jnp.einsum("lyu,rlu->rly", response, U)
    return 100.0 * (1.0 - _size(error) / _size(Y))


def _indices(data: IOData, band: Band) -> np.ndarray:
    if len(set(data.lengths)) > 1:
        raise ValueError(
            f"data: records of {sorted(set(data.lengths))} samples have different lines; take "
            "them one by one from data.records."
        )
    low, high = band
    spacing = 1.0 / (data.lengths[0] * data.dt)
    # A line named by its rounded frequency belongs to the band that ends there.
    first, last = int(np.ceil(low / spacing - 1e-6)), int(np.floor(high / spacing + 1e-6))
    if first < 0 or last < first or 2 * last >= data.lengths[0]:
        raise ValueError(
            f"band: {low:g} to {high:g} Hz must hold a line and stay below the Nyquist frequency "
            f"{0.5 / data.dt:g} Hz; the lines are {spacing:g} Hz apart."
        )
    return np.arange(first, last + 1)


def _lines(signal: Float[Array, "_ channel"], data: IOData, indices: np.ndarray):
    records = jnp.reshape(signal, (len(data.lengths), data.lengths[0], -1))
    return jnp.fft.rfft(records, axis=1)[:, indices]


def _size(lines: Complex[Array, "record line output"]) -> Float[Array, " output"]:
    return jnp.sqrt(jnp.sum(jnp.abs(lines) ** 2, axis=(0, 1)))
