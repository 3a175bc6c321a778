"""Prediction over a horizon, its errors, and the fit of each record."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from lpvid.analysis._metrics import bft, nrmse_fit
from lpvid.models import StateSpace

# Plain lists of numbers are welcome where arrays are.
Numbers: TypeAlias = ArrayLike | Sequence[Any]

_DEFAULT_HORIZONS = (1, 2, 3, 5, 7, 10, 15, 20, 30, 50, 70, 100, 150, 200, 300, 500, 1000)


class HorizonErrors(eqx.Module):
    """Errors of prediction over several horizons.

    Attributes:
        horizons: samples ahead, rising; infinite for simulation.
        rmse: root mean square error, (horizon, ny).
        fit: 100 (1 − |y − ŷ| / |y − mean y|) in percent, (horizon, ny).
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
    x0: Numbers | None = None,
    horizon: int | None = 1,
    lengths: Sequence[int] | None = None,
) -> Float[Array, "time ny"]:
    r"""Output predicted `horizon` samples ahead, $\hat y(t \mid t - k)$.

    The predictor $x^+ = A x + B u + K e$ with the innovation $e = y - C x - D u$ knows the outputs
    up to t − k and the inputs up to t. One step comes from the blocked simulation of the predictor,
    k steps from $\hat y(t|t-k) = \hat y(t|t-1) - C \sum_{j=1}^{k-1} A^{j-1} K e(t-j)$, whose sum
    is built by doubling: log2 k products over all samples, no loop over time, and no cancellation
    where the model is unstable. The first k samples of a record are simulated from `x0`.

    Works under `jit`, `vmap` and `grad` (forward and reverse).

    Args:
        model: discrete-time `StateSpace`; for simulation anything with `simulate(u=, x0=)`.
        u: input, (time, nu) or (time,), records one after another.
        y: measured output, (time, ny) or (time,); not needed for simulation.
        gain: innovation gain K, (nx, ny); without it the output is simulated, whatever the horizon.
        x0: state at the start of each record, (record, nx) or (nx,); zero by default.
        horizon: k, at least 1; `None` for simulation (an infinite horizon).
        lengths: samples of each record; one record by default.

    Returns:
        Prediction (time, ny).

    Raises:
        ValueError: shapes or lengths that do not fit, a horizon below 1, or a gain for a model that
            is no discrete-time `StateSpace`.

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
    inputs = _channels(u, "u")
    records = _records(lengths, inputs.shape[0])
    if horizon is not None and (isinstance(horizon, bool) or horizon < 1 or horizon % 1 != 0):
        raise ValueError(f"horizon is {horizon!r}; give a whole number of at least 1, or None.")
    if gain is None or horizon is None:
        return _simulated(model, inputs, x0, records)
    first, states = _one_step(model, inputs, y, gain, x0, records)
    return first - _forgotten(model, states, np.array([int(horizon)]), records)[0]


def horizon_errors(
    model: Any,
    *,
    u: Numbers,
    y: Numbers,
    gain: Numbers | None = None,
    x0: Numbers | None = None,
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
        x0: as for `predict`.
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
    inputs, measured = _channels(u, "u"), _channels(y, "y")
    records = _records(lengths, inputs.shape[0])
    simulated = _simulated(model, inputs, x0, records)
    if simulated.shape != measured.shape:
        raise ValueError(
            f"y has shape {measured.shape}, the model's output {simulated.shape}; give all outputs "
            "of the model over the time of u, time first."
        )
    predictions, steps = simulated[None], []
    if gain is not None:
        if horizons is None:
            steps = [k for k in _DEFAULT_HORIZONS if k <= max(1, min(records) // 4)]
        else:
            steps = sorted({int(k) for k in horizons})
        if steps and steps[0] < 1:
            raise ValueError(f"horizons: {steps[0]} is given; at least 1 sample ahead is needed.")
    if steps:
        first, states = _one_step(model, inputs, y, gain, x0, records)
        ahead = first[None] - _forgotten(model, states, np.array(steps), records)
        predictions = jnp.concatenate([ahead, predictions])
    error = measured[None] - predictions
    return HorizonErrors(
        horizons=jnp.asarray([*steps, np.inf], float),
        rmse=jnp.sqrt(jnp.mean(error**2, axis=1)),
        fit=jnp.stack([nrmse_fit(measured, one) for one in predictions]),
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
    measured, predicted = _channels(y, "y"), _channels(y_hat, "y_hat")
    if measured.shape != predicted.shape:
        raise ValueError(
            f"y has shape {measured.shape} and y_hat {predicted.shape}; give both in the same "
            "shape, time first."
        )
    cuts = np.cumsum(_records(lengths, measured.shape[0]))[:-1]
    pairs = zip(jnp.split(measured, cuts), jnp.split(predicted, cuts), strict=True)
    return jnp.stack([metric(one, other) for one, other in pairs])


def _one_step(model, u, y, gain, x0, records) -> tuple[Array, Array]:
    """One-step prediction (time, ny) and the corrections K e (time, nx)."""
    if not isinstance(model, StateSpace) or not model.is_discrete or model.A.ndim != 2:
        raise ValueError(
            "model: with a gain one discrete-time StateSpace is needed; discretise it at the "
            "data's sample time, use jax.vmap for a batch, or leave gain out to simulate."
        )
    if y is None:
        raise ValueError("y: prediction with a gain needs the measured output.")
    measured, K = _channels(y, "y"), jnp.asarray(gain, float)
    if measured.shape != (u.shape[0], model.ny):
        raise ValueError(f"y has shape {measured.shape}; ({u.shape[0]}, {model.ny}) is needed.")
    if K.shape != (model.nx, model.ny):
        raise ValueError(f"gain has shape {K.shape}; ({model.nx}, {model.ny}) is needed.")
    predictor = StateSpace(
        model.A - K @ model.C,
        jnp.concatenate([model.B - K @ model.D, K], axis=1),
        model.C,
        jnp.concatenate([model.D, jnp.zeros((model.ny, model.ny))], axis=1),
        dt=model.dt,
    )
    predicted = _simulated(predictor, jnp.concatenate([u, measured], axis=1), x0, records)
    return predicted, (measured - predicted) @ K.T


def _forgotten(model, corrections, horizons: np.ndarray, records) -> Float[Array, "h time ny"]:
    """What the one-step prediction knows beyond each horizon's, C Σ_{j<k} A^{j-1} K e(t − j)."""
    position = np.concatenate([np.arange(n) for n in records])
    # No sum is longer than the longest record.
    counts = np.minimum(horizons, max(records)) - 1
    bits = max(int(counts.max()).bit_length(), 1)
    sums = _geometric_sums(model.A, corrections, position, counts, bits)
    return sums @ model.C.T


@partial(jax.jit, static_argnums=4)
def _geometric_sums(A, w, position, counts, bits: int) -> Float[Array, "h time nx"]:
    """Σ_{j=1}^{count} A^{j-1} w(t − j) in each record, for every count below 2^bits."""

    def delayed(signal, by):
        moved = jnp.roll(signal, by, axis=0)
        return jnp.where((position >= by)[:, None], moved, 0.0)

    # Sums of 1, 2, 4, … terms from the last sample on, and the power each leads to.
    terms, power, doubled = w, A, []
    for bit in range(bits):
        doubled.append((terms, power))
        if bit + 1 < bits:
            terms = terms + delayed(terms, 2**bit) @ power.T
            power = power @ power

    def one(count):
        total = jnp.zeros_like(w)
        for bit, (terms, power) in enumerate(doubled):
            longer = terms + delayed(total, 2**bit) @ power.T
            total = jnp.where((count >> bit) % 2 == 1, longer, total)
        return delayed(total, 1)

    return jax.lax.map(one, counts)


def _simulated(model, u, x0, records) -> Float[Array, "time ny"]:
    """Response record by record, all at once where they have one length."""
    if not hasattr(model, "simulate"):
        raise ValueError(f"model is a {type(model).__name__}, which has no simulate(u=, x0=).")
    starts = _starts(x0, len(records))
    if len(records) == 1:
        return model.simulate(u=u, x0=None if starts is None else starts[0])
    if len(set(records)) == 1 and isinstance(model, StateSpace):
        parts = u.reshape(len(records), records[0], u.shape[1])
        start = jnp.zeros((len(records), model.nx)) if starts is None else starts
        return jax.vmap(lambda a, b: model.simulate(u=a, x0=b))(parts, start).reshape(
            u.shape[0], -1
        )
    parts = jnp.split(u, np.cumsum(records)[:-1])
    firsts = [None] * len(records) if starts is None else list(starts)
    pieces = [model.simulate(u=a, x0=b) for a, b in zip(parts, firsts, strict=True)]
    return jnp.concatenate(pieces)


def _starts(x0: Numbers | None, count: int) -> Array | None:
    if x0 is None:
        return None
    starts = jnp.asarray(x0, float)
    if starts.ndim == 1:
        return jnp.broadcast_to(starts, (count, *starts.shape))
    if starts.ndim != 2 or starts.shape[0] != count:
        raise ValueError(
            f"x0 has shape {starts.shape}; give (nx,), or one state for each of {count} records."
        )
    return starts


def _records(lengths: Sequence[int] | None, n_samples: int) -> tuple[int, ...]:
    records = (n_samples,) if lengths is None else tuple(int(n) for n in lengths)
    if sum(records) != n_samples or min(records, default=0) < 1:
        raise ValueError(f"lengths: {records} do not add up to the {n_samples} samples.")
    return records


def _channels(values: Numbers, name: str) -> Float[Array, "time channel"]:
    array = jnp.asarray(values, float)
    array = array[:, None] if array.ndim == 1 else array
    if array.ndim != 2:
        raise ValueError(f"{name} has shape {array.shape}; give (time, channel), time first.")
    return array
