"""Frequency responses."""

import jax.numpy as jnp
from jaxtyping import Array, Complex, Float


def transfer(
    A: Float[Array, "*#batch nx nx"],
    B: Float[Array, "*#batch nx nu"],
    C: Float[Array, "*#batch ny nx"],
    D: Float[Array, "*#batch ny nu"],
    points: Complex[Array, "*#batch frequency"],
) -> Complex[Array, "*batch frequency ny nu"]:
    """C (s I − A)⁻¹ B + D at given points s (or z) of the complex plane."""
    shifted = points[..., None, None] * jnp.eye(A.shape[-1]) - A[..., None, :, :]
    right = jnp.broadcast_to(B[..., None, :, :], (*shifted.shape[:-1], B.shape[-1]))
    solved = jnp.linalg.solve(shifted, right.astype(shifted.dtype))
    return C[..., None, :, :].astype(shifted.dtype) @ solved + D[..., None, :, :]
