"""The convex hull of scheduling points: where a model interpolates, and where not."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.models._state_space import Numbers

# Singular values below this share of the largest belong to points on a flat.
_FLAT = 1e-9


class ConvexHull(eqx.Module):
    """Half-spaces n · κ ≤ b whose intersection is the hull.

    Rows are scaled so that n · κ − b is a distance with each scheduling variable in units of half
    its range. Points on a line or plane have a hull as flat: two opposite half-spaces.

    Attributes:
        normals: outward, one a facet.
        offsets: b.

    Example:
        >>> triangle = convex_hull([[0.0, 0.0], [2.0, 0.0], [0.0, 2.0]])
        >>> triangle.distance([[0.5, 0.5], [1.5, 1.5]]).round(3).tolist()
        [0.0, 0.707]
    """

    normals: Float[Array, "facet scheduling"]
    offsets: Float[Array, " facet"]

    def distance(self, kappa: Numbers) -> Float[Array, "*batch"]:
        """How far κ (…, n_scheduling) lies outside; zero inside, and only there.

        The distance to the farthest of the half-spaces: that to the hull itself, except beyond its
        edges and corners, where it is less. Works under `jit` and `vmap`.
        """
        kappa = jnp.asarray(kappa, float)
        excess = kappa @ self.normals.T
        excess = excess - jnp.broadcast_to(self.offsets, excess.shape)
        return jnp.maximum(jnp.max(excess, axis=-1), 0.0)

    def intersection(self, other: "ConvexHull") -> "ConvexHull":
        """The points that lie in both."""
        return ConvexHull(
            jnp.concatenate([self.normals, other.normals]),
            jnp.concatenate([self.offsets, other.offsets]),
        )


def convex_hull(points: Numbers) -> ConvexHull:
    """The convex hull of scheduling points, by Qhull; also of points on a line or plane.

    Args:
        points: shape (n_points,) or (n_points, n_scheduling).

    Raises:
        ValueError: there is no point, or one is not finite.

    Example:
        >>> convex_hull([3.0, 1.0, 2.0]).distance([[0.0], [1.0], [2.5]]).tolist()
        [1.0, 0.0, 0.0]
    """
    values = np.asarray(points, float)
    values = values[:, None] if values.ndim == 1 else values
    if values.ndim != 2 or not values.size or not np.all(np.isfinite(values)):
        raise ValueError(
            f"points: finite values of shape (n_points, n_scheduling) are needed, got shape "
            f"{values.shape}."
        )
    low, high = values.min(axis=0), values.max(axis=0)
    centre, half = (low + high) / 2.0, np.where(high > low, (high - low) / 2.0, 1.0)
    scaled = (values - centre) / half
    origin = scaled.mean(axis=0)
    # Of the triangle alone: many points would make a square matrix of their number.
    _, sizes, directions = np.linalg.svd(np.linalg.qr(scaled - origin, mode="r"))
    rank = int(np.sum(sizes > _FLAT * max(sizes[0], 1.0)))
    along, across = directions[:rank], directions[rank:]
    inner, inner_offsets = _facets((scaled - origin) @ along.T)
    normals = np.concatenate([inner @ along, across, -across])
    offsets = np.concatenate([inner_offsets, np.zeros(2 * len(across))]) + normals @ origin
    normals = normals / half
    return ConvexHull(jnp.asarray(normals), jnp.asarray(offsets + normals @ centre))


def _facets(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Outward normals and offsets of a hull that is not flat, in any number of dimensions."""
    rank = points.shape[1]
    if rank == 0:
        return np.zeros((0, 0)), np.zeros(0)
    if rank == 1:
        ends = np.array([points.max(), -points.min()])
        return np.array([[1.0], [-1.0]]), ends
    from scipy.spatial import ConvexHull as Qhull

    # Facets of more corners than a simplex come in pieces that share one equation.
    equations = Qhull(points).equations
    _, first = np.unique(equations.round(10), axis=0, return_index=True)
    return equations[first, :-1], -equations[first, -1]
