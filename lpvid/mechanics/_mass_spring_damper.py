"""Mass–spring–damper M ÿ + D ẏ + K y = u (Olofsson et al. 2014)."""

from collections.abc import Sequence
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from lpvid.models import StateSpace

Rows: TypeAlias = ArrayLike | Sequence[Sequence[float]]


class UndampedModes(eqx.Module):
    """Undamped modes of a mass–spring–damper, in ascending frequency.

    Attributes:
        frequencies: ω (mode,), rad/s.
        shapes: mode shapes as columns (dof, mode), scaled so that Vᵀ M V = I.
        damping_ratios: ζ (mode,) = φᵀ D φ / (2 ω), exact where V diagonalises D.
    """

    frequencies: Float[Array, " mode"]
    shapes: Float[Array, "dof mode"]
    damping_ratios: Float[Array, " mode"]


class MassSpringDamper(eqx.Module):
    """M ÿ + D ẏ + K y = u, forces in, displacements out.

    Attributes:
        mass: M (dof, dof), kg, symmetric positive definite.
        damping: D (dof, dof), N·s/m, symmetric.
        stiffness: K (dof, dof), N/m, symmetric.

    Raises:
        ValueError: if shapes differ, a matrix is not symmetric or M is not positive definite
            (values are checked only outside of jit).

    Example:
        >>> MassSpringDamper.reference().state_space().nx
        4
    """

    mass: Float[Array, "dof dof"]
    damping: Float[Array, "dof dof"]
    stiffness: Float[Array, "dof dof"]

    def __init__(self, mass: Rows, damping: Rows, stiffness: Rows):
        self.mass = jnp.asarray(mass, float)
        self.damping = jnp.asarray(damping, float)
        self.stiffness = jnp.asarray(stiffness, float)
        for name, matrix in vars(self).items():
            if matrix.ndim != 2 or matrix.shape != self.mass.shape[:1] * 2:
                raise ValueError(f"{name} has shape {matrix.shape}: give square matrices (n, n).")
            if isinstance(matrix, Tracer):
                continue
            numbers = np.asarray(matrix)
            if np.abs(numbers - numbers.T).max() > 1e-10 * np.abs(numbers).max():
                raise ValueError(f"{name} is not symmetric: give (X + X.T) / 2 if that is meant.")
            if name == "mass" and not np.linalg.eigvalsh(numbers).min() > 0.0:
                raise ValueError(
                    "mass is not positive definite: every direction needs inertia; "
                    "eliminate massless coordinates first."
                )

    @classmethod
    def reference(cls) -> "MassSpringDamper":
        """The two-mass system of the reference study.

        Example:
            >>> MassSpringDamper.reference().mass
            Array([[ 5., -1.],
                   [-1.,  1.]], dtype=float64)
        """
        return cls(
            mass=[[5.0, -1.0], [-1.0, 1.0]],
            damping=[[5.0, -0.01], [-0.01, 1.0]],
            stiffness=[[100.0, -5.0], [-5.0, 100.0]],
        )

    @classmethod
    def micro_manipulator(cls) -> "MassSpringDamper":
        """Two axes of the micro-manipulator of Olofsson et al., modes at 83.1 and 96.7 Hz.

        Example:
            >>> MassSpringDamper.micro_manipulator().modes().frequencies / (2 * jnp.pi)
            Array([83..., 96...], dtype=float64)
        """
        return cls(
            mass=1e-5 * jnp.array([[0.0487, 0.0001], [0.0001, 0.3669]]),
            damping=1e-3 * jnp.array([[0.0407, 0.0302], [0.0302, 0.1484]]),
            stiffness=[[0.1793, 0.0147], [0.0147, 1.0049]],
        )

    def state_space(self) -> StateSpace:
        """Continuous-time model with states [y, ẏ], inputs u in N, outputs y in m.

        Example:
            >>> MassSpringDamper.reference().state_space().C.shape
            (2, 4)
        """
        dof = self.mass.shape[0]
        zero, identity = jnp.zeros((dof, dof)), jnp.eye(dof)
        solved = jnp.linalg.solve(
            self.mass, jnp.concatenate([-self.stiffness, -self.damping, identity], axis=1)
        )
        position_rates = jnp.concatenate([zero, identity], axis=1)
        return StateSpace(
            A=jnp.concatenate([position_rates, solved[:, : 2 * dof]]),
            B=jnp.concatenate([zero, solved[:, 2 * dof :]]),
            C=jnp.concatenate([identity, zero], axis=1),
        )

    def modes(self) -> UndampedModes:
        """Solve K v = ω² M v by the Cholesky factor of M; gradients need distinct frequencies.

        A negative eigenvalue (K not positive semidefinite) gives a NaN frequency.

        Example:
            >>> MassSpringDamper.reference().modes().shapes.shape
            (2, 2)
        """
        factor = jnp.linalg.cholesky(self.mass)
        half = jax.scipy.linalg.solve_triangular(factor, self.stiffness, lower=True)
        whitened = jax.scipy.linalg.solve_triangular(factor, half.T, lower=True)
        squares, vectors = jnp.linalg.eigh(whitened)
        shapes = jax.scipy.linalg.solve_triangular(factor.T, vectors, lower=False)
        frequencies = jnp.sqrt(squares)
        modal_damping = jnp.einsum("ik,ij,jk->k", shapes, self.damping, shapes)
        return UndampedModes(frequencies, shapes, modal_damping / (2.0 * frequencies))
