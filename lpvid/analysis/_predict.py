"""Prediction over a horizon, its errors, and the fit of each record."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.analysis._metrics import bft, nrmse_fit
from lpvid.analysis._runs import (
    Numbers,
    as_channels,
    as_schedule,
    predict_ahead,
    record_lengths,
    run_of,
    simulate_run,
)

_DEFAULT_HORIZONS = (1, 2, 3, 5, 7, 10, 15, 20, 30, 50, 70, 100, 150, 200, 300, 500, 1000)


class HorizonErrors(eqx.Module):
    """Errors of prediction over several horizons.

    Attributes:
        horizons: samples ahead, rising; infinite for simulation.
        rmse: root mean square error, (horizon, ny).
        fit: 100 (1 − |y − ŷ| / |y − mean y|) in percent, the mean taken in each record,
            (horizon, ny).
    """

    horizons: Float[Array, " horizon"]
    rmse: Float[Array, "horizon ny"]
    fit: Float[Array, "horizon ny"]


def predict(
    model: Any,
    *,
    u: Numbers,
    y: Numbers | None = None,
    gain: Numbers | None = None,
    kappa: Numbers | None = None,
    dt: float | None = None,
    x0: Numbers | None = None,
    output_offset: Numbers | None = None,
    horizon: int | None = 1,
    lengths: Sequence[int] | None = None,
) -> Float[Array, "time ny"]:
    r"""Output predicted `horizon` samples ahead, $\hat y(t \mid t - k)$.

    The predictor $x^+ = A x + B u + K e$ with the innovation $e = y - C x - D u$ knows the outputs
    up to t − k and the inputs up to t. One step comes from the blocked simulation of the predictor,
    k steps from $\hat y(t|t-k) = \hat y(t|t-1) - C \sum_{j=1}^{k-1} A^{j-1} K e(t-j)$, whose sum
    is built by doubling: log2 k products over all samples, no loop over time, and no cancellation
    where the model is unstable. LPV and nonlinear models step: from every state of the one-step
    predictor x̂⁺ = f(x̂, t) + K e the model runs k − 1 samples on its own, all at once, along the
    measured input and schedule. The first k samples of a record are simulated from `x0`.

    Works under `jit`, `vmap` and `grad` (forward and reverse).

    Args:
        model: what `identify` or `refine` returned, whose model, gain and output offset are used;
            or a `StateSpace`, `StructuredModel`, `LPVStateSpace`, `GrayBoxLPV`, `NonlinearModel` or
            another module with `step(x, u, dt=)`; for simulation anything with `simulate(u=, x0=)`.
        u: input, (time, nu) or (time,), records one after another.
        y: measured output, (time, ny) or (time,); not needed for simulation, and a fit given none
            is simulated.
        gain: innovation gain K, (nx, ny), by default the fit's; without one the output is
            simulated, whatever the horizon.
        kappa: schedule (time, nk), or (time,) for one scheduling variable, of an LPV model.
        dt: sample time, s, of a model in continuous time.
        x0: state at the start of each record, (record, nx) or (nx,); zero by default, since a
            fit's `x0` is that of the records it was fitted to.
        output_offset: constant to add to the model's outputs, (ny,) or (record, ny); by default
            the fit's, which has to be of as many records where it is of each.
        horizon: k, at least 1; `None` for simulation (an infinite horizon).
        lengths: samples of each record; one record by default.

    Returns:
        Prediction (time, ny).

    Raises:
        ValueError: shapes or lengths that do not fit, a horizon below 1, a schedule or sample time
            that is missing, or a gain for a model whose state cannot be corrected.

    Example:
        >>> import numpy as np
        >>> from lpvid.analysis import predict
        >>> from lpvid.models import StateSpace
        >>> model = StateSpace([[0.5]], [[1.0]], [[1.0]], dt=0.1)
        >>> y = np.array([1.0, 3.0, 1.0, 1.0])
        >>> predict(model, u=np.ones(4), y=y, gain=[[0.5]], horizon=1)[:, 0].tolist()
        [0.0, 1.5, 2.5, 1.5]
        >>> predict(model, u=np.ones(4))[:, 0].tolist()
        [0.0, 1.0, 1.5, 1.75]
    """
    inputs, schedule = as_channels(u, "u"), as_schedule(kappa, u)
    records = record_lengths(lengths, inputs.shape[0])
    if horizon is not None and (isinstance(horizon, bool) or horizon < 1 or horizon % 1 != 0):
        raise ValueError(f"horizon is {horizon!r}; give a whole number of at least 1, or None.")
    along = run_of(model, schedule, dt, records, gain, output_offset)
    if along.gain is None or horizon is None or (gain is None and y is None):
        return simulate_run(along, inputs, x0)
    return predict_ahead(along, inputs, y, x0, (int(horizon),))[0]


def horizon_errors(
    model: Any,
    *,
    u: Numbers,
    y: Numbers,
    gain: Numbers | None = None,
    kappa: Numbers | None = None,
    dt: float | None = None,
    x0: Numbers | None = None,
    output_offset: Numbers | None = None,
    horizons: Sequence[int] | None = None,
    lengths: Sequence[int] | None = None,
) -> HorizonErrors:
    """Errors of `predict` over several horizons, and of simulation as the last one.

    An error that grows little from one step to simulation is noise that the model cannot know; one
    that grows steadily is dynamics that the gain makes good for.

    Args:
        model: as for `predict`.
        u: as for `predict`.
        y: as for `predict`.
        gain: as for `predict`; without it there is simulation alone.
        kappa: as for `predict`.
        dt: as for `predict`.
        x0: as for `predict`.
        output_offset: as for `predict`.
        horizons: samples ahead; 1, 2, 3, 5, … below a quarter of the shortest record by default.
        lengths: as for `predict`.

    Returns:
        Root mean square errors and fits over all records together, per output.

    Raises:
        ValueError: as `predict`.

    Example:
        >>> import numpy as np
        >>> from lpvid.analysis import horizon_errors
        >>> from lpvid.models import StateSpace
        >>> model = StateSpace([[0.5]], [[1.0]], [[1.0]], dt=0.1)
        >>> u, noise = np.random.default_rng(0).standard_normal((2, 200))
        >>> y = model.simulate(u=u) + noise[:, None]
        >>> errors = horizon_errors(model, u=u, y=y, gain=[[0.2]], horizons=[1, 5])
        >>> errors.horizons.tolist(), errors.rmse.shape
        ([1.0, 5.0, inf], (3, 1))
    """
    inputs, measured = as_channels(u, "u"), as_channels(y, "y")
    records = record_lengths(lengths, inputs.shape[0])
    along = run_of(model, as_schedule(kappa, u), dt, records, gain, output_offset)
    simulated = simulate_run(along, inputs, x0)
    if simulated.shape != measured.shape:
        raise ValueError(
            f"y has shape {measured.shape}, the model's output {simulated.shape}; give all outputs "
            "of the model over the time of u, time first."
        )
    predictions, steps = simulated[None], []
    if along.gain is not None:
        if horizons is None:
            steps = [k for k in _DEFAULT_HORIZONS if k <= max(1, min(along.records) // 4)]
        else:
            wrong = [k for k in horizons if k < 1 or k % 1 != 0]
            if wrong:
                raise ValueError(
                    f"horizons: {wrong[0]} is given; give whole numbers of at least 1 sample."
                )
            steps = sorted({int(k) for k in horizons})
    if steps:
        ahead = predict_ahead(along, inputs, y, x0, tuple(steps))
        predictions = jnp.concatenate([ahead, predictions])
    error = measured[None] - predictions
    # Each record about its own mean, so that records at different levels do not flatter the fit.
    level = jnp.concatenate(
        [
            jnp.broadcast_to(jnp.mean(one, 0, keepdims=True), one.shape)
            for one in along.cut(measured)
        ]
    )
    return HorizonErrors(
        horizons=jnp.asarray([*steps, np.inf], float),
        rmse=jnp.sqrt(jnp.mean(error**2, axis=1)),
        fit=jnp.stack([nrmse_fit(measured - level, one - level) for one in predictions]),
    )


def fit_by_record(
    y: Numbers,
    y_hat: Numbers,
    lengths: Sequence[int],
    *,
    metric: Callable[[Array, Array], Array] = bft,
) -> Float[Array, "record ny"]:
    """A fit measure of each output in each record: where a model that fits on average does not.

    Args:
        y: measured output, (time, ny) or (time,), records one after another.
        y_hat: prediction, same shape.
        lengths: samples of each record.
        metric: `bft`, `nrmse_fit`, `vaf`, `relative_error` or another function of y and ŷ.

    Returns:
        Values (record, ny).

    Raises:
        ValueError: shapes differ, or the lengths do not add up to the record.

    Example:
        >>> import numpy as np
        >>> from lpvid.analysis import fit_by_record
        >>> y = np.array([0.0, 1.0, 0.0, 2.0])
        >>> fit_by_record(y, np.array([0.0, 1.0, 1.0, 1.0]), (2, 2)).tolist()
        [[100.0], [0.0]]
    """
    measured, predicted = as_channels(y, "y"), as_channels(y_hat, "y_hat")
    if measured.shape != predicted.shape:
        raise ValueError(
            f"y has shape {measured.shape} and y_hat {predicted.shape}; give both in the same "
            "shape, time first."
        )
    cuts = np.cumsum(record_lengths(lengths, measured.shape[0]))[:-1]
    pairs = zip(jnp.split(measured, cuts), jnp.split(predicted, cuts), strict=True)
    return jnp.stack([metric(one, other) for one, other in pairs])
