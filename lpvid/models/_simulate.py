"""Simulation of models, and of matrices that vary with time."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lpvid.models._state_space import Numbers, StateSpace


def simulate(
    system: StateSpace,
    *,
    u: Numbers,
    x0: Numbers | None = None,
    dt: float | None = None,
) -> Float[Array, "*batch time ny"]:
    """Response of a model to an input; see `StateSpace.simulate`, which this calls.

    Example:
        >>> import numpy as np
        >>> from lpvid.models import StateSpace, simulate
        >>> simulate(StateSpace([[0.5]], [[1.0]], [[1.0]], dt=0.1), u=np.ones(3))[:, 0].tolist()
        [0.0, 1.0, 1.5]
    """
    return system.simulate(u=u, x0=x0, dt=dt)


def simulate_time_varying(
    A: Float[Array, "time nx nx"],
    B: Float[Array, "time nx nu"],
    C: Float[Array, "time ny nx"],
    D: Float[Array, "time ny nu"],
    *,
    u: Float[Array, "time nu"],
    x0: Float[Array, " nx"] | None = None,
) -> Float[Array, "time ny"]:
    """Output of x_{t+1} = A_t x_t + B_t u_t, y_t = C_t x_t + D_t u_t, one matrix a sample.

    Only the state recursion runs in a loop; inputs and outputs are products over all samples.

    Args:
        A: state matrices, one a sample; B, C, D the others.
        B: input matrices.
        C: output matrices.
        D: feedthroughs.
        u: input.
        x0: first state; zero when left out.
    """
    start = jnp.zeros(A.shape[-1], A.dtype) if x0 is None else x0

    def step(x, matrices):
        A_t, w_t = matrices
        return A_t @ x + w_t, x

    forcing = jnp.einsum("txu,tu->tx", B, u)
    _, states = jax.lax.scan(step, start, (A, forcing), unroll=8)
    return jnp.einsum("tyx,tx->ty", C, states) + jnp.einsum("tyu,tu->ty", D, u)
