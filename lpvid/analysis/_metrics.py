"""How well a prediction matches a record, per output, and a parameter its truth."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float


def bft(y: ArrayLike, y_hat: ArrayLike) -> Float[Array, "*output"]:
    """Best fit: 100 max(1 - |y - ŷ| / |y - mean y|, 0) per output, in percent (001).

    A constant output has no variation to explain: 100 where it is met exactly, else 0. Works under
    `jit`, `vmap` and `grad` (not differentiable at a perfect fit, where the derivative is zero).

    Args:
        y: record, (time, ny) or (time,).
        y_hat: prediction, same shape.

    Returns:
        Percentages (ny,), or a scalar for one-dimensional input.

    Raises:
        ValueError: shapes differ, or are not (time,) or (time, ny).

    Example:
        >>> import numpy as np
        >>> from lpvid.analysis import bft
        >>> bft(np.arange(3.0), np.arange(3.0)).item()
        100.0
    """
    return jnp.maximum(nrmse_fit(y, y_hat), 0.0)


def nrmse_fit(y: ArrayLike, y_hat: ArrayLike) -> Float[Array, "*output"]:
    """Normalised fit: 100 (1 - |y - ŷ| / |y - mean y|) per output, in percent, not clipped.

    Negative where the mean would have been the better prediction. A constant output gives 100 where
    it is met exactly, else minus infinity.

    Args:
        y: record, (time, ny) or (time,).
        y_hat: prediction, same shape.

    Returns:
        Percentages (ny,), or a scalar for one-dimensional input.

    Raises:
        ValueError: shapes differ, or are not (time,) or (time, ny).

    Example:
        >>> import numpy as np
        >>> from lpvid.analysis import nrmse_fit
        >>> nrmse_fit(np.array([0.0, 2.0]), np.ones(2)).item()
        0.0
    """
    y, y_hat = _pair(y, y_hat, "y", "y_hat")
    error = _norm(y - y_hat)
    return 100.0 * (1.0 - _ratio(error, _norm(y - _mean(y))))


def vaf(y: ArrayLike, y_hat: ArrayLike) -> Float[Array, "*output"]:
    """Variance accounted for: 100 max(1 - var(y - ŷ) / var y, 0) per output, in percent (001).

    A constant offset of the prediction does not count against it. A constant output gives 100 where
    the error is constant too, else 0.

    Args:
        y: record, (time, ny) or (time,).
        y_hat: prediction, same shape.

    Returns:
        Percentages (ny,), or a scalar for one-dimensional input.

    Raises:
        ValueError: shapes differ, or are not (time,) or (time, ny).

    Example:
        >>> import numpy as np
        >>> from lpvid.analysis import vaf
        >>> vaf(np.array([0.0, 1.0]), np.array([5.0, 6.0])).item()
        100.0
    """
    y, y_hat = _pair(y, y_hat, "y", "y_hat")
    error = y - y_hat
    ratio = _ratio(jnp.var(error, axis=0), jnp.var(y, axis=0))
    return 100.0 * jnp.maximum(1.0 - ratio, 0.0)


def relative_error(y: ArrayLike, y_hat: ArrayLike) -> Float[Array, "*output"]:
    """Sun's relative error δ = RMS(y - ŷ) / RMS(y) per output, a ratio and not a percentage (002).

    An output that is zero throughout gives 0 where it is met exactly, else infinity.

    Args:
        y: record, (time, ny) or (time,).
        y_hat: prediction, same shape.

    Returns:
        Ratios (ny,), or a scalar for one-dimensional input.

    Raises:
        ValueError: shapes differ, or are not (time,) or (time, ny).

    Example:
        >>> import numpy as np
        >>> from lpvid.analysis import relative_error
        >>> relative_error(np.array([3.0, 4.0]), np.array([3.0, 4.0])).item()
        0.0
    """
    y, y_hat = _pair(y, y_hat, "y", "y_hat")
    return _ratio(_norm(y - y_hat), _norm(y))


def parameter_fit(eta: ArrayLike, eta_hat: ArrayLike) -> Float[Array, "*parameter"]:
    """Fit of a parameter along operating points: 100 (1 - |η - η̂| / |η - mean η|), in percent.

    Equation 36 of 001, for each column. A parameter that does not vary gives 100 where it is met
    exactly, else minus infinity.

    Args:
        eta: true values, (point, parameter) or (point,).
        eta_hat: estimates, same shape.

    Returns:
        Percentages (parameter,), or a scalar for one-dimensional input.

    Raises:
        ValueError: shapes differ, or have more than two axes.

    Example:
        >>> import numpy as np
        >>> from lpvid.analysis import parameter_fit
        >>> parameter_fit(np.array([1.0, 3.0]), np.array([1.0, 3.0])).item()
        100.0
    """
    eta, eta_hat = _pair(eta, eta_hat, "eta", "eta_hat")
    return 100.0 * (1.0 - _ratio(_norm(eta - eta_hat), _norm(eta - _mean(eta))))


def _pair(first, second, first_name: str, second_name: str):
    first, second = jnp.asarray(first, float), jnp.asarray(second, float)
    if first.shape != second.shape:
        raise ValueError(
            f"{first_name} has shape {first.shape} and {second_name} {second.shape}; give both in "
            "the same shape, time first. Nothing is transposed or broadcast by guess."
        )
    if first.ndim not in (1, 2) or first.shape[0] == 0:
        raise ValueError(
            f"{first_name} has shape {first.shape}; give (time,) or (time, channel) with at least "
            "one sample, and use jax.vmap for a batch of records."
        )
    return first, second


def _mean(values):
    return jnp.broadcast_to(jnp.mean(values, axis=0, keepdims=True), values.shape)


def _norm(values):
    # The square root's slope at zero is infinite: take it of a stand-in there.
    squares = jnp.sum(values * values, axis=0)
    positive = squares > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, squares, 1.0)), 0.0)


def _ratio(error, size):
    """error / size, and 0 or infinity where there is no size."""
    usable = size > 0.0
    ratio = error / jnp.where(usable, size, 1.0)
    return jnp.where(usable, ratio, jnp.where(error > 0.0, jnp.inf, 0.0))
