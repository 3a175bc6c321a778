"""Second-order mechanical structure: M q̈ + D q̇ + K q = E u with measured motions."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, PRNGKeyArray

from lpvid.models._state_space import StateSpace
from lpvid.models._structures import AbstractStructure, Parameters, Starts

_MEASURED = ("displacement", "velocity", "acceleration")


class MechanicalStructure(AbstractStructure):
    """M q̈ + D q̇ + K q = u with one force and one measured motion for each degree of freedom.

    M, D and K are symmetric positive definite by their logarithmic Cholesky factors (rows of
    the lower triangle; logarithms on the diagonal), so that every ϑ is a stable model. The
    state is x = [q, q̇].

    Attributes:
        n_degrees: degrees of freedom, each driven by one input.
        measured: `"displacement"`, `"velocity"` or `"acceleration"`.

    Raises:
        ValueError: `n_degrees` is below one, or `measured` is none of the three.

    Source: 000, equations 1 to 4.

    Example:
        >>> structure = MechanicalStructure(n_degrees=1)
        >>> mass, damping, stiffness = structure.mechanical_matrices(jnp.zeros(3))
        >>> stiffness.item()
        1.0
    """

    n_degrees: int = eqx.field(static=True)
    measured: str = eqx.field(static=True, default="displacement")

    def __check_init__(self):
        if self.n_degrees < 1:
            raise ValueError("n_degrees: at least one degree of freedom is needed.")
        if self.measured not in _MEASURED:
            raise ValueError(f"measured: {self.measured!r} is not one of {', '.join(_MEASURED)}.")

    @property
    def _lower(self):
        return np.tril_indices(self.n_degrees)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names such as `mass L[0,0]`."""
        return tuple(
            f"{name} L[{i},{j}]"
            for name in ("mass", "damping", "stiffness")
            for i, j in zip(*self._lower, strict=True)
        )

    def mechanical_matrices(self, parameters: Parameters) -> tuple[Array, Array, Array]:
        """Mass, damping and stiffness matrices, each (n_degrees, n_degrees)."""
        mass, damping, stiffness = (
            self._definite(part) for part in parameters.reshape(3, len(self._lower[0]))
        )
        return mass, damping, stiffness

    def _definite(self, entries: Array) -> Array:
        factor = jnp.zeros((self.n_degrees, self.n_degrees)).at[self._lower].set(entries)
        diagonal = jnp.exp(jnp.diag(factor))
        # Off-diagonal entries relative to the row's diagonal: free of units.
        factor = diagonal[:, None] * (jnp.tril(factor, -1) + jnp.eye(self.n_degrees))
        return factor @ factor.T

    def parameters_of(
        self, mass: ArrayLike, damping: ArrayLike, stiffness: ArrayLike
    ) -> Parameters:
        """ϑ of given symmetric positive definite matrices, each (n_degrees, n_degrees).

        Raises:
            ValueError: a matrix has the wrong shape, or is not positive definite (checked outside
                `jit` only).
        """
        parts = []
        for name, matrix in (("mass", mass), ("damping", damping), ("stiffness", stiffness)):
            matrix = jnp.asarray(matrix, float)
            if matrix.shape != (self.n_degrees, self.n_degrees):
                raise ValueError(
                    f"{name}: shape {(self.n_degrees, self.n_degrees)} is needed, got "
                    f"{matrix.shape}."
                )
            factor = jnp.linalg.cholesky(matrix)
            if not isinstance(factor, Tracer) and not bool(jnp.all(jnp.isfinite(factor))):
                raise ValueError(f"{name}: it is not positive definite, which the structure is.")
            diagonal = jnp.diag(factor)
            relative = jnp.tril(factor / diagonal[:, None], -1) + jnp.diag(jnp.log(diagonal))
            parts.append(relative[self._lower])
        return jnp.concatenate(parts)

    def matrices(self, parameters: Parameters) -> StateSpace:
        """The model at ϑ."""
        mass, damping, stiffness = self.mechanical_matrices(parameters)
        n = self.n_degrees
        inverse = jnp.linalg.inv(mass)
        zero, identity = jnp.zeros((n, n)), jnp.eye(n)
        A = jnp.block([[zero, identity], [-inverse @ stiffness, -inverse @ damping]])
        B = jnp.concatenate([zero, inverse])
        if self.measured == "displacement":
            return StateSpace(A, B, jnp.concatenate([identity, zero], axis=1))
        if self.measured == "velocity":
            return StateSpace(A, B, jnp.concatenate([zero, identity], axis=1))
        return StateSpace(A, B, A[n:], inverse)

    def starts(self, key: PRNGKeyArray, count: int, black_box: StateSpace) -> Starts:
        """Diagonal matrices sized from the black box's response at low frequency and its poles."""
        order = {"displacement": 0, "velocity": 1, "acceleration": 2}[self.measured]
        size = jnp.sort(jnp.abs(black_box.poles()))
        slow = jnp.maximum(size[0], 1e-3 * size[-1])
        low = black_box.frequency_response(jnp.atleast_1d(slow / 10.0))[0]
        compliance = jnp.abs(jnp.diag(low)) / (slow / 10.0) ** order
        stiffness = 1.0 / jnp.maximum(compliance, 1e-12 * jnp.max(compliance))
        frequency = jnp.exp(jnp.mean(jnp.log(jnp.maximum(size, slow))))
        centre = self.parameters_of(
            jnp.diag(stiffness / frequency**2),
            jnp.diag(0.1 * stiffness / frequency),
            jnp.diag(stiffness),
        )
        scatter = 0.5 * jax.random.normal(key, (count, self.n_parameters))
        return centre[None] + scatter.at[0].set(0.0)
