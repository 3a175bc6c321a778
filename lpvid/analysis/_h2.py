"""The H2 norm: output variance for white noise, energy of the impulse response."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from lpvid._linalg import continuous_lyapunov, discrete_lyapunov
from lpvid.models import StateSpace


def h2_norm(system: StateSpace) -> Float[Array, "*batch"]:
    """Root of the impulse response's energy, √tr(C P Cᵀ + D Dᵀ) with P the controllability Gramian.

    Differentiable (also forward, also twice) except where the norm is zero; works under `jit` and
    `vmap`. K. Zhou, J. Doyle and K. Glover, Robust and Optimal Control (1996), section 4.6.

    Args:
        system: continuous or discrete model with any leading batch axes.

    Returns:
        The norm; infinite for an unstable system and for a continuous one with D other than zero.
        For discrete systems it is the sum over samples, not the integral over time: multiply by
        √dt to compare with the continuous norm of a response B sampled as impulses of area one.

    Example:
        >>> from lpvid.analysis import h2_norm
        >>> from lpvid.models import StateSpace
        >>> round(float(h2_norm(StateSpace([[-2.0]], [[1.0]], [[2.0]]))), 6)
        1.0
    """
    A, B, C, D = system.A, system.B, system.C, system.D
    solve = discrete_lyapunov if system.is_discrete else continuous_lyapunov
    stable = system.is_stable()
    # A stable stand-in keeps the derivative of the unused branch finite.
    calm = (
        jnp.zeros_like(A) if system.is_discrete else -jnp.broadcast_to(jnp.eye(system.nx), A.shape)
    )
    gramian = solve(jnp.where(stable[..., None, None], A, calm), B @ B.mT)
    energy = jnp.sum((C @ gramian) * C, axis=(-2, -1))
    if system.is_discrete:
        energy = energy + jnp.sum(D * D, axis=(-2, -1))
        finite = stable
    else:
        finite = stable & jnp.all(D == 0.0, axis=(-2, -1))
    positive = energy > 0.0
    norm = jnp.where(positive, jnp.sqrt(jnp.where(positive, energy, 1.0)), 0.0)
    return jnp.where(finite, norm, jnp.inf)
