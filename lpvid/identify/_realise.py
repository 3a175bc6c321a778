"""From the range of the observability matrix to A and C; stability."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float, Int


def left_range(
    matrix: Float[Array, "row column"], *, squared: bool
) -> tuple[Float[Array, "row row"], Float[Array, " row"]]:
    """Left singular vectors and singular values, largest first.

    Args:
        matrix: whose range is looked for.
        squared: take them from the eigenvectors of the matrix times its transpose, which is faster
            and loses nothing where the matrix already comes from a Gram matrix.
    """
    if squared:
        values, vectors = jnp.linalg.eigh(matrix @ matrix.T, symmetrize_input=False)
        return vectors[:, ::-1], jnp.sqrt(jnp.maximum(values[::-1], 0.0))
    rows = matrix.shape[0]
    # The factor of Mᵀ is square and has the same left vectors at half the cost.
    small = jnp.linalg.qr(matrix.T, mode="r").T if matrix.shape[1] > rows else matrix
    vectors, values, _ = jnp.linalg.svd(small, full_matrices=True)
    return vectors, jnp.pad(values, (0, rows - values.shape[0]))


def realise(
    observability: Float[Array, "row nx"], ny: int
) -> tuple[Float[Array, "nx nx"], Float[Array, "ny nx"]]:
    """A from the shift of the observability matrix's block rows, C its first block row."""
    orthonormal, triangle = jnp.linalg.qr(observability[:-ny])
    A = jax.scipy.linalg.solve_triangular(triangle, orthonormal.T @ observability[ny:])
    return A, observability[:ny]


def spectral_radius(A: Float[Array, "nx nx"]) -> Float[Array, ""]:
    r"""Largest modulus of A's eigenvalues by Gelfand's formula, $\|A^{2^k}\|^{2^{-k}}$.

    Squarings only, so that it runs on every device; k = 30 leaves a relative error of about the
    logarithm of the eigenvectors' condition number times $10^{-9}$. Not for gradients: those of the
    norms do not converge to that of the radius where the largest eigenvalues are a complex pair.
    """

    def square(k, carry):
        power, log_norm = carry
        power = power @ power
        norm = jnp.linalg.norm(power)
        norm = jnp.where(norm > 0.0, norm, 1.0)
        return power / norm, log_norm + jnp.log(norm) * 0.5 ** (k + 1)

    norm = jnp.linalg.norm(A)
    safe = jnp.where(norm > 0.0, norm, 1.0)
    power, log_norm = jax.lax.fori_loop(0, 30, square, (A / safe, jnp.log(safe)))
    radius = jnp.where(jnp.linalg.norm(power) > 0.0, jnp.exp(log_norm), 0.0)
    return jnp.where(jnp.isfinite(norm), radius, jnp.nan)


def move_inside(
    A: Float[Array, "nx nx"], radius: float
) -> tuple[Float[Array, "nx nx"], Int[Array, ""]]:
    """A with the eigenvalues outside `radius` moved onto it along their rays, and their count.

    The eigenvectors stay. Not differentiable: eigenvectors of a non-symmetric matrix.
    """
    poles, vectors = jnp.linalg.eig(A)
    modulus = jnp.abs(poles)
    outside = modulus > radius
    factor = jnp.where(outside, radius / jnp.where(outside, modulus, 1.0), 1.0)
    moved = _similar(vectors, poles * factor.astype(poles.dtype))
    return jnp.where(jnp.any(outside), moved, A), jnp.sum(outside)


def _similar(vectors: Complex[Array, "nx nx"], poles: Complex[Array, " nx"]) -> Array:
    return jnp.linalg.solve(vectors.T, (vectors * poles[None, :]).T).T.real
