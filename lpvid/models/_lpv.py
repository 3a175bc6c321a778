"""Linear parameter-varying models: a structure whose parameters depend on the scheduling."""

import math
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from lpvid._linalg import batched
from lpvid.models._connected import SampledStructure
from lpvid.models._hold import AbstractConversion, ZeroOrderHold
from lpvid.models._hull import ConvexHull
from lpvid.models._schedule_hold import AbstractScheduleHold, HeldSchedule
from lpvid.models._scheduling import AbstractBasis
from lpvid.models._simulate import simulate_time_varying
from lpvid.models._state_space import Numbers, StateSpace
from lpvid.models._structures import AbstractStructure


class LPVStateSpace(eqx.Module):
    """ẋ = A(κ) x + B(κ) u, y = C(κ) x + D(κ) u with (A, B, C, D)(κ) = structure(ϑ(κ)).

    ϑ(κ) is a linear combination of basis functions of the scheduling variable κ. With a
    `FreeStructure`, or any structure affine in ϑ, the matrices themselves are polynomials in κ
    (001, equation 35). In discrete time (`discretise`, or a structure in discrete time) x(t + 1)
    takes the place of ẋ.

    Models are connected with each other and with LTI models by `series`, `parallel` and `feedback`.

    Attributes:
        structure: ϑ → (A, B, C, D).
        basis: functions of κ.
        coefficients: shape (basis.size, structure.n_parameters).
        kappa_low: lower end of each scheduling variable's range at the points that the model was
            built from.
        kappa_high: its upper end.
        hull: the convex hull of those points; the box of the ranges where it is left out.

    Raises:
        ValueError: the coefficients' shape is not (basis.size, structure.n_parameters).

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
    basis: AbstractBasis
    coefficients: Float[Array, "basis parameter"]
    kappa_low: Float[Array, " scheduling"]
    kappa_high: Float[Array, " scheduling"]
    hull: ConvexHull | None = None

    def __check_init__(self):
        wanted = (self.basis.size, self.structure.n_parameters)
        found = getattr(self.coefficients, "shape", wanted)
        if found != wanted:
            raise ValueError(
                f"coefficients: one row for each basis function and one column for each parameter "
                f"are needed, {wanted}; got shape {found}."
            )

    @property
    def n_scheduling(self) -> int:
        """Number of scheduling variables."""
        return self.kappa_low.shape[0]

    @property
    def _form(self) -> StateSpace:
        """A frozen model's sizes and sample time, worked out from shapes alone."""
        return jax.eval_shape(self.structure.matrices, self.coefficients[0])

    @property
    def nx(self) -> int:
        """Number of states."""
        return self._form.nx

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return self._form.nu

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return self._form.ny

    @property
    def dt(self) -> float:
        """Sample time in seconds; 0 in continuous time."""
        return self._form.dt

    def parameters(self, kappa: Numbers) -> Float[Array, "*batch parameter"]:
        """ϑ(κ) for κ of shape (…, n_scheduling); a scalar κ may be given plainly."""
        return self.basis(self._schedule(kappa)) @ self.coefficients

    def at(self, kappa: Numbers) -> StateSpace:
        """The model frozen at κ; warns where that is outside of the points' hull.

        Args:
            kappa: shape (n_scheduling,), or (…, n_scheduling) for a batch of models; with one
                scheduling variable a number, or the batch's shape alone.

        Returns:
            The frozen model, its batch axes those of κ.

        Raises:
            ValueError: the last axis of κ does not hold the scheduling variables.
        """
        point = self._schedule(kappa)
        self._warn_outside(point)
        return self._frozen(point)

    def _frozen(self, point: Array) -> StateSpace:
        if point.ndim == 1:
            return self.structure.matrices(self.parameters(point))
        batch = point.shape[:-1]
        flat = self.parameters(point.reshape(-1, self.n_scheduling))
        frozen = jax.vmap(self.structure.matrices)(flat)
        return jax.tree.map(lambda leaf: leaf.reshape(*batch, *leaf.shape[1:]), frozen)

    def is_stable(self, kappa: Numbers) -> Array:
        """Whether the frozen model is stable at κ, shape (…, n_scheduling) → (…).

        Stable local models do not make the models between them stable, unless the structure
        does (modal, mechanical); nor do stable frozen models make a moving one stable.
        """
        return self._frozen(self._schedule(kappa)).is_stable()

    def is_inside(self, kappa: Numbers) -> Array:
        """Whether κ (…, n_scheduling) lies within the hull of the points it was built from."""
        point = self._schedule(kappa)
        # A hair outside, as of a measured schedule at the end of its range, is no extrapolation.
        if self.hull is not None:
            return self.hull.distance(point) <= 2e-3
        slack = 1e-3 * (self.kappa_high - self.kappa_low)
        low = jnp.broadcast_to(self.kappa_low - slack, point.shape)
        high = jnp.broadcast_to(self.kappa_high + slack, point.shape)
        return jnp.all(((point - low) >= 0) & ((high - point) >= 0), axis=-1)

    def discretise(self, dt: float, method: AbstractConversion | None = None) -> "LPVStateSpace":
        """The LPV model in discrete time, each frozen model discretised (zero-order hold).

        So κ is held over each sample, as in `simulate` with `HeldSchedule`.

        Args:
            dt: sample time, s.
            method: `ZeroOrderHold()` by default, or `Tustin()`.

        Raises:
            ValueError: the model is in discrete time already, or dt is not positive.

        Example:
            >>> from lpvid.models import FreeStructure, LPVStateSpace, polynomial_basis
            >>> free, basis = FreeStructure(1, 1, 1, feedthrough=False), polynomial_basis([0.0], 0)
            >>> lpv = LPVStateSpace(free, basis, -jnp.ones((1, 3)), jnp.zeros(1), jnp.ones(1))
            >>> lpv.discretise(0.1).at(0.5).A.round(3).item()
            0.905
        """
        if self.dt > 0.0:
            raise ValueError(f"The model is in discrete time already (dt = {self.dt} s).")
        if not (float(dt) > 0.0 and math.isfinite(dt)):
            raise ValueError(f"dt is {dt}; the sample time must be a positive number of seconds.")
        method = ZeroOrderHold() if method is None else method
        return LPVStateSpace(
            SampledStructure(self.structure, method, float(dt)),
            self.basis,
            self.coefficients,
            self.kappa_low,
            self.kappa_high,
            self.hull,
        )

    def simulate(
        self,
        *,
        u: Numbers,
        kappa: Numbers,
        dt: float | None = None,
        x0: Numbers | None = None,
        hold: AbstractScheduleHold | None = None,
    ) -> Float[Array, "*batch time output"]:
        """Response to an input along a schedule.

        The input is held constant over each sample; so is the scheduling, unless `hold` says
        otherwise. Works under `jit` and `vmap`, forward and reverse derivatives in the
        coefficients, u, κ and x0. Warns where κ leaves the hull of the model (outside `jit`).

        Args:
            u: input (time, n_inputs), or (time,) for one input; leading axes are a batch.
            kappa: schedule (time, n_scheduling), or (time,) for one scheduling variable; leading
                axes are a batch.
            dt: sample time, s; of a discrete-time model its own, and may be left out.
            x0: first state (n_states,), leading axes are a batch; zero by default.
            hold: `HeldSchedule()` by default, or `LinearSchedule(substeps)`; not for discrete time.

        Returns:
            Output (time, n_outputs), with the batch axes of u, κ and x0, broadcast, in front.

        Raises:
            ValueError: shapes do not fit, the sample time is missing or contradicts the model's, or
                a discrete-time model is given a `hold`.
        """
        u = jnp.asarray(u, float)
        u = u[:, None] if u.ndim == 1 else u
        schedule = self._schedule(kappa)
        if schedule.ndim < 2 or schedule.shape[-2] != u.shape[-2]:
            raise ValueError(
                f"kappa: {u.shape[-2]} samples of {self.n_scheduling} values are needed, one for "
                f"each sample of u; got shape {schedule.shape}."
            )
        form = self._form
        if form.nu != u.shape[-1]:
            raise ValueError(f"u: {form.nu} inputs are needed, got {u.shape[-1]} columns.")
        start = jnp.zeros(form.nx) if x0 is None else jnp.asarray(x0, float)
        if start.shape[-1:] != (form.nx,):
            raise ValueError(f"x0: {form.nx} states are needed, got shape {start.shape}.")
        if form.is_discrete and hold is not None:
            raise ValueError("hold: a discrete-time model knows κ at its samples only; leave out.")
        sample_time = _sample_time(form.dt, dt)
        self._warn_outside(schedule)
        hold = HeldSchedule() if hold is None else hold
        return self._simulate(u, schedule, sample_time, start, hold)

    @eqx.filter_jit
    def _simulate(self, u, schedule, dt, start, hold):
        frozen = self._frozen(schedule)
        A, B = frozen.A, frozen.B
        if not frozen.is_discrete:
            A, B = hold.transitions(self._frozen, schedule, dt)
        run = batched(_run, "(t,n,n),(t,n,m),(t,p,n),(t,p,m),(t,m),(n)->(t,p)")
        return run(A, B, frozen.C, frozen.D, u, start)

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
        inside = self.is_inside(point)
        # Under jit, what is computed from constants is traced too.
        if isinstance(inside, Tracer):
            return
        share = float(np.mean(~np.asarray(inside)))
        if share > 0:
            flat = self.n_scheduling == 1 or self.hull is None
            warnings.warn(
                f"kappa: {100 * share:.3g} % of the points lie outside the "
                f"{'range' if flat else 'convex hull of the points in the range'} "
                f"{np.asarray(self.kappa_low)} to {np.asarray(self.kappa_high)} that the model was "
                "built from; it extrapolates there.",
                stacklevel=3,
            )


def _sample_time(own: float, given: float | None) -> float:
    if own > 0.0:
        if given is not None and not math.isclose(given, own, rel_tol=1e-9):
            raise ValueError(f"dt is {given} s, the model's sample time {own} s; leave dt out.")
        return own
    if given is None:
        raise ValueError("dt: the model is in continuous time; give the sample time of u.")
    if not (float(given) > 0.0 and math.isfinite(given)):
        raise ValueError(f"dt is {given}; the sample time must be a positive number of seconds.")
    return float(given)


def _run(A, B, C, D, u, x0):
    return simulate_time_varying(A, B, C, D, u=u, x0=x0)
