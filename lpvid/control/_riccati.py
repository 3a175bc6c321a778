"""Linear-quadratic design: regulator and observer, in discrete and in continuous time."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Float

from lpvid._linalg import batched, continuous_lyapunov, discrete_riccati
from lpvid.control._closed_loop import Numbers
from lpvid.models import StateSpace


class Regulator(eqx.Module):
    """A linear-quadratic gain.

    Attributes:
        gain: K of u = −K x, or L of the observer, with any batch axes of the model.
        cost: X, the stabilising solution of the Riccati equation: xᵀ X x is the cost from x on, or
            the covariance of the observer's prediction error.
    """

    gain: Float[Array, "*batch row column"]
    cost: Float[Array, "*batch nx nx"]


def lqr(
    model: StateSpace,
    state_weight: Numbers,
    input_weight: Numbers,
    cross_weight: Numbers | None = None,
) -> Regulator:
    """State feedback u = −K x of least Σ xᵀ Q x + uᵀ R u + 2 xᵀ N u, or of the integral of that.

    Composes with jit, vmap and grad (first derivatives, implicit); leading batch axes of the model
    and of the weights broadcast. Not a number where no stabilising gain exists.

    Args:
        model: continuous-time or discrete-time; its outputs do not matter.
        state_weight: Q (nx, nx), or its diagonal (nx,); positive semidefinite.
        input_weight: R (nu, nu), or its diagonal (nu,), or a number for all; positive definite.
        cross_weight: N (nx, nu), with [[Q, N], [Nᵀ, R]] positive semidefinite; none by default.

    Returns:
        `Regulator` with K (nu, nx) and X.

    Raises:
        ValueError: weights of other shapes, or indefinite ones (values outside `jit` only).

    Source: 002, equation 4-9; Anderson and Moore, Optimal Control (Prentice Hall 1990).

    Example:
        >>> integrator = StateSpace([[0.0]], [[1.0]], [[1.0]])
        >>> lqr(integrator, [4.0], 1.0).gain.round(6)
        Array([[2.]], dtype=float64)
    """
    Q = _weight("state_weight", state_weight, model.nx, definite=False)
    R = _weight("input_weight", input_weight, model.nu, definite=True)
    N = jnp.zeros((model.nx, model.nu))
    if cross_weight is not None:
        N = jnp.asarray(cross_weight, float)
        if N.shape[-2:] != (model.nx, model.nu):
            raise ValueError(f"cross_weight has shape {N.shape}: give ({model.nx}, {model.nu}).")
    A, B = model.A, model.B
    if model.is_discrete:
        X = discrete_riccati(A.mT, B.mT, Q, R, N)
        left, right = B.mT @ X @ B, (A.mT @ X @ B + _like(N, A))
    else:
        X = _continuous_riccati(A, B, Q, R, N)
        left, right = jnp.zeros_like(B.mT @ B), (X @ B + _like(N, A))
    return Regulator(jnp.linalg.solve(left + _like(R, left), right.mT), X)


def kalman(
    model: StateSpace,
    state_noise: Numbers,
    output_noise: Numbers,
    cross_noise: Numbers | None = None,
) -> Regulator:
    """Observer gain L of x̂⁺ = A x̂ + B u + L (y − C x̂ − D u), by duality with `lqr`.

    In discrete time it predicts: x̂ at the next sample from the outputs up to this one. Composes,
    and fails, as `lqr` does.

    Args:
        model: continuous-time or discrete-time.
        state_noise: covariance of the state noise (nx, nx), or its diagonal.
        output_noise: covariance of the output noise (ny, ny), its diagonal, or a number.
        cross_noise: covariance between them (nx, ny); none by default.

    Returns:
        `Regulator` with L (nx, ny) and the covariance of the prediction error.

    Raises:
        ValueError: as for `lqr`, in the names of the weights.

    Source: 002, section 4.4 (the observer by the dual property).

    Example:
        >>> drift = StateSpace([[1.0]], [[1.0]], [[1.0]], dt=1.0)
        >>> kalman(drift, [1.0], 1.0).gain.round(6)
        Array([[0.618034]], dtype=float64)
    """
    dual = StateSpace(model.A.mT, model.C.mT, model.B.mT, dt=model.dt)
    found = lqr(dual, state_noise, output_noise, cross_noise)
    return Regulator(found.gain.mT, found.cost)


def _like(matrix: Array, batched: Array) -> Array:
    """Leading axes of one in front, so that strict rank promotion may be on."""
    return matrix.reshape((1,) * (batched.ndim - matrix.ndim) + matrix.shape)


def _weight(name: str, value: Numbers, size: int, *, definite: bool) -> Array:
    weight = jnp.asarray(value, float)
    if weight.ndim == 0:
        weight = weight * jnp.eye(size)
    elif weight.ndim == 1 and weight.shape == (size,):
        weight = jnp.diag(weight)
    if weight.shape[-2:] != (size, size):
        raise ValueError(
            f"{name} has shape {weight.shape}: give ({size}, {size}), its diagonal or one number."
        )
    if not isinstance(weight, Tracer):
        known = np.asarray(weight)
        if not np.allclose(known, np.swapaxes(known, -1, -2)):
            raise ValueError(f"{name} is not symmetric: give its symmetric part.")
        least = np.min(np.linalg.eigvalsh(known))
        if least < (0.0 if definite else -1e-10 * np.max(np.abs(known))) or (
            definite and least == 0.0
        ):
            kind = "positive definite" if definite else "positive semidefinite"
            raise ValueError(f"{name} must be {kind}; its least eigenvalue is {least:.3g}.")
    return weight


def _transformed_riccati(A: Array, B: Array, Q: Array, R: Array, N: Array) -> Array:
    """Stabilising X of AᵀX + XA + Q − (XB + N) R⁻¹ (XB + N)ᵀ = 0, through discrete time.

    The bilinear rule keeps the cost of a signal, so the discrete-time problem has the same X.
    """
    n = A.shape[0]
    feedback = jnp.linalg.solve(R, N.T)
    closed = A - B @ feedback
    coupling = B @ jnp.linalg.solve(R, B.T)
    hamiltonian = jnp.block([[closed, -coupling], [-(Q - N @ feedback), -closed.T]])
    rates = jnp.abs(jnp.linalg.eigvals(lax.stop_gradient(hamiltonian)))
    # Midway between the fastest and the slowest pole of the loop to come.
    fastest, slowest = jnp.max(rates), jnp.maximum(jnp.min(rates), 1e-9 * jnp.max(rates))
    shift = jnp.sqrt(fastest * slowest)
    # Closed first: its poles are not those of A, so the shift seldom meets one.
    inverse = jnp.linalg.inv(shift * jnp.eye(n) - closed)
    transition = 2.0 * shift * inverse - jnp.eye(n)
    inputs = jnp.sqrt(2.0 * shift) * inverse @ B
    weight = inverse.T @ (Q - N @ feedback)
    state = 2.0 * shift * weight @ inverse
    cross = jnp.sqrt(2.0 * shift) * weight @ inverse @ B
    inner = R + B.T @ weight @ inverse @ B
    X = discrete_riccati(transition.T, inputs.T, 0.5 * (state + state.T), inner, cross)
    # One Newton step (Kleinman) takes back what the transform of a stiff problem loses.
    right = X @ B + N
    gain = jnp.linalg.solve(R, right.T)
    residual = A.T @ X + X @ A + Q - right @ gain
    X = X + continuous_lyapunov((A - B @ gain).T, 0.5 * (residual + residual.T))
    return 0.5 * (X + X.T)


_continuous_riccati = jax.jit(batched(_transformed_riccati, "(n,n),(n,m),(n,n),(m,m),(n,m)->(n,n)"))
