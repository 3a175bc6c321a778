"""PI control by ITAE, within bounds (002, section 4.1)."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from lpvid._results import Solution
from lpvid._solve import Bounds
from lpvid.control._closed_loop import Numbers, check_no_feedthrough, sample_time
from lpvid.control._controllers import ProportionalIntegral
from lpvid.control._criteria import itae
from lpvid.control._linear_loop import closed_loop
from lpvid.control._search import (
    ControllerDesign,
    GainBounds,
    bounds_of,
    search_gains,
    settled,
)
from lpvid.models import StateSpace

# A search that a kink ended may go on from there.
_RESTARTS = 10


def design_pi(
    model: StateSpace,
    *,
    starts: Numbers = ((0.3, 0.01), (1.0, 0.1), (1.0, 1e-3), (0.1, 0.1)),
    bounds: GainBounds = ((5e-3, 5e-6), (2.0, 0.2)),
    set_point: float = 3.0,
    duration: float = 10.0,
    dt: float | None = None,
    max_steps: int = 60,
) -> ControllerDesign:
    """PI gains of least ITAE for a step of the first output, by gradient through the simulation.

    L-BFGS in coordinates that keep within the bounds, on the logarithm of the cost, from every
    start at once. A search ends early where the absolute error makes a kink: it is then begun
    again, and several starts are worth their time. Not to be differentiated; the simulated cost
    itself is, see `simulate_closed_loop` and `itae`.

    Args:
        model: one linear model without feedthrough, its first output the one that is set.
        starts: (start, 2) of K_P in V/V and K_I in V/(V·s).
        bounds: lower and upper ones of both. 002 gives the upper ones by saturation and stability.
        set_point: R, V.
        duration: of the simulated step, s.
        dt: sample time, s, of a continuous-time model.
        max_steps: of every search.

    Returns:
        `ControllerDesign` with a `ProportionalIntegral`; its cost is J of equation 4-1, V·s².

    Raises:
        ValueError: bounds or starts that do not fit, a batch of models, a feedthrough, no sample
            time, a duration of fewer than two samples.

    Source: 002, equation 4-1 and table 4-1.

    Example:
        >>> motor = StateSpace([[0.0, 1.0], [0.0, -4.0]], [[0.0], [4.0]], [[1.0, 0.0]])
        >>> design_pi(motor)
        Traceback (most recent call last):
        ValueError: dt=None: the model is in continuous time; give the controller's sample time, s.
    """
    limits, starts = bounds_of(bounds, starts, 2)
    dt = sample_time(model, dt)
    check_no_feedthrough(model)
    if model.batch_shape:
        raise ValueError(f"model has batch axes {model.batch_shape}: design for one at a time.")
    samples = round(duration / dt)
    if samples < 2:
        raise ValueError(f"duration={duration} s has fewer than two samples of {dt} s: raise it.")
    reference = jnp.full(samples, float(set_point))
    sampled = model if model.is_discrete else model.discretise(dt)
    found = _search(sampled, starts, limits, reference, max_steps)
    for _ in range(_RESTARTS):
        before = found.cost
        found = _search(sampled, found.value, limits, reference, max_steps)
        if not jnp.any(found.cost < before - 1e-6):
            break
    best = jax.tree.map(lambda leaf: leaf[jnp.argmin(found.cost)], found)
    return ControllerDesign(
        controller=ProportionalIntegral(best.value[0], best.value[1], dt=dt),
        cost=jnp.exp(best.cost),
        status=best.status,
        gains=found.value,
        costs=jnp.exp(found.cost),
        names=("K_P", "K_I"),
    )


@eqx.filter_jit
def _search(
    model: StateSpace,
    starts: Array,
    bounds: Bounds,
    reference: Array,
    max_steps: int,
) -> Solution:
    def loss(gains):
        controller = ProportionalIntegral(gains[0], gains[1], dt=model.dt)
        y = settled(closed_loop(model, controller)).simulate(u=reference)
        # The logarithm tames the growth of a loop that is not stable.
        return jnp.log(itae(reference - y[:, 0], model.dt))

    return jax.vmap(lambda start: search_gains(loss, start, bounds, max_steps))(starts)
