"""Where the eigenvalues behind an H-infinity norm come from: LAPACK, or all roots at once."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
from jaxtyping import Array, Bool, Complex, Float

from lpvid._types import Scalar
from lpvid.analysis import _simultaneous as simultaneous


class AbstractEigensolver(eqx.Module):
    """How an H-infinity norm finds poles and level sets. Every method takes one matrix.

    Example:
        >>> from lpvid.analysis import AbstractEigensolver, SimultaneousIteration
        >>> isinstance(SimultaneousIteration(), AbstractEigensolver)
        True
    """

    @abc.abstractmethod
    def eigenvectors(
        self, matrix: Float[Array, "n n"]
    ) -> tuple[Complex[Array, " n"], Complex[Array, "n n"]]:
        """Eigenvalues and unit eigenvectors; a singular matrix of those where there are too few."""

    @abc.abstractmethod
    def eigenvalues(
        self, matrix: Float[Array, "n n"]
    ) -> tuple[Complex[Array, " n"], Bool[Array, ""]]:
        """Eigenvalues, and whether all were found."""

    @abc.abstractmethod
    def zeros(
        self, limit: Scalar, weights: Complex[Array, " n"], poles: Complex[Array, " n"]
    ) -> tuple[Complex[Array, " n"], Bool[Array, ""]]:
        """Zeros x of limit + sum_k weights_k / (x - poles_k^2), and whether all were found."""

    @abc.abstractmethod
    def reduce(
        self, matrix: Float[Array, "n n"]
    ) -> tuple[Complex[Array, "n n"], Complex[Array, "n n"]]:
        """T and a unitary Q with Q T Q^H the matrix, T of the form that `solve` expects."""

    @abc.abstractmethod
    def solve(
        self, pencils: Complex[Array, "frequency n n"], right: Complex[Array, "frequency n m"]
    ) -> Complex[Array, "frequency n m"]:
        """Solutions of (s I - T) X = right."""


class Lapack(AbstractEigensolver):
    """LAPACK's QR algorithm and Schur form: fastest on a CPU, and runs nowhere else.

    Example:
        >>> from lpvid.analysis import Lapack
        >>> poles, found = Lapack().eigenvalues(jnp.array([[0.0, 1.0], [-4.0, 0.0]]))
        >>> bool(found), jnp.abs(poles.imag).round(6).tolist()
        (True, [2.0, 2.0])
    """

    def eigenvectors(
        self, matrix: Float[Array, "n n"]
    ) -> tuple[Complex[Array, " n"], Complex[Array, "n n"]]:
        """Conjugate pairs are adjacent, the positive imaginary part first."""
        poles, vectors = jnp.linalg.eig(matrix)
        return poles, vectors

    def eigenvalues(
        self, matrix: Float[Array, "n n"]
    ) -> tuple[Complex[Array, " n"], Bool[Array, ""]]:
        """Always found."""
        return jnp.linalg.eigvals(matrix), jnp.array(True)

    def zeros(
        self, limit: Scalar, weights: Complex[Array, " n"], poles: Complex[Array, " n"]
    ) -> tuple[Complex[Array, " n"], Bool[Array, ""]]:
        """Eigenvalues of a diagonal plus rank-one matrix, for poles in pairs as `eigenvectors`'.

        The pairs become real 2 x 2 blocks: a real eigenproblem costs half of a complex one.
        """
        squares = poles * poles
        head = poles.imag > 0.0
        tail = poles.imag < 0.0
        weights = weights * (-1.0 / limit).astype(weights.dtype)
        spread = jnp.sqrt(jnp.abs(weights))
        spread = jnp.where(spread > 0.0, spread, 1.0)
        column = weights / spread.astype(weights.dtype)
        # rho / (x - mu) + conj = [1, 0] (x - block)^-1 [2 Re, -2 Im] of the pair's head.
        following = jnp.roll(column.imag, 1)
        column_real = jnp.where(
            head, 2.0 * column.real, jnp.where(tail, -2.0 * following, column.real)
        )
        row = jnp.where(tail, 0.0, spread)
        upper = jnp.where(head, squares.imag, 0.0)[:-1]
        matrix = jnp.diag(squares.real) + jnp.diag(upper, 1) - jnp.diag(upper, -1)
        paired = jnp.where(head, jnp.abs(jnp.roll(poles, -1) - poles.conj()), 0.0)
        roots = jnp.linalg.eigvals(matrix + column_real[:, None] * row[None, :])
        return roots, jnp.all(paired <= 1e-12 * jnp.abs(poles))

    def reduce(
        self, matrix: Float[Array, "n n"]
    ) -> tuple[Complex[Array, "n n"], Complex[Array, "n n"]]:
        """Complex Schur form: exists for every matrix, defective ones included."""
        T, Q = jsl.schur(matrix, output="complex")
        return T, Q

    def solve(
        self, pencils: Complex[Array, "frequency n n"], right: Complex[Array, "frequency n m"]
    ) -> Complex[Array, "frequency n m"]:
        """Back substitution."""
        return jsl.solve_triangular(pencils, right)


class SimultaneousIteration(AbstractEigensolver):
    """The Ehrlich-Aberth iteration and batched LU solves: every device, the same result.

    All roots of all systems of a batch move at once, so a GPU is filled; LAPACK's non-symmetric
    Schur form does not exist there, and its eigenvalues take one matrix after the other. On a CPU
    it costs up to a hundred times more than `Lapack`.

    Example:
        >>> from lpvid.analysis import SimultaneousIteration
        >>> poles, found = SimultaneousIteration().eigenvalues(jnp.array([[0.0, 1.0], [-4.0, 0.0]]))
        >>> bool(found), jnp.abs(poles.imag).round(6).tolist()
        (True, [2.0, 2.0])
    """

    def eigenvectors(
        self, matrix: Float[Array, "n n"]
    ) -> tuple[Complex[Array, " n"], Complex[Array, "n n"]]:
        """By inverse iteration; repeated eigenvalues share one vector."""
        poles, resting = simultaneous.eigenvalues(matrix)
        vectors = simultaneous.eigenvectors(matrix, poles)
        # Poles that were not found must not be trusted: NaN, which every later check refuses.
        return poles, jnp.where(resting, vectors, jnp.nan)

    def eigenvalues(
        self, matrix: Float[Array, "n n"]
    ) -> tuple[Complex[Array, " n"], Bool[Array, ""]]:
        """By Newton steps on the characteristic polynomial, the other roots divided out."""
        return simultaneous.eigenvalues(matrix)

    def zeros(
        self, limit: Scalar, weights: Complex[Array, " n"], poles: Complex[Array, " n"]
    ) -> tuple[Complex[Array, " n"], Bool[Array, ""]]:
        """By the same iteration on the fractions: O(n^2) a step and no matrix."""
        return simultaneous.rational_zeros(limit, weights, poles * poles)

    def reduce(
        self, matrix: Float[Array, "n n"]
    ) -> tuple[Complex[Array, "n n"], Complex[Array, "n n"]]:
        """The matrix as it is."""
        return matrix.astype(complex), jnp.eye(matrix.shape[0], dtype=complex)

    def solve(
        self, pencils: Complex[Array, "frequency n n"], right: Complex[Array, "frequency n m"]
    ) -> Complex[Array, "frequency n m"]:
        """One LU factorisation a frequency."""
        return jnp.linalg.solve(pencils, right)


def default_eigensolver() -> AbstractEigensolver:
    """LAPACK where the default device is a CPU, the simultaneous iteration elsewhere."""
    return Lapack() if jax.default_backend() == "cpu" else SimultaneousIteration()
