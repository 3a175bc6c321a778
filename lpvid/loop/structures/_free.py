"""Ports of a model without physics."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from lpvid.loop._ported import Ports


def free_ports(
    A: Float[Array, "n n"],
    B: Float[Array, "n nu"],
    C: Float[Array, "ny n"],
    D: Float[Array, "ny nu"],
) -> Ports:
    """Coordinates are the outputs, q_j = C_j x and q̇_j = C_j A x; a force may enter any state."""
    (n, nu), ny = B.shape, C.shape[0]
    return Ports(
        A=A,
        B=B,
        C=C,
        D=D,
        force=jnp.broadcast_to(jnp.eye(n)[None], (ny, n, n)),
        position=C,
        velocity=C @ A,
        load_state=jnp.zeros((ny, n)),
        load_input=jnp.zeros((ny, nu)),
    )
