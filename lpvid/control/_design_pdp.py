"""PDP control over several models at once, margins as constraints (002, section 4.2)."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lpvid._results import Solution
from lpvid._solve import Bounds
from lpvid.control._closed_loop import Numbers, check_no_feedthrough, sample_time
from lpvid.control._controllers import PDP
from lpvid.control._criteria import itae
from lpvid.control._linear_loop import closed_loop, loop_transfer
from lpvid.control._margins import margins
from lpvid.control._search import (
    ControllerDesign,
    GainBounds,
    Multipliers,
    bounds_of,
    search_in_rounds,
    search_round,
    settled,
)
from lpvid.models import StateSpace

# Most searches after the first.
_ROUNDS = 10


def design_pdp(
    models: Sequence[StateSpace],
    *,
    starts: Numbers = ((0.3, 1.0, 0.1), (0.594, 4.266, 0.254), (0.8, 4.0, 0.5)),
    bounds: GainBounds = ((0.005, 0.05, 0.005), (1.0, 15.0, 2.0)),
    error_weight: float = 0.5,
    strain_weight: float = 0.5,
    gain_margin: float = 10.0,
    phase_margin: float = 55.0,
    duration: float = 10.0,
    dt: float | None = None,
    max_steps: int = 40,
) -> ControllerDesign:
    """PDP gains for several payloads at once, by gradient through the simulation.

    Minimises W_E Σ E_i + W_sg Σ Y_i over the models' steps, subject to the gain and phase margins
    of each model's loop opened at the position error (equation 4-2): L-BFGS on the logarithm of the
    cost within the bounds, the margins by an augmented Lagrangian, from every start at once. Not to
    be differentiated; `pdp_cost` and `margins` are.

    Args:
        models: linear models without feedthrough of the arm's four outputs, of any orders, all in
            continuous time or of one sample time.
        starts: (start, 3) of K_P, K_d and K_sg, V/V.
        bounds: lower and upper ones of the three.
        error_weight: W_E.
        strain_weight: W_sg.
        gain_margin: least one of every model, dB.
        phase_margin: least one of every model, degrees.
        duration: of the simulated step, s.
        dt: sample time, s, of continuous-time models.
        max_steps: of every search, of which the margins need several.

    Returns:
        `ControllerDesign` with a `PDP`; its status is `infeasible` where no start ends with the
        margins.

    Raises:
        ValueError: no models, models of other outputs or sample times, with a feedthrough or with
            batch axes; bounds or starts that do not fit; a duration of fewer than two samples.

    Source: 002, equations 4-2 to 4-5 and table 4-2.

    Example:
        >>> design_pdp([])
        Traceback (most recent call last):
        ValueError: models: give at least one.
    """
    limits, starts = bounds_of(bounds, starts, 3)
    plants = _stacked(models, dt)
    samples = round(duration / plants.dt)
    if samples < 2:
        raise ValueError(f"duration={duration} s has fewer than two samples: raise it.")
    weights = jnp.asarray([error_weight, strain_weight], float)
    wanted = jnp.asarray([gain_margin, phase_margin], float)
    problem = (limits, weights, wanted, samples, max_steps)
    return search_in_rounds(
        lambda starts, multipliers: _search(plants, starts, multipliers, *problem),
        starts,
        2 * len(models),
        rounds=_ROUNDS,
        tolerance=1e-5,
        controller=lambda gains: PDP(gains[0], gains[1], gains[2]),
        names=("K_P", "K_d", "K_sg"),
    )


def pdp_cost(
    plant: StateSpace, controller: PDP, *, duration: float = 10.0
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """E and Y of a step: ITAE of the position error, and of both strains over their peaks.

    Composes with jit, vmap and grad.

    Args:
        plant: discrete-time model of the arm's four outputs; leading batch axes give a batch.
        controller: the controller.
        duration: of the step, s.

    Returns:
        E_i of equation 4-4 and Y_i of equation 4-5, s².

    Source: 002, equations 4-4 and 4-5.

    Example:
        >>> A, B = 0.9 * jnp.eye(1), jnp.ones((1, 1))
        >>> plant = StateSpace(A, B, [[0.1], [0.0], [1.0], [0.0]], dt=0.1)
        >>> error, strain = pdp_cost(plant, PDP(1.0, 0.0, 0.0), duration=1.0)
        >>> error.round(4)
        Array(0.2874, dtype=float64)
    """
    y = settled(closed_loop(plant, controller)).simulate(
        u=jnp.ones((round(duration / plant.dt), 1))
    )
    error = itae(1.0 - y[..., 0], plant.dt)
    strains = jnp.moveaxis(y[..., 1:3], -1, -2)
    peaks = jnp.max(jnp.abs(strains), axis=-1)
    sizes = itae(strains, plant.dt)
    return error, jnp.sum(sizes / jnp.where(peaks > 0.0, peaks, 1.0), axis=-1)


def _stacked(models: Sequence[StateSpace], dt: float | None) -> StateSpace:
    """The models as a batch, padded with states that nothing reaches."""
    if not models:
        raise ValueError("models: give at least one.")
    sampled = []
    for model in models:
        step = sample_time(model, dt)
        check_no_feedthrough(model)
        if model.batch_shape or (model.ny, model.nu) != (4, 1):
            raise ValueError(
                f"models: each must be one model with the arm's four outputs and one input, got "
                f"{model!r}."
            )
        sampled.append(model if model.is_discrete else model.discretise(step))
    if len({model.dt for model in sampled}) > 1:
        raise ValueError("models: their sample times differ; resample them to one.")
    order = max(model.nx for model in sampled)

    def padded(matrix: Array, rows: int, columns: int) -> Array:
        return jnp.pad(matrix, ((0, rows - matrix.shape[0]), (0, columns - matrix.shape[1])))

    return StateSpace(
        jnp.stack([padded(model.A, order, order) for model in sampled]),
        jnp.stack([padded(model.B, order, 1) for model in sampled]),
        jnp.stack([padded(model.C, 4, order) for model in sampled]),
        dt=sampled[0].dt,
    )


@eqx.filter_jit
def _search(
    plants: StateSpace,
    starts: Array,
    multipliers: Multipliers,
    bounds: Bounds,
    weights: Array,
    wanted: Array,
    samples: int,
    max_steps: int,
) -> tuple[Solution, Array, Multipliers]:
    def cost(gains):
        error, strain = pdp_cost(plants, PDP(*gains), duration=samples * plants.dt)
        return weights[0] * jnp.sum(error) + weights[1] * jnp.sum(strain)

    def lacking(gains):
        found = margins(loop_transfer(plants, PDP(*gains)))
        reached = jnp.stack([found.gain_margin_decibels, found.phase_margin])
        # Beyond ten times the margin asked for nothing is gained; infinite ones stay finite.
        return 1.0 - (jnp.clip(reached / wanted[:, None], -10.0, 10.0)).ravel()

    return search_round(cost, lacking, starts, multipliers, bounds, max_steps)
