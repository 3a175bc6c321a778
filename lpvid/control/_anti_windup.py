"""Integrators under a limited command."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float


def optional_floats(value: ArrayLike | None) -> Array | None:
    """As an array, or none."""
    return None if value is None else jnp.asarray(value, float)


def check_limit(limit: Array | None) -> None:
    """Refuse a limit that leaves no command.

    Raises:
        ValueError: it is not positive (checked only outside of jit).
    """
    if limit is None or isinstance(limit, Tracer):
        return
    if not np.all(np.asarray(limit) > 0.0):
        raise ValueError(f"limit={limit} must be positive: the largest command in V.")


def limited(
    command: Callable[[Float[Array, "1"]], Float[Array, "1"]],
    total: Float[Array, "1"],
    change: Float[Array, "1"],
    limit: Float[Array, ""] | None,
) -> tuple[Float[Array, "1"], Float[Array, "1"]]:
    """An integral's next value and the command within its limit.

    The integral stands still while it would take a command that is beyond the limit further there.

    Args:
        command: from the integral's value.
        total: the integral's value.
        change: what it would grow by.
        limit: of the command; none for a plain integral.
    """
    grown = total + change
    asked = command(grown)
    if limit is None:
        return grown, asked
    outward = (asked - command(total)) * asked > 0.0
    total = jnp.where((jnp.abs(asked) > limit) & outward, total, grown)
    return total, jnp.clip(command(total), -limit, limit)
