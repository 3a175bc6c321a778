"""Functions of the scheduling variable: the bases that LPV parameters are expanded in."""

import abc
import itertools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.models._state_space import Numbers


class AbstractBasis(eqx.Module):
    """Functions of κ, φ(κ): the parameters are their linear combinations."""

    @property
    @abc.abstractmethod
    def size(self) -> int:
        """Number of basis functions."""

    @abc.abstractmethod
    def __call__(self, kappa: Numbers) -> Float[Array, "*batch basis"]:
        """Values of all basis functions at κ, shape (…, n_scheduling) → (…, size)."""


class AbstractDependence(eqx.Module):
    """How the parameters depend on κ: the method of `interpolate`."""

    @abc.abstractmethod
    def basis(self, points: Numbers) -> AbstractBasis:
        """The basis for local models at these points, shape (n_points, n_scheduling)."""


class Polynomial(AbstractDependence):
    """Polynomial dependence on κ, up to a total degree (001, equation 35).

    Attributes:
        degree: total degree, 0 or more; or `"auto"`, chosen by leaving one point out.

    Raises:
        ValueError: the degree is neither a whole number from 0 nor `"auto"`.

    Example:
        >>> Polynomial(degree=2).degree
        2
    """

    degree: int | str = eqx.field(static=True, default=2)

    def __check_init__(self):
        if self.degree != "auto" and not (isinstance(self.degree, int) and self.degree >= 0):
            raise ValueError(
                f"degree: a whole number from 0 or 'auto' is needed, got {self.degree!r}."
            )

    def basis(self, points: Numbers) -> "PolynomialBasis":
        """The monomials up to the degree, centred on the points.

        Raises:
            ValueError: the degree is `"auto"`, which only local models can tell.
        """
        if self.degree == "auto":
            raise ValueError("degree: 'auto' is chosen by interpolate; give a number here.")
        return polynomial_basis(points, int(self.degree))


class PolynomialBasis(AbstractBasis):
    """The monomials of κ up to a total degree, in κ centred and scaled to [−1, 1].

    Centring keeps the least-squares problem well conditioned.

    Attributes:
        centre: middle of the range of each scheduling variable.
        half_range: half its width.
        exponents: of each basis function, one for each scheduling variable.
    """

    centre: Float[Array, " scheduling"]
    half_range: Float[Array, " scheduling"]
    exponents: tuple[tuple[int, ...], ...] = eqx.field(static=True)

    @property
    def size(self) -> int:
        """Number of basis functions."""
        return len(self.exponents)

    def __call__(self, kappa: Numbers) -> Float[Array, "*batch basis"]:
        """Values of all basis functions at κ, shape (…, n_scheduling) → (…, size)."""
        kappa = jnp.asarray(kappa, float)
        centre = jnp.broadcast_to(self.centre, kappa.shape)
        scaled = (kappa - centre) / jnp.broadcast_to(self.half_range, kappa.shape)
        columns = [
            jnp.prod(
                jnp.stack([scaled[..., k] ** power for k, power in enumerate(powers)], axis=-1),
                axis=-1,
            )
            for powers in self.exponents
        ]
        return jnp.stack(columns, axis=-1)


class JoinedBasis(AbstractBasis):
    """The functions of two bases, one after the other: of two LPV models connected to one.

    Attributes:
        first: of the first model.
        second: of the second.
    """

    first: AbstractBasis
    second: AbstractBasis

    @property
    def size(self) -> int:
        """Number of basis functions."""
        return self.first.size + self.second.size

    def __call__(self, kappa: Numbers) -> Float[Array, "*batch basis"]:
        """Values of all basis functions at κ, shape (…, n_scheduling) → (…, size)."""
        return jnp.concatenate([self.first(kappa), self.second(kappa)], axis=-1)


def polynomial_basis(kappas: Numbers, degree: int) -> PolynomialBasis:
    """The polynomial basis up to a total degree, centred on given points.

    Args:
        kappas: points, shape (n_points,) or (n_points, n_scheduling).
        degree: largest sum of the exponents.

    Example:
        >>> polynomial_basis([0.0, 2.0], 2)([1.5]).tolist()
        [1.0, 0.5, 0.25]
    """
    points = np.asarray(kappas, float)
    points = points[:, None] if points.ndim == 1 else points
    low, high = points.min(axis=0), points.max(axis=0)
    half_range = np.where(high > low, (high - low) / 2, 1.0)
    exponents = [
        powers
        for powers in itertools.product(range(degree + 1), repeat=points.shape[1])
        if sum(powers) <= degree
    ]
    exponents.sort(key=lambda powers: (sum(powers), tuple(-p for p in powers)))
    return PolynomialBasis(
        centre=jnp.asarray((low + high) / 2),
        half_range=jnp.asarray(half_range),
        exponents=tuple(exponents),
    )
