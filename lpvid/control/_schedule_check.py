"""Stability and margins of scheduled loops: frozen, along trajectories, and for bounded rates."""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float

from lpvid._linalg import discrete_lyapunov
from lpvid.control._closed_loop import check_no_feedthrough, sample_time
from lpvid.control._linear_loop import closed_loop
from lpvid.control._output_feedback import balanced_sensitivity
from lpvid.mechanics import SampledController
from lpvid.models import GrayBoxLPV, LPVStateSpace, StateSpace

Scheduled: TypeAlias = LPVStateSpace | GrayBoxLPV | Callable[[Array], StateSpace]


# Frequencies that bracket the peak of S − T: evenly in the logarithm, and around every pole.
_POINTS = 400
_AROUND = np.linspace(-4.0, 4.0, 10)
# Each leaves a quarter of the bracket.
_NARROWINGS = 12


class ScheduleCheck(eqx.Module):
    """Frozen closed loops over κ.

    Where a frozen loop is not stable its disc margin is zero.

    Attributes:
        kappas: where (grid, scheduling).
        decay: slowest decay rate of the closed loop's poles, 1/s; negative for growth.
        disc_margin: of all inputs at once, 2 / ‖S − T‖∞, on a refined grid
            of frequencies: gains between (2 − α)/(2 + α) and its
            inverse or phases up to 2 arctan(α/2), in all inputs together, leave the loop stable.
        loops: of every input, opened there with the other ones closed, as batches over κ for
            `margins`.
        stable: whether the frozen loop is.
    """

    kappas: Float[Array, "grid scheduling"]
    decay: Float[Array, " grid"]
    disc_margin: Float[Array, " grid"]
    loops: tuple[StateSpace, ...]
    stable: Bool[Array, " grid"]


class TrajectoryCheck(eqx.Module):
    """A linear time-varying closed loop along one trajectory of κ.

    Attributes:
        exponent: logarithm of the spectral radius of the trajectory's whole transition over its
            duration, 1/s. If the trajectory is repeated for ever, states grow with this rate
            (Floquet): a proof, up to rounding, for that trajectory of the model and no other.
        transient: largest norm of the transition from the start to a later sample, in the model's
            own states.
        stable: whether the exponent is negative.
    """

    exponent: Float[Array, ""]
    transient: Float[Array, ""]
    stable: Bool[Array, ""]


class RateCertificate(eqx.Module):
    """How far κ may move from sample to sample, by V = xᵀ P(κ) x.

    A proof for every trajectory on the grid's points whose steps are shorter than `step`: V then
    falls at every sample. Between the points of the grid it is a check, the better the finer.

    Attributes:
        step: least distance of two points of the grid between which V may grow, in units of each
            scheduling variable's range; infinite where there are none: κ may then move at will.
        rate: the same per second.
        spacing: largest distance from a point of the grid to its nearest neighbour. Only a `step`
            beyond it says something.
        contraction: largest factor on √V in one sample at frozen κ.
    """

    step: Float[Array, ""]
    rate: Float[Array, ""]
    spacing: Float[Array, ""]
    contraction: Float[Array, ""]


def check_schedule(
    model: Scheduled,
    controller: SampledController,
    kappas: ArrayLike | Sequence,
    *,
    dt: float | None = None,
    nr: int = 1,
) -> ScheduleCheck:
    """Poles and margins of the frozen closed loops on a grid of κ.

    Necessary, not sufficient for stability under a moving κ: see `check_trajectory` and
    `certify_rate`.

    Args:
        model: LPV model with `at`, or a function κ (scheduling,) → `StateSpace` that JAX can trace.
        controller: `ScheduledController`, frozen at each κ; any other one is fixed.
        kappas: (grid,) or (grid, scheduling).
        dt: sample time, s; needed for continuous-time models.
        nr: number of set-points that the controller takes.

    Returns:
        `ScheduleCheck`.

    Raises:
        ValueError: a κ that is not finite or outside of the model's hull, no sample time, a
            feedthrough.

    Source: disc margins: Seiler, Packard and Gahinet (IEEE Control Systems 40 (2020) 78-95).

    Example:
        >>> from lpvid.control import PDP, check_schedule
        >>> def plant(kappa):
        ...     return StateSpace(kappa[:, None], [[1.0]], [[1.0], [0.0], [0.0], [0.0]], dt=0.1)
        >>> check_schedule(plant, PDP(0.5, 0.0, 0.0), [0.5, 1.0, 2.0]).stable.tolist()
        [True, True, False]
    """
    points = _grid(kappas)
    plants = frozen_models(model, points, dt)
    controls = _frozen_controls(controller, points)
    return _check(plants, controls, jnp.asarray(points), nr)


def check_trajectory(
    model: Scheduled,
    controller: SampledController,
    kappa: ArrayLike | Sequence,
    *,
    dt: float | None = None,
    nr: int = 1,
) -> TrajectoryCheck:
    """Stability along one trajectory of κ, by the product of the closed loop's transitions.

    κ is held over each sample. Frozen loops that are all stable may still be unstable together.

    Args:
        model: as for `check_schedule`.
        controller: as for `check_schedule`.
        kappa: at every sample (time,) or (time, scheduling).
        dt: sample time, s; needed for continuous-time models.
        nr: number of set-points that the controller takes.

    Returns:
        `TrajectoryCheck`.

    Raises:
        ValueError: as for `check_schedule`.

    Source: Shamma and Athans, Gain scheduling: potential hazards and possible remedies (IEEE
        Control Systems 12 (1992) 101-107); Floquet's theorem.

    Example:
        >>> from lpvid.control import PDP, check_trajectory
        >>> def swap(kappa):
        ...     off = jnp.array([[0.0, 2.0], [0.0, 0.0]])
        ...     A = jnp.where(kappa[0] > 0.0, off, off.T)
        ...     return StateSpace(A, jnp.zeros((2, 1)), jnp.zeros((4, 2)), dt=1.0)
        >>> check_trajectory(swap, PDP(0.0, 0.0, 0.0), [1.0, -1.0]).exponent.round(3)
        Array(0.693, dtype=float64)
    """
    points = _grid(kappa)
    plants = frozen_models(model, points, dt)
    A = _transitions(plants, _frozen_controls(controller, points), nr)
    return _follow(A, plants.dt)


def certify_rate(
    model: Scheduled,
    controller: SampledController,
    kappas: ArrayLike | Sequence,
    *,
    dt: float | None = None,
    nr: int = 1,
) -> RateCertificate:
    """How fast κ may vary, by a Lyapunov function that depends on it; no search.

    P(κ) solves the Lyapunov equation of every frozen loop, in coordinates in which their mean is
    the identity.

    Args:
        model: as for `check_schedule`.
        controller: as for `check_schedule`.
        kappas: dense grid (grid,) or (grid, scheduling).
        dt: sample time, s; needed for continuous-time models.
        nr: number of set-points that the controller takes.

    Returns:
        `RateCertificate`; a `step` of zero where a frozen loop is not stable.

    Raises:
        ValueError: as for `check_schedule`.

    Source: Desoer, Slowly varying discrete system x(i+1) = A(i) x(i) (Electronics Letters 6 (1970)
        339-340), with pairs of the grid's points in the place of a bound.

    Example:
        >>> from lpvid.control import PDP, certify_rate
        >>> def plant(kappa):
        ...     return StateSpace(kappa[:, None], [[1.0]], [[1.0], [0.0], [0.0], [0.0]], dt=0.1)
        >>> certify_rate(plant, PDP(0.5, 0.0, 0.0), [0.5, 0.75, 1.0]).step
        Array(inf, dtype=float64)
    """
    points = _grid(kappas)
    plants = frozen_models(model, points, dt)
    A = _transitions(plants, _frozen_controls(controller, points), nr)
    width = np.ptp(points, axis=0)
    scaled = points / np.where(width > 0.0, width, 1.0)
    apart = np.linalg.norm(scaled[:, None] - scaled[None], axis=-1)
    return _certify(A, jnp.asarray(apart), plants.dt)


def frozen_models(model: Scheduled, points: np.ndarray, dt: float | None) -> StateSpace:
    """The discrete-time models at all points, as a batch.

    Raises:
        ValueError: a point outside of the model's hull, no sample time, a feedthrough.
    """
    inside = getattr(model, "is_inside", None)
    if inside is not None:
        known = inside(jnp.asarray(points))
        if not isinstance(known, Tracer) and not np.all(np.asarray(known)):
            outside = points[~np.asarray(known)]
            raise ValueError(
                f"kappas: {outside.tolist()} lie outside of the hull that the model was built "
                "from; give points inside, or a model of more operating points."
            )
    freeze: Any = getattr(model, "at", model)
    plants = jax.vmap(freeze)(jnp.asarray(points))
    check_no_feedthrough(plants)
    step = sample_time(plants, dt)
    return plants if plants.is_discrete else plants.discretise(step)


def _grid(kappas: ArrayLike | Sequence) -> np.ndarray:
    points = np.asarray(kappas, float)
    points = points[:, None] if points.ndim == 1 else points
    if points.ndim != 2 or not len(points) or not np.all(np.isfinite(points)):
        raise ValueError(
            "kappas: finite points (grid,) or (grid, scheduling) are needed, got shape "
            f"{np.shape(kappas)}."
        )
    return points


def _frozen_controls(controller: SampledController, points: np.ndarray) -> SampledController:
    """The controller at all points: its arrays have the points as first axis."""
    freeze: Any = getattr(controller, "at", lambda kappa: controller)
    return eqx.filter_vmap(freeze)(jnp.asarray(points))


def _over_points(function: Callable) -> Callable:
    return eqx.filter_vmap(function, in_axes=(eqx.if_array(0), eqx.if_array(0)))


@eqx.filter_jit
def _transitions(plants: StateSpace, controls: SampledController, nr: int) -> Array:
    return _over_points(lambda plant, one: closed_loop(plant, one, nr=nr).A)(plants, controls)


@eqx.filter_jit
def _check(
    plants: StateSpace, controls: SampledController, kappas: Array, nr: int
) -> ScheduleCheck:
    spread = _over_points(lambda plant, one: balanced_sensitivity(plant, one, nr=nr))(
        plants, controls
    )
    radius = jnp.max(jnp.abs(jnp.linalg.eigvals(spread.A)), axis=-1)
    stable = radius < 1.0
    return ScheduleCheck(
        kappas=kappas,
        decay=-jnp.log(radius) / plants.dt,
        disc_margin=jnp.where(stable, 2.0 / jax.vmap(_peak)(spread), 0.0),
        loops=tuple(_single_input(spread, i) for i in range(plants.nu)),
        stable=stable,
    )


def _peak(system: StateSpace) -> Float[Array, ""]:
    """Largest gain over frequency, from a grid that is dense around the poles, refined.

    `hinf_norm` would prove it, at many times the cost to compile.
    """
    poles = jnp.log(_away_from_zero(jnp.linalg.eigvals(system.A))) / system.dt
    around = (
        jnp.abs(poles.imag)[:, None] + jnp.abs(poles.real)[:, None] * jnp.asarray(_AROUND)[None]
    )
    highest = np.pi / system.dt
    even = jnp.asarray(np.append(0.0, np.geomspace(1e-5, 1.0, _POINTS))) * highest
    omega = jnp.sort(jnp.concatenate([even, jnp.clip(around.ravel(), 0.0, highest)]))

    def sizes(at):
        return jnp.linalg.norm(system.frequency_response(at), ord=2, axis=(-2, -1))

    def narrow(_, bracket):
        points = jnp.linspace(bracket[0], bracket[1], 9)
        best = jnp.argmax(sizes(points))
        return points[jnp.maximum(best - 1, 0)], points[jnp.minimum(best + 1, 8)]

    best = jnp.argmax(sizes(omega))
    bracket = (omega[jnp.maximum(best - 1, 0)], omega[jnp.minimum(best + 1, omega.size - 1)])
    low, high = lax.fori_loop(0, _NARROWINGS, narrow, bracket)
    return jnp.max(sizes(jnp.stack([low, 0.5 * (low + high), high])))


def _away_from_zero(poles: Array) -> Array:
    return jnp.where(jnp.abs(poles) > 1e-12, poles, 1e-12)


def _single_input(spread: StateSpace, i: int) -> StateSpace:
    """The loop of one input, the others closed, from S − T of all: C is twice the command's."""
    B, C = spread.B[..., :, i : i + 1], -0.5 * spread.C[..., i : i + 1, :]
    return StateSpace(spread.A + B @ C, B, C, dt=spread.dt)


@eqx.filter_jit
def _follow(A: Float[Array, "time n n"], dt: float) -> TrajectoryCheck:
    def sample(carry, now):
        product, logarithm = carry
        product = now @ product
        size = jnp.maximum(jnp.linalg.norm(product), 1e-300)
        # Scaled, so that long trajectories neither overflow nor vanish.
        return (product / size, logarithm + jnp.log(size)), logarithm + jnp.log(
            jnp.linalg.norm(product, ord=2)
        )

    start = (jnp.eye(A.shape[-1]), jnp.zeros(()))
    (product, logarithm), sizes = lax.scan(sample, start, A)
    radius = jnp.max(jnp.abs(jnp.linalg.eigvals(product)))
    exponent = (jnp.log(radius) + logarithm) / (A.shape[0] * dt)
    return TrajectoryCheck(exponent, jnp.exp(jnp.max(sizes)), exponent < 0.0)


@eqx.filter_jit
def _certify(A: Float[Array, "grid n n"], apart: Float[Array, "grid grid"], dt: float):
    count, n, _ = A.shape
    identity = jnp.broadcast_to(jnp.eye(n), A.shape)
    radius = jnp.max(jnp.abs(jnp.linalg.eigvals(A)), axis=-1)
    # V falls with half of the loop's own logarithmic rate.
    slower = A / jnp.sqrt(jnp.maximum(radius, 1e-6))[:, None, None]
    for _ in range(2):
        P = discrete_lyapunov(slower.mT, identity)
        P = P / jnp.linalg.norm(P, axis=(-2, -1), keepdims=True)
        root = jnp.linalg.cholesky(jnp.mean(P, axis=0)).T
        inverse = jnp.linalg.inv(root)
        slower, A = root[None] @ slower @ inverse[None], root[None] @ A @ inverse[None]
    P = discrete_lyapunov(slower.mT, identity)
    roots = jnp.linalg.cholesky(P).mT
    moved = A @ jnp.linalg.inv(roots)
    factors = jnp.linalg.norm(roots[None, :] @ moved[:, None], ord=2, axis=(-2, -1))
    grows = ~(factors < 1.0)
    step = jnp.min(jnp.where(grows, apart, jnp.inf))
    nearest = jnp.min(jnp.where(jnp.eye(count, dtype=bool), jnp.inf, apart), axis=1)
    return RateCertificate(step, step / dt, jnp.max(nearest), jnp.max(jnp.diagonal(factors)))
