"""Gains of a system along the frequency axis."""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from lpvid.models import StateSpace


def singular_values(system: StateSpace, omega: ArrayLike) -> Float[Array, "*batch frequency gain"]:
    """Singular values of the frequency response, largest first.

    Differentiable in the system where the singular values are distinct; works under `jit`, `vmap`.

    Args:
        system: continuous or discrete model with any leading batch axes.
        omega: frequencies in rad/s, (frequency,).

    Returns:
        Gains (..., frequency, min(ny, nu)) in the unit of output over input.

    Raises:
        ValueError: omega has more than one axis.

    Example:
        >>> import numpy as np
        >>> from lpvid.analysis import singular_values
        >>> from lpvid.models import StateSpace
        >>> singular_values(StateSpace([[-1.0]], [[1.0]], [[2.0]]), np.zeros(1)).item()
        2.0
    """
    frequencies = jnp.atleast_1d(jnp.asarray(omega, float))
    if frequencies.ndim != 1:
        raise ValueError(
            f"omega has shape {frequencies.shape}; give one frequency axis and put batch axes on "
            "the system."
        )
    return jnp.linalg.svd(system.frequency_response(frequencies), compute_uv=False)
