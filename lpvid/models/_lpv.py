"""Linear parameter-varying models: a structure whose parameters depend on the scheduling."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from lpvid.models._convert import c2d
from lpvid.models._scheduling import PolynomialBasis
from lpvid.models._simulate import simulate_time_varying
from lpvid.models._state_space import Numbers, StateSpace
from lpvid.models._structures import AbstractStructure


class LPVStateSpace(eqx.Module):
    """ẋ = A(κ) x + B(κ) u, y = C(κ) x + D(κ) u with (A, B, C, D)(κ) = structure(ϑ(κ)).

    ϑ(κ) is a linear combination of basis functions of the scheduling variable κ. With a
    `FreeStructure`, or any structure affine in ϑ, the matrices themselves are polynomials in κ
    (001, equation 35).

    Attributes:
        structure: ϑ → (A, B, C, D), in continuous time.
        basis: functions of κ.
        coefficients: shape (basis.size, structure.n_parameters).
        kappa_low: lower end of each scheduling variable's range at the points that the model was
            built from.
        kappa_high: its upper end.

    Example:
        >>> structure = FreeStructure(n_states=1, n_inputs=1, n_outputs=1, feedthrough=False)
        >>> basis = polynomial_basis([0.0, 2.0], 1)
        >>> coefficients = jnp.array([[-3.0, 1.0, 1.0], [1.0, 0.0, 0.0]])
        >>> lpv = LPVStateSpace(structure, basis, coefficients, jnp.zeros(1), jnp.full(1, 2.0))
        >>> lpv.at(1.5).A.tolist()
        [[-2.5]]
        >>> lpv.simulate(u=jnp.ones((3, 1)), kappa=jnp.linspace(0.0, 2.0, 3), dt=1e-3).shape
        (3, 1)
    """

    structure: AbstractStructure
    basis: PolynomialBasis
    coefficients: Float[Array, "basis parameter"]
    kappa_low: Float[Array, " scheduling"]
    kappa_high: Float[Array, " scheduling"]

    @property
    def n_scheduling(self) -> int:
        """Number of scheduling variables."""
        return self.kappa_low.shape[0]

    def parameters(self, kappa: Numbers) -> Float[Array, "*batch parameter"]:
        """ϑ(κ) for κ of shape (…, n_scheduling); a scalar κ may be given plainly."""
        return self.basis(self._schedule(kappa)) @ self.coefficients

    def at(self, kappa: Numbers) -> StateSpace:
        """The continuous-time model frozen at one value of κ; warns outside its range.

        Raises:
            ValueError: κ is not one point.
        """
        point = self._schedule(kappa)
        if point.ndim != 1:
            raise ValueError(
                f"kappa: one point of {self.n_scheduling} values is needed, got shape "
                f"{point.shape}; use jax.vmap(lpv.at) for several."
            )
        self._warn_outside(point)
        return self.structure.matrices(self.parameters(point))

    def is_stable(self, kappa: Numbers) -> Array:
        """Whether the frozen model is stable at κ, shape (…, n_scheduling) → (…).

        Stable local models do not make the models between them stable, unless the structure
        does (modal, mechanical).
        """
        point = self._schedule(kappa)
        flat = point.reshape(-1, self.n_scheduling)
        frozen = jax.vmap(self.structure.matrices)(self.parameters(flat))
        return frozen.is_stable().reshape(point.shape[:-1])

    def is_inside(self, kappa: Numbers) -> Array:
        """Whether κ (…, n_scheduling) lies within the box of the points it was built from."""
        point = self._schedule(kappa)
        # A hair outside, as of a measured schedule at the end of its range, is no extrapolation.
        slack = 1e-3 * (self.kappa_high - self.kappa_low)
        low = jnp.broadcast_to(self.kappa_low - slack, point.shape)
        high = jnp.broadcast_to(self.kappa_high + slack, point.shape)
        return jnp.all(((point - low) >= 0) & ((high - point) >= 0), axis=-1)

    def simulate(
        self, *, u: Numbers, kappa: Numbers, dt: float, x0: Numbers | None = None
    ) -> Float[Array, "time output"]:
        """Response to an input along a schedule.

        Input and scheduling are held constant over each sample, for which the frozen model is
        discretised exactly. Works under `jit` and `vmap`, forward and reverse derivatives in the
        coefficients, u, κ and x0. Warns where κ leaves the range of the model (outside `jit`).

        Args:
            u: input (time, n_inputs), or (time,) for one input.
            kappa: schedule (time, n_scheduling), or (time,) for one scheduling variable.
            dt: sample time, s.
            x0: first state, zero by default.

        Returns:
            Output (time, n_outputs).

        Raises:
            ValueError: shapes do not fit.
        """
        u = jnp.asarray(u, float)
        u = u[:, None] if u.ndim == 1 else u
        schedule = self._schedule(kappa)
        if schedule.shape[0] != u.shape[0] or schedule.ndim != 2:
            raise ValueError(
                f"kappa: {u.shape[0]} samples of {self.n_scheduling} values are needed, one for "
                f"each sample of u; got shape {schedule.shape}."
            )
        self._warn_outside(schedule)
        return self._simulate(u, schedule, float(dt), x0)

    @eqx.filter_jit
    def _simulate(self, u, schedule, dt, x0):
        frozen = jax.vmap(self.structure.matrices)(self.parameters(schedule))
        if frozen.nu != u.shape[1]:
            raise ValueError(f"u: {frozen.nu} inputs are needed, got {u.shape[1]} columns.")
        # Batched, not vmapped: so the matrix exponential skips the squarings that no sample needs.
        discrete = c2d(frozen, dt)
        start = jnp.zeros(frozen.nx) if x0 is None else jnp.asarray(x0, float)
        if start.shape != (frozen.nx,):
            raise ValueError(f"x0: {frozen.nx} states are needed, got shape {start.shape}.")
        return simulate_time_varying(discrete.A, discrete.B, discrete.C, discrete.D, u=u, x0=start)

    def _schedule(self, kappa: Numbers) -> Array:
        """κ with a last axis of n_scheduling; a missing axis is added where that is no guess."""
        point = jnp.asarray(kappa, float)
        if self.n_scheduling == 1 and (point.ndim == 0 or point.shape[-1] != 1):
            point = point[..., None]
        if point.ndim == 0 or point.shape[-1] != self.n_scheduling:
            raise ValueError(
                f"kappa: the last axis must hold {self.n_scheduling} values, got shape "
                f"{point.shape}."
            )
        return point

    def _warn_outside(self, point: Array) -> None:
        if isinstance(point, Tracer) or isinstance(self.kappa_low, Tracer):
            return
        share = float(np.mean(~np.asarray(self.is_inside(point))))
        if share > 0:
            warnings.warn(
                f"kappa: {100 * share:.3g} % of the points lie outside the range "
                f"{np.asarray(self.kappa_low)} to {np.asarray(self.kappa_high)} that the model was "
                "built from; it extrapolates there.",
                stacklevel=3,
            )
