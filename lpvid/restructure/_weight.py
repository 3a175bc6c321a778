"""Weights on frequency: filters of the error."""

from collections.abc import Callable
from typing import TypeAlias

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Complex, Float

from lpvid.models import StateSpace

Weight: TypeAlias = StateSpace | Callable[[Float[Array, " frequency"]], ArrayLike]


def filter_model(weight: Weight | None, n_outputs: int) -> StateSpace | None:
    """The weight as a model of `n_outputs` inputs and outputs, one filter standing for each.

    Raises:
        ValueError: it is a function, discrete, unstable or of another size.
    """
    if weight is None:
        return None
    if not isinstance(weight, StateSpace):
        raise ValueError(
            "weight: a function has no exact norm over all frequencies; give omega= as well, or a "
            "StateSpace filter."
        )
    if weight.is_discrete or weight.batch_shape:
        raise ValueError("weight: one continuous-time model is needed; convert it by d2c.")
    if weight.nx == 0:
        raise ValueError(
            "weight: a constant has no poles to weight frequencies by; scale the channels instead."
        )
    stable = weight.is_stable()
    if not isinstance(stable, Tracer) and not bool(stable):
        raise ValueError("weight: it is unstable; move its poles into the left half plane.")
    if (weight.ny, weight.nu) == (n_outputs, n_outputs):
        return weight
    if (weight.ny, weight.nu) == (1, 1):
        parts = (weight.A, weight.B, weight.C, weight.D)
        A, B, C, D = (jnp.kron(jnp.eye(n_outputs), part) for part in parts)
        return StateSpace(A, B, C, D)
    raise ValueError(
        f"weight: {weight.ny} x {weight.nu} channels; 1 x 1 or {n_outputs} x {n_outputs} is needed."
    )


def filter_response(
    weight: Weight | None, omega: Float[Array, " frequency"], n_outputs: int
) -> Complex[Array, "frequency output output"] | None:
    """The weight on a grid of frequencies.

    Raises:
        ValueError: its values are not finite, or of another shape.
    """
    if weight is None:
        return None
    if isinstance(weight, StateSpace):
        filtered = filter_model(weight, n_outputs)
        assert filtered is not None
        return filtered.frequency_response(omega)
    values = jnp.asarray(weight(omega), complex)
    if not isinstance(values, Tracer) and not np.all(np.isfinite(values)):
        raise ValueError("weight: its values hold NaN or infinity; bound it on omega.")
    if values.shape == omega.shape:
        return values[:, None, None] * jnp.eye(n_outputs, dtype=complex)[None]
    if values.shape == (*omega.shape, n_outputs, n_outputs):
        return values
    raise ValueError(
        f"weight: shape {values.shape} given; {omega.shape} or "
        f"{(*omega.shape, n_outputs, n_outputs)} is needed."
    )
