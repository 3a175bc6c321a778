"""Static output feedback of several channels, designed for several models at once."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from lpvid._results import Solution
from lpvid._solve import Bounds
from lpvid.control._closed_loop import check_no_feedthrough, sample_time
from lpvid.control._criteria import itae
from lpvid.control._linear_loop import closed_loop
from lpvid.control._search import (
    ControllerDesign,
    Multipliers,
    bounds_of,
    search_in_rounds,
    search_round,
    settled,
)
from lpvid.mechanics import SampledController
from lpvid.models import StateSpace

# Most searches after the first.
_ROUNDS = 7
# Of the smooth maximum, in units of what it is taken over.
_SHARPNESS = 50.0
# From a thousandth of the Nyquist frequency up to it.
_FREQUENCIES = np.geomspace(1e-3, 1.0, 100)


def _floats(value: ArrayLike | Sequence) -> Array:
    return jnp.asarray(value, float)


class OutputFeedback(SampledController):
    """u = K (r − y) + F r: every output has its set-point.

    Attributes:
        gain: K (nu, ny).
        feedforward: F (nu, ny).

    Example:
        >>> control = OutputFeedback([[2.0, 0.5]], [[0.0, 1.0]])
        >>> control.step(None, jnp.array([1.0, 1.0]), jnp.zeros(2))[1]
        Array([3.5], dtype=float64)
    """

    gain: Float[Array, "*batch nu ny"] = eqx.field(converter=_floats)
    feedforward: Float[Array, "*batch nu ny"] = eqx.field(converter=_floats)

    def initial(self) -> None:
        """Nothing to remember."""
        return None

    def step(
        self, state: None, reference: Float[Array, " ny"], y: Float[Array, " ny"]
    ) -> tuple[None, Float[Array, " nu"]]:
        """The command."""
        return state, self.gain @ (reference - y) + self.feedforward @ reference


def design_output_feedback(
    models: StateSpace,
    *,
    starts: ArrayLike | Sequence,
    bounds: tuple[ArrayLike | Sequence, ArrayLike | Sequence],
    feedforward: ArrayLike | Sequence | None = None,
    tracked: Sequence[int] = (0,),
    disc_margin: float = 0.7,
    slowest: float = 1.0,
    duration: float = 1.0,
    dt: float | None = None,
    max_steps: int = 30,
) -> ControllerDesign:
    """`OutputFeedback` of least mean ITAE over models, every one with a disc margin.

    For each tracked output a unit step of its set-point is simulated; the cost is Σ ITAE of the
    errors of all tracked outputs, summed over the steps and averaged over the models. Subject to
    the disc margin of all inputs at once (on a grid of frequencies) and to poles faster than
    `slowest`, by an augmented Lagrangian. One model gives a frozen design, several the best fixed
    one. Not to be differentiated.

    Args:
        models: one model or a batch, without feedthrough.
        starts: gains to start from (start, nu, ny).
        bounds: lower and upper ones, numbers or (nu, ny).
        feedforward: F (nu, ny); none by default.
        tracked: outputs that follow their set-points.
        disc_margin: least one, see `disc_margin`.
        slowest: least decay rate of the closed loop, 1/s.
        duration: of the steps, s.
        dt: sample time, s, of continuous-time models.
        max_steps: of every search, of which the constraints need several.

    Returns:
        `ControllerDesign`; `infeasible` where no start ends within the constraints.

    Raises:
        ValueError: starts, bounds, tracked outputs or a duration that do not fit the models.

    Source: multi-model design as 002, section 4.2; the disc margin of Seiler, Packard and Gahinet
        (IEEE Control Systems 40 (2020) 78-95).

    Example:
        >>> from lpvid.control import design_output_feedback
        >>> drift = StateSpace([[1.0]], [[0.1]], [[1.0]], dt=0.1)
        >>> design_output_feedback(drift, starts=[[1.0]], bounds=(0.1, 9.0))
        Traceback (most recent call last):
        ValueError: starts has shape (1, 1): give (start, 1, 1).
    """
    dt = sample_time(models, dt)
    check_no_feedthrough(models)
    plants = models if models.is_discrete else models.discretise(dt)
    shape = (plants.nu, plants.ny)
    starts = np.asarray(starts, float)
    if starts.ndim != 3 or starts.shape[1:] != shape:
        raise ValueError(f"starts has shape {starts.shape}: give (start, {shape[0]}, {shape[1]}).")
    lower, upper = (np.broadcast_to(np.asarray(side, float), shape).ravel() for side in bounds)
    limits, flat = bounds_of(
        (lower.tolist(), upper.tolist()), starts.reshape(len(starts), -1), lower.size
    )
    tracked = tuple(int(channel) for channel in tracked)
    if not tracked or not all(0 <= channel < plants.ny for channel in tracked):
        raise ValueError(f"tracked={tracked}: give outputs from 0 to {plants.ny - 1}.")
    samples = round(duration / dt)
    if samples < 2:
        raise ValueError(f"duration={duration} s has fewer than two samples of {dt} s: raise it.")
    F = jnp.zeros(shape) if feedforward is None else jnp.asarray(feedforward, float)
    if F.shape != shape:
        raise ValueError(f"feedforward has shape {F.shape}: give {shape}.")
    if len(plants.batch_shape) > 1:
        raise ValueError(f"models have batch axes {plants.batch_shape}: one axis at most.")
    if not plants.batch_shape:
        plants = jax.tree.map(lambda leaf: leaf[None], plants)
    wanted = jnp.asarray([disc_margin, slowest], float)
    problem = (limits, F, tracked, wanted, samples, max_steps)
    return search_in_rounds(
        lambda starts, multipliers: _search(plants, starts, multipliers, *problem),
        flat,
        2 * plants.batch_shape[0],
        rounds=_ROUNDS,
        tolerance=1e-4,
        controller=lambda gains: OutputFeedback(gains.reshape(shape), F),
        names=tuple(f"K{i + 1}{j + 1}" for i in range(shape[0]) for j in range(shape[1])),
    )


def step_costs(
    plants: StateSpace,
    controller: SampledController,
    *,
    tracked: Sequence[int] = (0,),
    duration: float = 1.0,
) -> Float[Array, "*batch"]:
    """Σ ITAE of the tracked outputs over unit steps of each one's set-point.

    Composes with jit, vmap and grad.

    Args:
        plants: discrete-time model, or a batch.
        controller: linear, with a set-point for every output.
        tracked: outputs that follow their set-points.
        duration: of the steps, s.

    Example:
        >>> from lpvid.control import OutputFeedback, step_costs
        >>> drift = StateSpace([[1.0]], [[0.1]], [[1.0]], dt=0.1)
        >>> step_costs(drift, OutputFeedback([[5.0]], [[0.0]])).round(4)
        Array(0.0198, dtype=float64)
    """
    loop = settled(closed_loop(plants, controller, nr=plants.ny))
    rows = jnp.asarray(tracked)
    samples = round(duration / plants.dt)
    cost = jnp.zeros(plants.batch_shape)
    for channel in tracked:
        steps = jnp.zeros((samples, plants.ny)).at[:, channel].set(1.0)
        y = jnp.moveaxis(loop.simulate(u=steps)[..., rows], -1, -2)
        wanted = jnp.broadcast_to(steps[:, rows].T, y.shape)
        cost = cost + jnp.sum(itae(wanted - y, plants.dt), axis=-1)
    return cost


def balanced_sensitivity(
    plant: StateSpace, controller: SampledController, *, nr: int = 1
) -> StateSpace:
    """S − T at the plant's inputs, all loops closed: 2 / ‖S − T‖∞ is the disc margin.

    Args:
        plant: discrete-time, without feedthrough; leading batch axes give a batch.
        controller: its linear part closes the loop.
        nr: number of set-points.

    Example:
        >>> from lpvid.control import OutputFeedback, balanced_sensitivity
        >>> drift = StateSpace([[1.0]], [[0.1]], [[1.0]], dt=0.1)
        >>> balanced_sensitivity(drift, OutputFeedback([[5.0]], [[0.0]])).dc_gain()
        Array([[-1.]], dtype=float64)
    """
    loop = closed_loop(plant, controller, nr=nr)
    states = loop.nx - plant.nx
    B = jnp.concatenate([plant.B, jnp.zeros((*plant.batch_shape, states, plant.nu))], axis=-2)
    # What enters the plant is u + d; S − T = 2 S − I maps d to 2 (u + d) − d.
    D = jnp.broadcast_to(jnp.eye(plant.nu), (*plant.batch_shape, plant.nu, plant.nu))
    return StateSpace(loop.A, B, 2.0 * loop.C[..., plant.ny :, :], D, dt=plant.dt)


def _smooth_maximum(values: Float[Array, "*batch several"]) -> Float[Array, "*batch"]:
    """A little above the maximum, and without its kinks, at which searches end."""
    return jax.nn.logsumexp(_SHARPNESS * values, axis=-1) / _SHARPNESS


@eqx.filter_jit
def _search(
    plants: StateSpace,
    starts: Array,
    multipliers: Multipliers,
    bounds: Bounds,
    feedforward: Array,
    tracked: tuple[int, ...],
    wanted: Array,
    samples: int,
    max_steps: int,
) -> tuple[Solution, Array, Multipliers]:
    omega = jnp.asarray(_FREQUENCIES) * (np.pi / plants.dt)

    def control(gains):
        return OutputFeedback(gains.reshape(feedforward.shape), feedforward)

    def cost(gains):
        duration = samples * plants.dt
        return jnp.mean(step_costs(plants, control(gains), tracked=tracked, duration=duration))

    def lacking(gains):
        spread = balanced_sensitivity(plants, control(gains), nr=plants.ny)
        sizes = jnp.linalg.norm(spread.frequency_response(omega), ord=2, axis=(-2, -1))
        margin = 2.0 / _smooth_maximum(sizes)
        decay = -_smooth_maximum(jnp.log(jnp.abs(jnp.linalg.eigvals(spread.A))) / plants.dt)
        return 1.0 - jnp.concatenate([margin / wanted[0], jnp.clip(decay / wanted[1], -10.0, 10.0)])

    return search_round(cost, lacking, starts, multipliers, bounds, max_steps)
