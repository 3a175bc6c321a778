"""Splines in the scheduling variable."""

import math
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.models._scheduling import AbstractBasis, AbstractDependence
from lpvid.models._state_space import Numbers

_CUBIC = 3


class SplineBasis(AbstractBasis):
    """Piecewise polynomials of each scheduling variable, and their products for several.

    Beyond the first and the last knot every function goes on along its tangent. Differentiable in
    κ, up to the order at which the pieces meet smoothly.

    Attributes:
        knots: of each variable, rising.
        pieces: of each variable, the coefficients of the powers of κ less the knot before it, of
            every function: before the first knot, between the knots, after the last.
    """

    knots: tuple[Float[Array, " _"], ...]
    pieces: tuple[Float[Array, "_ _ _"], ...]

    @property
    def size(self) -> int:
        """Number of basis functions."""
        return math.prod(piece.shape[-1] for piece in self.pieces)

    def __call__(self, kappa: Numbers) -> Float[Array, "*batch basis"]:
        """Values of all basis functions at κ, shape (…, n_scheduling) → (…, size)."""
        kappa = jnp.asarray(kappa, float)
        product = jnp.ones((*kappa.shape[:-1], 1))
        for k, (knots, pieces) in enumerate(zip(self.knots, self.pieces, strict=True)):
            values = _evaluated(kappa[..., k], knots, pieces)
            product = product[..., :, None] * values[..., None, :]
            product = product.reshape(*kappa.shape[:-1], -1)
        return product


def _evaluated(kappa: Array, knots: Array, pieces: Array) -> Array:
    index = jnp.searchsorted(knots, kappa, side="right")
    # The piece before the first knot counts from that knot too.
    step = (kappa - jnp.concatenate([knots[:1], knots])[index])[..., None]
    chosen = pieces[index]
    value = chosen[..., -1, :]
    for power in range(pieces.shape[1] - 2, -1, -1):
        value = value * step + chosen[..., power, :]
    return value


class Spline(AbstractDependence):
    """Spline dependence on κ, a tensor product for several scheduling variables.

    With as many knots as points the natural spline passes through the local models; its
    coefficients are the values of ϑ at the knots. Fewer knots smooth. The points must determine the
    spline: with several variables, lie on a grid or thereabouts.

    Attributes:
        knots: of each scheduling variable, the two ends among them; at the points' own values when
            left out.
        degree: of the pieces; 3 by default.
        natural: whether the second derivative vanishes at both ends (cubic only); with
            `natural=False` a B-spline basis, which has `degree − 1` functions more than knots.

    Raises:
        ValueError: fewer than two knots, knots that do not rise, a degree below one, or a natural
            spline that is not cubic.

    Example:
        >>> basis = Spline(knots=(0.0, 1.0, 2.0)).basis([0.0, 2.0])
        >>> basis([0.5]).round(6).tolist()
        [0.40625, 0.6875, -0.09375]
    """

    knots: tuple[tuple[float, ...], ...] | None = eqx.field(static=True)
    degree: int = eqx.field(static=True)
    natural: bool = eqx.field(static=True)

    def __init__(
        self,
        knots: Sequence | np.ndarray | None = None,
        degree: int = _CUBIC,
        natural: bool = True,
    ):
        self.degree, self.natural = degree, natural
        if degree < 1 or (natural and degree != _CUBIC):
            raise ValueError(
                f"degree: a natural spline is cubic, got {degree}; for degrees from 1 on give "
                "natural=False."
            )
        self.knots = None
        if knots is not None:
            single = len(knots) == 0 or np.ndim(knots[0]) == 0
            each = [knots] if single else knots
            self.knots = tuple(tuple(float(knot) for knot in row) for row in each)
            for row in self.knots:
                if len(row) < 2 or not np.all(np.diff(row) > 0):
                    raise ValueError(f"knots: two or more rising numbers are needed, got {row}.")

    def basis(self, points: Numbers) -> SplineBasis:
        """The basis with the declared knots, or with knots at the points (n, n_scheduling).

        Raises:
            ValueError: knots are declared for another number of variables, or all points share one
                value of a variable.
        """
        values = np.asarray(points, float)
        values = values[:, None] if values.ndim == 1 else values
        knots = self.knots
        if knots is None:
            knots = tuple(tuple(np.unique(column).tolist()) for column in values.T)
        if len(knots) != values.shape[1] or min(len(row) for row in knots) < 2:
            raise ValueError(
                f"knots: two or more are needed for each of {values.shape[1]} scheduling "
                f"variable(s), got {[len(row) for row in knots]}."
            )
        pieces = tuple(jnp.asarray(self._pieces(np.array(row))) for row in knots)
        return SplineBasis(tuple(jnp.asarray(row) for row in knots), pieces)

    def _pieces(self, knots: np.ndarray) -> np.ndarray:
        from scipy.interpolate import BSpline

        degree = self.degree
        count = len(knots) + degree - 1
        clamped = np.concatenate([[knots[0]] * degree, knots, [knots[-1]] * degree])
        spline = BSpline(clamped, np.eye(count), degree)
        left = knots[:-1]
        orders = range(degree + 1)
        inner = [spline.derivative(order)(left) / math.factorial(order) for order in orders]
        pieces = np.stack(inner, axis=1)
        first, last = np.zeros((2, 1, degree + 1, count))
        first[0, :2] = pieces[0, :2]
        width = knots[-1] - knots[-2]
        powers = width ** np.arange(degree + 1)
        last[0, 0] = powers @ pieces[-1]
        last[0, 1] = (np.arange(1, degree + 1) * powers[:-1]) @ pieces[-1, 1:]
        pieces = np.concatenate([first, pieces, last])
        if not self.natural:
            return pieces
        bends = spline.derivative(2)(knots[[0, -1]])
        conditions = np.concatenate([spline(knots), bends])
        return pieces @ np.linalg.solve(conditions, np.eye(count, len(knots)))
