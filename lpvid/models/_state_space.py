"""Linear time-invariant state-space models."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float


class StateSpace(eqx.Module):
    """A linear time-invariant model (skeleton, being extended)."""

    A: Float[Array, "*batch nx nx"]
    B: Float[Array, "*batch nx nu"]
    C: Float[Array, "*batch ny nx"]
    D: Float[Array, "*batch ny nu"]
    dt: float = eqx.field(static=True)

    def __init__(self, A: ArrayLike, B: ArrayLike, C: ArrayLike, D: ArrayLike | None = None, dt: float = 0.0):
        self.A, self.B, self.C = (jnp.asarray(m, float) for m in (A, B, C))
        ny, nu = self.C.shape[-2], self.B.shape[-1]
        self.D = jnp.zeros((*self.A.shape[:-2], ny, nu)) if D is None else jnp.asarray(D, float)
        self.dt = float(dt)
