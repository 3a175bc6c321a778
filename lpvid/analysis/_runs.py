"""Simulation and prediction of a model along records."""

import inspect
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from lpvid.models import (
    AbstractSteps,
    GrayBoxLPV,
    LPVStateSpace,
    StateSpace,
    StructuredModel,
    can_step,
    one_step_predictor,
    steps_of,
    takes_schedule,
)

# Plain lists of numbers are welcome where arrays are.
Numbers: TypeAlias = ArrayLike | Sequence[Any]


class Run(NamedTuple):
    """A model, and along what it runs.

    Attributes:
        model: without what a fit knows beside it.
        kappa: schedule, or None.
        dt: sample time, or None where the model has its own.
        records: their lengths.
        gain: K, or None where the output is simulated.
        offset: constants to add to the model's outputs, (ny,) or (record, ny), or None.
    """

    model: Any
    kappa: Array | None
    dt: float | None
    records: tuple[int, ...]
    gain: Any
    offset: Array | None

    def cut(self, signal: Array) -> list[Array]:
        """A signal record by record."""
        return jnp.split(signal, np.cumsum(self.records)[:-1])

    def level(self, ny: int) -> Float[Array, "time ny"]:
        """The offset of every sample."""
        if self.offset is None:
            return jnp.zeros((sum(self.records), ny))
        count = len(self.records)
        if self.offset.shape not in ((ny,), (count, ny)):
            raise ValueError(
                f"output_offset, given or the fit's own, has shape {self.offset.shape} and there "
                f"are {count} records: give ({ny},), or ({count}, {ny}) for an offset of each "
                "record, and lengths= for several records."
            )
        rows = jnp.broadcast_to(self.offset, (count, ny))
        return rows[np.repeat(np.arange(count), self.records)]

    def schedules(self) -> Sequence[Array | None]:
        """κ record by record."""
        return [None] * len(self.records) if self.kappa is None else self.cut(self.kappa)


def run_of(
    item: Any,
    kappa: Array | None,
    dt: float | None,
    records: tuple[int, ...],
    gain: Any,
    offset: Numbers | None,
) -> Run:
    """A model or a fit, and what is given in place of what the fit knows.

    A fit is read by its attributes: rooms that fit come later than this one.
    """
    model, known = item, None
    if not hasattr(item, "simulate") and not can_step(item):
        model = getattr(item, "model", item)
        gain = getattr(item, "innovation_gain", None) if gain is None else gain
        known = getattr(item, "output_offset", None)
    if isinstance(model, StructuredModel):
        model = model.state_space
    if isinstance(model, StateSpace) and not model.is_discrete and dt is not None:
        model = model.discretise(dt)
    offset = known if offset is None else offset
    offset = None if offset is None else jnp.asarray(offset, float)
    return Run(model, kappa, dt, records, gain, offset)


def predict_ahead(along: Run, u, y, x0, horizons: tuple[int, ...]) -> Float[Array, "h time ny"]:
    """Predictions over every horizon."""
    model, gain = along.model, along.gain
    linear = isinstance(model, StateSpace)
    if linear and (not model.is_discrete or model.A.ndim != 2):
        raise ValueError(
            "model: with a gain one discrete-time StateSpace is needed; give dt=, the data's "
            "sample time, use jax.vmap for a batch, or leave gain out to simulate."
        )
    if not linear and not isinstance(model, LPVStateSpace | GrayBoxLPV) and not can_step(model):
        raise ValueError(
            f"model: with a gain a discrete-time StateSpace, an LPV model, or one with "
            f"step(x, u, dt=) is needed, not {type(model).__name__}; leave gain out to simulate."
        )
    if y is None:
        raise ValueError("y: prediction with a gain needs the measured output.")
    measured, K = as_channels(y, "y"), jnp.asarray(gain, float)
    steps = [] if linear else _steps(along, u)
    nx = model.nx if linear else _states(model)
    ny = model.ny if linear else _outputs(steps[0], nx)
    if measured.shape != (u.shape[0], ny):
        raise ValueError(f"y has shape {measured.shape}; ({u.shape[0]}, {ny}) is needed.")
    if K.shape != (nx, ny):
        raise ValueError(f"gain has shape {K.shape}; ({nx}, {ny}) is needed.")
    level = along.level(ny)
    measured = measured - level
    if linear:
        both = jnp.concatenate([u, measured], axis=1)
        along = along._replace(model=one_step_predictor(model, K), offset=None)
        first = simulate_run(along, both, x0)
        corrections = (measured - first) @ K.T
        beyond = _forgotten(model, corrections, np.array(horizons), along.records)
        return (first + level)[None] - beyond
    starts = _starts(x0, len(along.records))
    starts = jnp.zeros((len(along.records), nx)) if starts is None else starts
    parts = zip(steps, along.cut(measured), starts, strict=True)
    found = [_stepped(one, y, K, start, horizons) for one, y, start in parts]
    return jnp.concatenate(found, 1) + level[None]


def _steps(along: Run, u: Array) -> list[AbstractSteps]:
    if can_step(along.model):
        _check_given(along.model.step, along.kappa, along.dt)
    parts = zip(along.cut(u), along.schedules(), strict=True)
    return [steps_of(along.model, u=u, kappa=kappa, dt=along.dt) for u, kappa in parts]


def _outputs(steps: AbstractSteps, nx: int) -> int:
    return jax.eval_shape(lambda x: steps.simulate(x), jnp.zeros(nx)).shape[1]


def _states(model: Any) -> int:
    states = getattr(model, "n_states", getattr(model, "nx", None))
    if states is None:
        raise ValueError("model: n_states (or nx) does not say how many states its step has.")
    return int(states)


@eqx.filter_jit
def _stepped(
    along: AbstractSteps, y: Array, gain: Array, x0: Array, horizons: tuple[int, ...]
) -> Float[Array, "h time ny"]:
    """Predictions of one record: the model runs on from the predictor's states, all at once."""
    first, states = along.predict(y, gain, x0)
    simulated = along.simulate(x0)
    samples = y.shape[0]
    # No prediction reaches back beyond the start.
    counts = np.minimum(horizons, samples) - 1
    where = np.full(int(counts.max()) + 1, len(horizons))
    for index, count in enumerate(counts):
        where[count] = index
    time = jnp.arange(samples)

    def one(carry, each):
        states, kept = carry
        passed, slot = each
        # states[s] is that of the sample s + passed, known from the outputs before s.
        now = jax.tree.map(lambda signal: jnp.roll(signal, -passed, axis=0), along.signals)
        following, y = jax.vmap(along.step)(states, now)
        reached = (time >= passed)[:, None]
        predicted = jnp.where(reached, jnp.roll(y, passed, axis=0), simulated)
        inside = (time + passed < samples - 1)[:, None]
        return (jnp.where(inside, following, states), kept.at[slot].set(predicted)), None

    kept = jnp.zeros((len(horizons) + 1, *first.shape))
    (_, kept), _ = jax.lax.scan(one, (states, kept), (np.arange(where.size), where))
    return jnp.stack([kept[where[count]] for count in counts])


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


def simulate_run(along: Run, u: Array, x0: Numbers | None) -> Float[Array, "time ny"]:
    """Response and offset."""
    y = _simulated(along, u, x0)
    return y if along.offset is None else y + along.level(y.shape[-1])


def _simulated(along: Run, u: Array, x0: Numbers | None) -> Float[Array, "time ny"]:
    """Response record by record, all at once where they have one length."""
    model, records = along.model, along.records
    starts = _starts(x0, len(records))
    if len(records) > 1 and len(set(records)) == 1 and isinstance(model, StateSpace):
        parts = u.reshape(len(records), records[0], u.shape[1])
        start = jnp.zeros((len(records), model.nx)) if starts is None else starts
        return jax.vmap(lambda a, b: model.simulate(u=a, x0=b))(parts, start).reshape(
            u.shape[0], -1
        )
    firsts = [None] * len(records) if starts is None else list(starts)
    parts = zip(along.cut(u), along.schedules(), firsts, strict=True)
    return jnp.concatenate([_response(model, u, kappa, along.dt, x0) for u, kappa, x0 in parts])


def _response(model, u, kappa, dt, x0) -> Float[Array, "time ny"]:
    if not hasattr(model, "simulate"):
        if not can_step(model):
            raise ValueError(f"model is a {type(model).__name__}, which has no simulate(u=, x0=).")
        _check_given(model.step, kappa, dt)
        start = jnp.zeros(_states(model)) if x0 is None else x0
        return _stepped_alone(steps_of(model, u=u, kappa=kappa, dt=dt), start)
    _check_given(model.simulate, kappa, dt)
    options: dict[str, Any] = {} if dt is None else {"dt": dt}
    if takes_schedule(model.simulate) and kappa is not None:
        options["kappa"] = kappa
    return model.simulate(u=u, x0=x0, **options)


def _check_given(method: Any, kappa: Array | None, dt: float | None) -> None:
    """Raise where a model's `simulate` or `step` cannot do without what is not given."""
    parameters = inspect.signature(method).parameters
    given = {
        "kappa": (kappa, "depends on a schedule; give one value for each sample"),
        "dt": (dt, "is in continuous time; give the sample time of u"),
    }
    for name, (value, reason) in given.items():
        needed = name in parameters and parameters[name].default is inspect.Parameter.empty
        if value is None and needed:
            raise ValueError(f"{name}: the model {reason}.")


@eqx.filter_jit
def _stepped_alone(along: AbstractSteps, x0: Array) -> Float[Array, "time ny"]:
    return along.simulate(x0)


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


def record_lengths(lengths: Sequence[int] | None, n_samples: int) -> tuple[int, ...]:
    records = (n_samples,) if lengths is None else tuple(int(n) for n in lengths)
    if sum(records) != n_samples or min(records, default=0) < 1:
        raise ValueError(f"lengths: {records} do not add up to the {n_samples} samples.")
    return records


def as_schedule(kappa: Numbers | None, u: Numbers) -> Array | None:
    if kappa is None:
        return None
    schedule, samples = as_channels(kappa, "kappa"), jnp.shape(jnp.asarray(u))[0]
    if schedule.shape[0] != samples:
        raise ValueError(
            f"kappa: {samples} samples are needed, one for each of u; got {schedule.shape[0]}."
        )
    return schedule


def as_channels(values: Numbers, name: str) -> Float[Array, "time channel"]:
    array = jnp.asarray(values, float)
    array = array[:, None] if array.ndim == 1 else array
    if array.ndim != 2:
        raise ValueError(f"{name} has shape {array.shape}; give (time, channel), time first.")
    return array
