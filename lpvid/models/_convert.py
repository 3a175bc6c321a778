"""Discretisation and its inverse, as swappable methods on matrices."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Matrices = tuple[
    Float[Array, "*batch nx nx"],
    Float[Array, "*batch nx nu"],
    Float[Array, "*batch ny nx"],
    Float[Array, "*batch ny nu"],
]


class AbstractConversion(eqx.Module):
    """How a model passes between continuous and discrete time."""

    @abc.abstractmethod
    def discretise(self, A: Array, B: Array, C: Array, D: Array, dt: float) -> Matrices:
        """Discrete-time matrices for sample time `dt`."""

    @abc.abstractmethod
    def to_continuous(self, A: Array, B: Array, C: Array, D: Array, dt: float) -> Matrices:
        """Continuous-time matrices of a model with sample time `dt`."""


def _augmented(A: Array, B: Array) -> Array:
    nu = B.shape[-1]
    lower = jnp.zeros((*A.shape[:-2], nu, A.shape[-1] + nu))
    return jnp.concatenate([jnp.concatenate([A, B], axis=-1), lower], axis=-2)


class ZeroOrderHold(AbstractConversion):
    """Exact for inputs held constant between samples; D is unchanged."""

    def discretise(self, A: Array, B: Array, C: Array, D: Array, dt: float) -> Matrices:
        """Matrix exponential of [[A, B], [0, 0]] dt."""
        nx = A.shape[-1]
        exponential = jax.scipy.linalg.expm(_augmented(A, B) * dt)
        return exponential[..., :nx, :nx], exponential[..., :nx, nx:], C, D

    def to_continuous(self, A: Array, B: Array, C: Array, D: Array, dt: float) -> Matrices:
        """Matrix logarithm of [[A, B], [0, I]]."""
        raise NotImplementedError


class Tustin(AbstractConversion):
    """Bilinear rule s = (2 / dt)(z − 1)/(z + 1); a feedthrough appears."""

    def discretise(self, A: Array, B: Array, C: Array, D: Array, dt: float) -> Matrices:
        """Bilinear transform to discrete time."""
        raise NotImplementedError

    def to_continuous(self, A: Array, B: Array, C: Array, D: Array, dt: float) -> Matrices:
        """Bilinear transform to continuous time."""
        raise NotImplementedError
