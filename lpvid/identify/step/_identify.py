"""Identification from records that settle: one function, the methods are objects."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from lpvid._results import Status
from lpvid.data import IOData
from lpvid.identify.step._deviations import DeviationSubspace
from lpvid.identify.step._experiments import prepare
from lpvid.identify.step._method import AbstractStepMethod, Realisation
from lpvid.models import StateSpace


class StepResponseFit(eqx.Module):
    """Result of `identify_step_response`.

    Standard deviations of the moments are in `stats`; the model has none of its own:
    `lpvid.refine(fit, data)` starts from it and has its covariance.

    Attributes:
        model: the continuous-time model.
        singular_values: of the method's Hankel matrix, largest first.
        moments: ρ_0 = D − C A⁻¹ B, ρ_i = −C A^(−i−1) B as far as the method measured them,
            (moment, ny, nu); `DeviationSubspace` measures ρ_0 alone.
        final_inputs: means over the settled windows, (record, nu).
        final_outputs: means over the settled windows, (record, ny).
        windows: start and end of each record's settled window, in seconds from its first sample,
            (record, 2).
        order: number of states.
        status: how it ended.
        stats: arrays by name: `moments_std` (standard deviations of the moments, of white output
            noise or rounding), `noise` of each output in the settled windows, (ny,),
            `singular_value_floor` (below it they are noise), `poles_moved` to make the model
            stable, `growth_rate` (largest real part of the poles, 1/s).

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.identify import PrimalRealisation, identify_step_response
        >>> t = 0.01 * np.arange(2000)
        >>> data = IOData(u=2.0 * np.ones(2000), y=2.0 - 2.0 * np.exp(-3.0 * t), dt=0.01)
        >>> fit = identify_step_response(data, order=1, method=PrimalRealisation())
        >>> fit.moments[:2, 0, 0].round(6).tolist(), fit.windows.shape
        ([1.0, -0.333333], (1, 2))
    """

    model: StateSpace
    singular_values: Float[Array, " row"]
    moments: Float[Array, "moment ny nu"]
    final_inputs: Float[Array, "record nu"]
    final_outputs: Float[Array, "record ny"]
    windows: Float[Array, "record 2"]
    order: int = eqx.field(static=True)
    status: Status
    stats: dict[str, Array]


def identify_step_response(
    data: IOData,
    *,
    order: int,
    method: AbstractStepMethod | None = None,
    settled: float | None = None,
    band: float = 0.02,
    throw: bool = True,
) -> StepResponseFit:
    """Identify a continuous-time model from step responses and other records that settle.

    Each record is one experiment from rest: inputs that settle at constant values, in steps of any
    size or otherwise, one or several at once. The final inputs of all records span the inputs; more
    records than inputs are averaged. A record may start before its inputs move, and the records may
    have different lengths. The plant has no pole at zero.

    Final values are means over a settled window. It starts a third later than the last instant at
    which means over a hundredth of the record can be told from the final value, but spares the last
    fifth at least. The methods integrate up to the window and no further.

    With `settled` given it runs under `jax.jit` and `jax.vmap` (records then start with their
    inputs' onset, and nothing is checked); there the moment methods differentiate with respect to
    the samples, while `DeviationSubspace` does not (eigenvectors).

    Args:
        data: one record for each experiment.
        order: number of states.
        method: `DeviationSubspace()` by default, for measured data; `PrimalRealisation()` and
            `DualRealisation()` are the published method (003).
        settled: seconds from each record's start at which all has settled; `None` looks for it.
        band: how much a channel may drift over the last fifth of a record, as a share of its
            largest range, and still count as settled.
        throw: raise where the model is not finite. `False` returns it with its status.

    Returns:
        The model, with moments, final values, windows, singular values and status.

    Raises:
        ValueError: naming channel, record and remedy: a channel that has not settled, with how far
            it is from it; fewer records than inputs; final inputs that are proportional across the
            records; records not at rest before the inputs move; an order that the method cannot
            carry.

    Warns:
        UserWarning: the model is unstable, or the order is above what the noise lets one see.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.identify import identify_step_response
        >>> t = 0.01 * np.arange(1000)
        >>> data = IOData(u=2.0 * np.ones(1000), y=2.0 - 2.0 * np.exp(-3.0 * t), dt=0.01)
        >>> round(identify_step_response(data, order=1).model.A.item(), 6)
        -3.0
    """
    method = DeviationSubspace() if method is None else method
    if not isinstance(method, AbstractStepMethod):
        raise ValueError(
            f"method={method!r} is no method for step responses: give DeviationSubspace(), "
            f"PrimalRealisation() or DualRealisation()."
        )
    _check_order(order, method, data)
    if not 0.0 < band < 1.0:
        raise ValueError(f"band={band!r}: give a share between 0 and 1, such as 0.02.")
    experiments, onsets = prepare(data, settled, band)
    found = method.realise(experiments, order)
    model = StateSpace(found.A, found.B, found.C, found.D)
    start = (experiments.window + jnp.asarray(onsets)).astype(float) * data.dt
    end = (experiments.lengths + jnp.asarray(onsets)).astype(float) * data.dt
    status, growth = _status(found)
    fit = StepResponseFit(
        model=model,
        singular_values=found.singular_values,
        moments=found.moments,
        final_inputs=experiments.final_u,
        final_outputs=experiments.final_y,
        windows=jnp.stack([start, end], axis=1),
        order=order,
        status=status,
        stats=dict(
            moments_std=found.moments_std,
            noise=experiments.noise,
            singular_value_floor=found.floor,
            poles_moved=found.poles_moved,
            growth_rate=growth,
        ),
    )
    if not isinstance(found.A, Tracer):
        _report(fit, throw)
    return fit


def _check_order(order: int, method: AbstractStepMethod, data: IOData) -> None:
    if isinstance(order, bool) or not isinstance(order, int) or order < 1:
        raise ValueError(f"order={order!r}: give a positive whole number.")
    largest = method.largest_order(data.ny, data.nu, min(data.lengths))
    if order > largest:
        raise ValueError(
            f"order={order} is more than {type(method).__name__} can carry with these records "
            f"({largest}): lower it."
        )


@jax.jit
def _status(found: Realisation) -> tuple[Status, Array]:
    matrices = (found.A, found.B, found.C, found.D)
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(m)) for m in matrices]))
    # LAPACK does not end well on NaN everywhere.
    safe = jnp.where(finite, found.A, -jnp.eye(found.A.shape[0]))
    growth = jnp.max(jnp.linalg.eigvals(safe).real)
    status = Status.where(growth >= 0.0, Status.unstable, Status.successful)
    status = Status.where(found.resolved, status, Status.ill_conditioned)
    return Status.where(finite, status, Status.nonfinite), growth


def _report(fit: StepResponseFit, throw: bool) -> None:
    """Raise or warn, with the remedy."""
    if fit.status == Status.nonfinite and throw:
        raise ValueError(
            f"The model is not finite: order={fit.order} is above what these records show, or a "
            f"discrete-time pole has no logarithm. Lower the order, or use DeviationSubspace(); "
            f"throw=False returns the model as it is."
        )
    unstable = float(fit.stats["growth_rate"]) >= 0.0
    if fit.status == Status.ill_conditioned:
        values = np.asarray(fit.singular_values)
        floor = float(fit.stats["singular_value_floor"])
        visible = int(np.sum(values[: fit.order] > floor))
        warnings.warn(
            f"order={fit.order} is above what these records show: {visible} singular values rise "
            f"above noise and rounding ({floor:.2g}){', and the model is unstable' * unstable}. "
            f"Lower the order, take larger steps, or use DeviationSubspace(), which bears more "
            f"noise than the moment methods.",
            stacklevel=3,
        )
    elif fit.status == Status.unstable:
        warnings.warn(
            f"The identified model is unstable (a pole grows at "
            f"{float(fit.stats['growth_rate']):.3g} 1/s), though the records settle: a model of "
            f"reduced order from moments may be. Use another order, or DeviationSubspace().",
            stacklevel=3,
        )
