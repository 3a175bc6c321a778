"""All eigenvalues at once by the Ehrlich-Aberth iteration: products and solves, no QR algorithm.

L. W. Ehrlich, Commun. ACM 10 (1967) 107-108; O. Aberth, Math. Comp. 27 (1973) 339-344. Every root
takes a Newton step in which the other roots are divided out,

    x_i <- x_i - N_i / (1 - N_i sum_{j != i} 1 / (x_i - x_j)),    N = p / p',

so that all move in parallel: a batch of small problems fills a device on which LAPACK's QR
algorithm does not exist or runs one matrix at a time. Simple roots converge with order three.
"""

from collections.abc import Callable

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Complex, Float

from lpvid._types import Scalar

_STEPS = 120
# Turns of the golden angle: starts without any symmetry, which the iteration could not break.
_GOLDEN_ANGLE = 2.399963229728653


def _iterate(
    newton: Callable[[Array], Array], start: Complex[Array, " root"], size: Float[Array, " root"]
) -> tuple[Complex[Array, " root"], Bool[Array, ""]]:
    """Roots and whether all came to rest, at rounding errors of `size` or where steps stop falling.

    `newton` gives p / p' at every point.
    """
    count = start.shape[0]
    itself = jnp.eye(count, dtype=bool)

    def advance(carry):
        roots, previous, resting, step = carry
        correction = newton(roots)
        gaps = jnp.where(itself, 1.0, roots[:, None] - roots[None, :])
        inverse = jnp.where(itself | (gaps == 0.0), 0.0, 1.0 / jnp.where(gaps == 0.0, 1.0, gaps))
        change = correction / (1.0 - correction * jnp.sum(inverse, axis=1))
        # Not finite: p vanishes to the last bit, or a start sits where the steps cancel.
        change = jnp.where(jnp.isfinite(change.real) & jnp.isfinite(change.imag), change, 0.0)
        length = jnp.abs(change)
        stalled = (length >= 0.8 * previous) & (length <= 1e-7 * size)
        roots = jnp.where(resting, roots, roots - change)
        return roots, length, resting | stalled | (length <= 4e-16 * size), step + 1

    roots, _, resting, _ = lax.while_loop(
        lambda carry: ~jnp.all(carry[2]) & (carry[3] < _STEPS),
        advance,
        (start, jnp.full(count, jnp.inf), jnp.zeros(count, bool), jnp.array(0)),
    )
    return roots, jnp.all(resting)


def eigenvalues(
    matrix: Float[Array, "n n"],
) -> tuple[Complex[Array, " n"], Bool[Array, ""]]:
    """Eigenvalues of a real matrix, and whether the iteration came to rest.

    Here p / p' = 1 / tr (x I - M)^-1, from one LU factorisation a root and step.
    """
    n = matrix.shape[0]
    eye = jnp.eye(n, dtype=complex)
    # The singular values' product is that of the moduli: each start at about the right distance.
    radii = jnp.linalg.svd(matrix, compute_uv=False)
    size = jnp.where(radii[0] > 0.0, radii[0], 1.0)
    radii = jnp.maximum(radii, 1e-8 * size)
    angle = _GOLDEN_ANGLE * jnp.arange(n, dtype=float) + 0.7
    start = lax.complex(radii * jnp.cos(angle), radii * jnp.sin(angle))

    def newton(roots):
        shifted = roots[:, None, None] * eye[None] - matrix[None].astype(complex)
        inverse = jnp.linalg.solve(shifted, jnp.broadcast_to(eye, shifted.shape))
        return 1.0 / jnp.trace(inverse, axis1=1, axis2=2)

    roots, resting = _iterate(newton, start, jnp.full(n, size))
    # A real root is found beside the axis by a rounding error.
    real = jnp.abs(roots.imag) <= 1e-14 * size
    return lax.complex(roots.real, jnp.where(real, 0.0, roots.imag)), resting


def eigenvectors(matrix: Float[Array, "n n"], poles: Complex[Array, " n"]) -> Complex[Array, "n n"]:
    """Columns of unit length by two steps of inverse iteration.

    Repeated eigenvalues get one vector, so the result is singular and is not to be trusted.
    """
    n = matrix.shape[0]
    eye = jnp.eye(n, dtype=poles.dtype)
    size = jnp.sqrt(jnp.sum(matrix * matrix))
    # Off the eigenvalue by rounding, so that the factorisation has no zero pivot.
    offset = 2e-16 * jnp.where(size > 0.0, size, 1.0)
    shifts = poles + lax.complex(0.8 * offset, 0.6 * offset)
    pencils = shifts[:, None, None] * eye[None] - matrix[None].astype(complex)
    vectors = jnp.broadcast_to(
        jnp.cos(1.0 + jnp.arange(n, dtype=float) ** 2)[None, :, None], (n, n, 1)
    )
    vectors = vectors.astype(poles.dtype)
    for _ in range(2):
        vectors = jnp.linalg.solve(pencils, vectors)
        lengths = jnp.sqrt(jnp.sum(jnp.abs(vectors) ** 2, axis=1, keepdims=True))
        vectors = vectors / lengths.astype(vectors.dtype)
    return vectors[:, :, 0].T


def rational_zeros(
    limit: Scalar, weights: Complex[Array, " n"], nodes: Complex[Array, " n"]
) -> tuple[Complex[Array, " n"], Bool[Array, ""]]:
    """Zeros of limit + sum_k weights_k / (x - nodes_k), and whether the iteration came to rest.

    The polynomial is f times the product of the (x - nodes_k): p'/p = f'/f + sum_k 1/(x - nodes_k).
    The nearest node's fraction is multiplied out first, or a zero beside a pole would be lost to
    cancellation.
    """
    n = nodes.shape[0]
    itself = jnp.eye(n, dtype=bool)
    limit = limit.astype(nodes.dtype)

    def inverse(gaps, left_out):
        empty = left_out | (gaps == 0.0)
        return jnp.where(empty, 0.0, 1.0 / jnp.where(empty, 1.0, gaps))

    def newton(roots):
        gaps = roots[:, None] - nodes[None, :]
        nearest = jnp.argmin(jnp.abs(gaps), axis=1)
        others = inverse(gaps, nearest[:, None] == jnp.arange(n)[None, :])
        gap = jnp.take_along_axis(gaps, nearest[:, None], axis=1)[:, 0]
        terms = weights[None, :] * others
        rest = limit + jnp.sum(terms, axis=1)
        value = gap * rest + weights[nearest]
        slope = rest - gap * jnp.sum(terms * others, axis=1)
        return value / (slope + value * jnp.sum(others, axis=1))

    # One Newton step from each node: where its own fraction balances all others.
    others = inverse(nodes[:, None] - nodes[None, :], itself)
    rest = limit + jnp.sum(weights[None, :] * others, axis=1)
    step = weights / jnp.where(rest == 0.0, 1.0, rest)
    largest = jnp.max(jnp.abs(nodes))
    # A first step beyond the farthest node says little; turned, to break the symmetry.
    far = jnp.abs(step) > largest
    shortened = step * (largest / jnp.where(far, jnp.abs(step), 1.0)).astype(step.dtype)
    step = jnp.where(far, shortened * (0.8 + 0.6j), step)
    start = nodes - step * (1.0 + 1e-3j)
    return _iterate(newton, start, jnp.maximum(jnp.abs(nodes), 1e-3 * largest))
