"""Gain scheduling: frozen designs over an LPV model, interpolated in κ."""

import warnings
from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, Float

from lpvid.control._schedule_check import ScheduleCheck, Scheduled, check_schedule, frozen_models
from lpvid.control._search import ControllerDesign
from lpvid.mechanics import SampledController
from lpvid.models import AbstractBasis, AbstractDependence, Spline, StateSpace

# A hair outside, as of a measured κ at the end of its range, is no extrapolation.
_SLACK = 1e-3

ControllerState: TypeAlias = Any
Design: TypeAlias = Callable[[StateSpace], SampledController | ControllerDesign]


class ScheduledController(SampledController):
    """A controller whose gains follow a measured κ.

    It reads y with κ as last entries. Every array of the frozen designs, an observer's matrices
    among them, is a combination of functions of κ; what the frozen designs remember is shared by
    all of them, so observers must stand in one basis of states: that of the LPV model. Beyond the
    range of the designs the gains of its nearest end act.

    Attributes:
        basis: functions of κ.
        coefficients: of all gains (basis, gain).
        template: a design, for its form and its first memory.
        kappa_low: lower ends of the designs' range (scheduling,).
        kappa_high: upper ends.

    Source: Rugh and Shamma, Research on gain scheduling (Automatica 36 (2000) 1401-1425).

    Example:
        >>> from lpvid.control import PDP, ScheduledController
        >>> control = ScheduledController.from_designs([PDP(1, 2, 0), PDP(3, 2, 0)], [0.0, 0.4])
        >>> control.at(0.1).proportional
        Array(1.5, dtype=float64)
        >>> control.step(None, jnp.ones(1), jnp.array([0.0, 0.0, 0.0, 0.0, 0.1]))[1]
        Array([1.5], dtype=float64)
    """

    basis: AbstractBasis
    coefficients: Float[Array, "basis gain"]
    template: SampledController
    kappa_low: Float[Array, " scheduling"]
    kappa_high: Float[Array, " scheduling"]

    @classmethod
    def from_designs(
        cls,
        designs: Sequence[SampledController],
        kappas: ArrayLike | Sequence,
        method: AbstractDependence | None = None,
    ) -> "ScheduledController":
        """The controller through frozen designs.

        Differentiable in the designs.

        Args:
            designs: of one kind and one size.
            kappas: where they belong (point,) or (point, scheduling).
            method: `Spline(degree=1, natural=False)` by default, piecewise linear and exact at the
                points; with several scheduling variables they must then lie on a grid. `Spline()`
                is exact too, `Polynomial` with fewer functions than points fits.

        Raises:
            ValueError: designs of several kinds, another number of points, points that are not
                finite, come twice or do not determine the functions of κ.
        """
        points = _points(kappas, len(designs))
        gains = jnp.stack([gains_of(design) for design in _of_one_kind(designs)])
        method = Spline(degree=1, natural=False) if method is None else method
        with jax.ensure_compile_time_eval():
            basis = method.basis(points)
            functions = np.asarray(basis(points))
        rank = int(np.linalg.matrix_rank(functions))
        if rank < basis.size:
            raise ValueError(
                f"method: {method} has {basis.size} functions of κ, the {len(points)} designs "
                f"determine {rank} of them: take a lower degree, fewer knots or more designs."
            )
        coefficients = jnp.asarray(np.linalg.pinv(functions)) @ gains
        low, high = jnp.asarray(points.min(axis=0)), jnp.asarray(points.max(axis=0))
        return cls(basis, coefficients, designs[0], low, high)

    def initial(self) -> ControllerState:
        """What a frozen design begins with."""
        return self.template.initial()

    def step(
        self, state: ControllerState, reference: Float[Array, " nr"], y: Float[Array, " ny"]
    ) -> tuple[ControllerState, Float[Array, " nu"]]:
        """The step of the design at the measured κ, the last entries of y."""
        count = self.kappa_low.shape[0]
        frozen = self._frozen(y[y.shape[0] - count :])
        return frozen.step(state, reference, y[: y.shape[0] - count])

    def at(self, kappa: ArrayLike | Sequence) -> SampledController:
        """The frozen controller at κ (scheduling,), or a number; warns outside of the range.

        Raises:
            ValueError: another number of scheduling variables.
        """
        point = jnp.atleast_1d(jnp.asarray(kappa, float))
        if point.shape != self.kappa_low.shape:
            raise ValueError(f"kappa has shape {point.shape}: give {self.kappa_low.shape}.")
        if not any(isinstance(part, Tracer) for part in (point, self.kappa_low, self.kappa_high)):
            slack = _SLACK * np.asarray(self.kappa_high - self.kappa_low)
            value, low, high = (np.asarray(p) for p in (point, self.kappa_low, self.kappa_high))
            if np.any(value < low - slack) or np.any(value > high + slack):
                warnings.warn(
                    f"kappa={value} lies outside of the designs' range {low} to {high}; the gains "
                    "of its nearest end are taken.",
                    stacklevel=2,
                )
        return self._frozen(point)

    def _frozen(self, point: Float[Array, " scheduling"]) -> SampledController:
        inside = jnp.clip(point, self.kappa_low, self.kappa_high)
        variable, rest = eqx.partition(self.template, eqx.is_inexact_array)
        _, restore = ravel_pytree(variable)
        return eqx.combine(restore(self.basis(inside) @ self.coefficients), rest)


class ScheduleDesign(eqx.Module):
    """Frozen designs, the controller through them, and its check.

    Attributes:
        controller: the scheduled one.
        kappas: where it was designed (point, scheduling).
        designs: the frozen controllers.
        gains: theirs (point, gain), in the order of their fields.
        check: of the frozen closed loops at and between the points.
    """

    controller: ScheduledController
    kappas: Float[Array, "point scheduling"]
    designs: tuple[SampledController, ...]
    gains: Float[Array, "point gain"]
    check: ScheduleCheck


def schedule_design(
    model: Scheduled,
    design: Design,
    kappas: ArrayLike | Sequence,
    *,
    method: AbstractDependence | None = None,
    dt: float | None = None,
    grid: ArrayLike | Sequence | None = None,
    between: int = 8,
    nr: int = 1,
) -> ScheduleDesign:
    """Design at frozen κ, interpolate the gains, check the loop at and between the points.

    Differentiable in the model where `design` is, as `design_ilqr` is.

    Args:
        model: LPV model with `at`, or a function κ (scheduling,) → `StateSpace` that JAX can trace;
            all frozen models in one basis of states if the designs hold observers.
        design: from a frozen discrete-time model to a controller or a `ControllerDesign`.
        kappas: design points (point,) or (point, scheduling).
        method: how the gains depend on κ, see `ScheduledController.from_designs`.
        dt: sample time, s; needed for continuous-time models.
        grid: where the closed loop is checked (grid, scheduling); by default, with one scheduling
            variable, the points and `between` values in every interval of theirs.
        between: see `grid`.
        nr: number of set-points that the controllers take.

    Returns:
        `ScheduleDesign`.

    Raises:
        ValueError: a point outside of the model's hull, no sample time, no grid with several
            scheduling variables, or as `ScheduledController.from_designs` raises.

    Source: Rugh and Shamma (Automatica 36 (2000) 1401-1425).

    Example:
        >>> from lpvid.control import PDP, schedule_design
        >>> def plant(kappa):
        ...     C = jnp.eye(4, 1)
        ...     return StateSpace(0.9 * kappa[:, None], [[1.0]], C, dt=0.1)
        >>> def design(model):
        ...     return PDP(model.A[0, 0], 0.0, 0.0)
        >>> found = schedule_design(plant, design, [0.5, 1.0], between=1)
        >>> found.controller.at(0.75).proportional.round(3), bool(found.check.stable.all())
        (Array(0.675, dtype=float64), True)
    """
    points = _points(kappas, None)
    if grid is None:
        if points.shape[1] > 1:
            raise ValueError("grid: with several scheduling variables, give the points to check.")
        if between < 0:
            raise ValueError(f"between={between}: give a number from 0.")
        ends = np.sort(points[:, 0])
        shares = np.arange(between + 1) / (between + 1)
        inner = ends[:-1, None] + np.diff(ends)[:, None] * shares[None]
        grid = np.append(inner.ravel(), ends[-1])
    plants = frozen_models(model, points, dt)
    found = []
    for k in range(len(points)):
        made = design(jax.tree.map(lambda leaf, k=k: leaf[k], plants))
        found.append(made.controller if isinstance(made, ControllerDesign) else made)
    controller = ScheduledController.from_designs(found, points, method)
    return ScheduleDesign(
        controller=controller,
        kappas=jnp.asarray(points),
        designs=tuple(found),
        gains=jnp.stack([gains_of(one) for one in found]),
        check=check_schedule(model, controller, grid, dt=dt, nr=nr),
    )


def gains_of(controller: SampledController) -> Float[Array, " gain"]:
    """All arrays of real numbers that a controller holds, as one, in the order of its fields.

    Args:
        controller: any.

    Example:
        >>> from lpvid.control import PDP, gains_of
        >>> gains_of(PDP(0.5, 3.0, 0.1)).tolist()
        [0.5, 3.0, 0.1]
    """
    return ravel_pytree(eqx.filter(controller, eqx.is_inexact_array))[0]


def _points(kappas: ArrayLike | Sequence, count: int | None) -> np.ndarray:
    points = np.asarray(kappas, float)
    points = points[:, None] if points.ndim == 1 else points
    if points.ndim != 2 or len(points) < 2 or not np.all(np.isfinite(points)):
        raise ValueError(
            f"kappas: two or more finite points (point,) or (point, scheduling) are needed, got "
            f"shape {np.shape(kappas)}."
        )
    if count is not None and len(points) != count:
        raise ValueError(f"kappas: {len(points)} points for {count} designs; give one for each.")
    if len(np.unique(points, axis=0)) < len(points):
        raise ValueError(f"kappas: {points.tolist()} holds a point twice; leave one out.")
    return points


def _of_one_kind(designs: Sequence[SampledController]) -> Sequence[SampledController]:
    def form(design):
        arrays, rest = eqx.partition(design, eqx.is_inexact_array)
        shapes = [leaf.shape for leaf in jax.tree.leaves(arrays)]
        return jax.tree.structure(arrays), jax.tree.structure(rest), jax.tree.leaves(rest), shapes

    first = form(designs[0])
    for k, design in enumerate(designs):
        if form(design) != first:
            raise ValueError(
                f"designs: number {k} is {design}, the first {designs[0]}; gains can be "
                "interpolated between controllers of one kind and size only."
            )
    return designs
