"""Hankel singular values: how much each balanced state passes from input to output."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from lpvid.models import StateSpace, balancing, gramians


@jax.jit
def hankel_singular_values(model: StateSpace) -> Float[Array, "*batch nx"]:
    """Hankel singular values of a stable model, largest first: the roots of the eigenvalues of P Q.

    P and Q are the Gramians. Values below about 1e-8 of the largest may be rounding errors, for the
    Gramians hold their squares.

    First derivatives by dσ = (t dP tᵀ + sᵀ dQ s)/2 with t the row of the balancing transformation
    and s the column of its inverse: exact for a simple value, whatever the Gramians' own
    eigenvalues; of repeated values only the sum's derivative has a meaning, and a zero value has
    none (zero is given). Works under `jit` and `vmap`. NaN for an unstable model.

    Args:
        model: continuous or discrete model with any leading batch axes.

    Returns:
        The values, output unit over input unit (continuous: the impulse response's Hankel operator;
        half of the norm of a model of one state without D).

    Example:
        >>> from lpvid.models import StateSpace
        >>> from lpvid.reduce import hankel_singular_values
        >>> hankel_singular_values(StateSpace([[-1.0]], [[4.0]], [[1.0]])).round(6)
        Array([2.], dtype=float64)
    """
    forward, backward, values = lax.stop_gradient(balancing(lax.stop_gradient(model)))
    controllability, observability = gramians(model)
    present = values > 1e-14 * values[..., :1]
    rows = jnp.where(present[..., None], forward, 0.0)
    columns = jnp.where(present[..., None, :], backward, 0.0)
    # Zero in value: only its derivative counts.
    change = controllability - lax.stop_gradient(controllability)
    change_seen = observability - lax.stop_gradient(observability)
    first = jnp.sum((rows @ change) * rows, axis=-1)
    second = jnp.sum((change_seen @ columns) * columns, axis=-2)
    return values + 0.5 * (first + second)
