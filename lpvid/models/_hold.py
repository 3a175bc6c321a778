"""Rules for passing between continuous and discrete time, on matrices."""

import abc
from functools import partial
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from lpvid._linalg import batched, expm, logm

Matrices: TypeAlias = tuple[Array, Array, Array, Array]


class AbstractConversion(eqx.Module):
    """How a model passes between continuous and discrete time; batch axes in front throughout."""

    @abc.abstractmethod
    def discretise(self, A: Array, B: Array, C: Array, D: Array, dt: float) -> Matrices:
        """Discrete-time matrices for sample time `dt`."""

    @abc.abstractmethod
    def to_continuous(self, A: Array, B: Array, C: Array, D: Array, dt: float) -> Matrices:
        """Continuous-time matrices of a model with sample time `dt`."""


class ZeroOrderHold(AbstractConversion):
    """Exact at the samples for inputs held constant between them; C and D are unchanged.

    Discretisation is the matrix exponential exp([[A, B], [0, 0]] dt) = [[A_d, B_d], [0, I]], its
    inverse the principal logarithm. Both differentiate (the logarithm away from the closed
    negative real axis) and batch.

    Example:
        >>> from lpvid.models import StateSpace, ZeroOrderHold
        >>> system = StateSpace([[0.0]], [[1.0]], [[1.0]])
        >>> system.discretise(0.1, ZeroOrderHold()).B.item()
        0.1
    """

    def discretise(self, A: Array, B: Array, C: Array, D: Array, dt: float) -> Matrices:
        """Discrete-time matrices for sample time `dt`."""
        return (*_exponential(A, B, jnp.asarray(dt)), C, D)

    def to_continuous(self, A: Array, B: Array, C: Array, D: Array, dt: float) -> Matrices:
        """Continuous-time matrices; the poles are taken between ±π/dt.

        Raises:
            ValueError: a pole lies on the closed negative real axis, where no real logarithm
                exists. Not checked under `jit` and its like: the result is then NaN.
        """
        if not isinstance(A, Tracer):
            _check_logarithm(np.asarray(A), dt)
        return (*_logarithm(A, B, jnp.asarray(dt)), C, D)


class Tustin(AbstractConversion):
    """Bilinear rule s = (2/dt) (z − 1)/(z + 1); a feedthrough appears. Exactly invertible.

    The states are scaled so that the discrete and the continuous model have the same Gramians.

    Example:
        >>> from lpvid.models import StateSpace, Tustin
        >>> StateSpace([[-1.0]], [[1.0]], [[1.0]]).discretise(2.0, Tustin()).D.item()
        0.5
    """

    def discretise(self, A: Array, B: Array, C: Array, D: Array, dt: float) -> Matrices:
        """Discrete-time matrices; singular where A has a pole at 2/dt."""
        return _bilinear(A, B, C, D, jnp.asarray(dt))

    def to_continuous(self, A: Array, B: Array, C: Array, D: Array, dt: float) -> Matrices:
        """Continuous-time matrices.

        Raises:
            ValueError: a pole lies at z = −1, which the rule sends to infinity. Not checked under
                `jit` and its like.
        """
        if not isinstance(A, Tracer):
            distance = np.abs(np.linalg.eigvals(np.asarray(A)) + 1.0)
            if distance.size and np.min(distance) < 1e-12:
                raise ValueError(
                    "A has a pole at z = -1, which the Tustin rule sends to infinity; use "
                    "ZeroOrderHold() or another sample time."
                )
        return _inverse_bilinear(A, B, C, D, jnp.asarray(dt))


_SIGNATURE = "(n,n),(n,m),(p,n),(p,m),()->(n,n),(n,m),(p,n),(p,m)"


@jax.jit
@partial(batched, signature=_SIGNATURE)
def _bilinear(A: Array, B: Array, C: Array, D: Array, dt: Array) -> Matrices:
    shift, identity = 2.0 / dt, jnp.eye(A.shape[0])
    inverse = jnp.linalg.inv(shift * identity - A)
    scale = jnp.sqrt(2.0 * shift)
    return (
        2.0 * shift * inverse - identity,
        scale * inverse @ B,
        scale * C @ inverse,
        D + C @ inverse @ B,
    )


@jax.jit
@partial(batched, signature=_SIGNATURE)
def _inverse_bilinear(A: Array, B: Array, C: Array, D: Array, dt: Array) -> Matrices:
    shift, identity = 2.0 / dt, jnp.eye(A.shape[0])
    inverse = jnp.linalg.inv(identity + A)
    scale = jnp.sqrt(2.0 * shift)
    return (
        shift * (identity - 2.0 * inverse),
        scale * inverse @ B,
        scale * C @ inverse,
        D - C @ inverse @ B,
    )


@jax.jit
def _exponential(A: Array, B: Array, dt: Array) -> tuple[Array, Array]:
    nx, nu = B.shape[-2:]
    upper = jnp.concatenate([A, B], axis=-1) * dt
    lower = jnp.zeros((*A.shape[:-2], nu, nx + nu))
    exponential = expm(jnp.concatenate([upper, lower], axis=-2))
    return exponential[..., :nx, :nx], exponential[..., :nx, nx:]


@jax.jit
@partial(batched, signature="(n,n),(n,m),()->(n,n),(n,m)")
def _logarithm(A: Array, B: Array, dt: Array) -> tuple[Array, Array]:
    nx, nu = B.shape
    held = jnp.eye(nu, nx + nu, nx)
    logarithm = logm(jnp.concatenate([jnp.concatenate([A, B], axis=1), held])) / dt
    return logarithm[:nx, :nx], logarithm[:nx, nx:]


def _check_logarithm(A: np.ndarray, dt: float) -> None:
    finite = np.all(np.isfinite(A), axis=(-2, -1))
    poles = np.linalg.eigvals(A[finite])
    # Roots of a real logarithm's path closer than this to the axis are not told apart from it.
    on_axis = (poles.real <= 0.0) & (np.abs(poles.imag) <= 1e-5 * np.abs(poles))
    if np.any(on_axis):
        raise ValueError(
            f"A has a pole at z = {poles[on_axis][0].real:.6g} on the closed negative real axis, "
            f"so no continuous-time model of this order gives it with a zero-order hold at dt = "
            f"{dt} s. Use to_continuous(Tustin()), or identify with a smaller sample time."
        )
