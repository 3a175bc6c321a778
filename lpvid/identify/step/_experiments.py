"""From records to experiments with settled windows and final values."""

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from lpvid.data import IOData
from lpvid.identify.step._method import Experiments
from lpvid.identify.step._settling import Settling, check_rest, find_onset, find_settling

_LARGEST_CONDITION = 1e8


def prepare(data: IOData, settled: float | None, band: float) -> tuple[Experiments, list[int]]:
    """Experiments of the data, and where in each record its onset lies.

    Raises:
        ValueError: as `identify_step_response` says.
    """
    if len(data.lengths) < data.nu:
        raise ValueError(
            f"There are {len(data.lengths)} records for {data.nu} inputs: their final values must "
            f"span all inputs. Give at least {data.nu} experiments, one record each "
            f"(IOData(u=[...], y=[...])), or leave inputs out with data.select(inputs=...)."
        )
    if isinstance(data.u, Tracer) or isinstance(data.y, Tracer):
        if settled is None:
            raise ValueError(
                "settled=None looks for the settled windows in the samples, which cannot be done "
                "under jit, vmap or grad: give settled= in seconds."
            )
        return _given(data, settled)
    records = [(np.asarray(r.u), np.asarray(r.y)) for r in data.records]
    for number, (u, _) in enumerate(records):
        if not np.any(u):
            raise ValueError(
                f"The inputs of record {number} are zero throughout: leave the record out."
            )
    onsets = [find_onset(u) for u, _ in records]
    reach = [
        np.concatenate([np.abs(u).max(axis=0), np.ptp(np.concatenate([0.0 * y[:1], y]), axis=0)])
        for u, y in records
    ]
    ranges = np.max(reach, axis=0)
    for channel, name in enumerate(data.output_names):
        if ranges[data.nu + channel] == 0.0:
            raise ValueError(
                f"Output {name!r} is zero throughout, so nothing can be learned from it: check "
                f"the sensor, or leave it out with data.select(outputs=...)."
            )
    found = []
    for number, (record, (u, y), onset) in enumerate(
        zip(data.records, records, onsets, strict=True)
    ):
        check_rest(y, onset, ranges[data.nu :], data.output_names, number)
        u, y = u[onset:], y[onset:]
        records[number] = (u, y)
        if settled is None:
            found.append(find_settling(record, u, y, ranges, number, band))
        else:
            start = _first_sample(settled, data.dt, u.shape[0] + onset, number) - onset
            if start < 1:
                raise ValueError(
                    f"settled={settled} s lies before the inputs of record {number} move."
                )
            found.append(Settling(start, start, _steps_until(u)))
    return _assemble(data, records, found), onsets


def _first_sample(settled: float, dt: float, length: int, number: int) -> int:
    start = round(settled / dt)
    if not 0 < start <= length - 2:
        raise ValueError(
            f"settled={settled} s is outside record {number}, which lasts {length * dt:.6g} s: "
            f"give the time from the record's start at which everything has settled."
        )
    return start


def _steps_until(u: np.ndarray) -> int:
    moving = np.flatnonzero(np.any(np.abs(u - u[-1]) > 1e-3 * np.abs(u).max(axis=0), axis=1))
    return int(moving[-1]) + 1 if moving.size else 0


def _given(data: IOData, settled: float) -> tuple[Experiments, list[int]]:
    """Experiments of traced data: the windows are given, the inputs taken as steps at once."""
    bounds = np.cumsum([0, *data.lengths])
    records = [(data.u[a:b], data.y[a:b]) for a, b in zip(bounds[:-1], bounds[1:], strict=True)]
    found = []
    for number, length in enumerate(data.lengths):
        start = _first_sample(settled, data.dt, length, number)
        found.append(Settling(start, start, 0))
    return _assemble(data, records, found), [0] * len(records)


def _assemble(data, records, found):
    # With NumPy where there are numbers: JAX would compile anew for every length of a window.
    xp = jnp if any(isinstance(signal, Tracer) for pair in records for signal in pair) else np

    def mean(signal):
        # From the last sample, so that a settled value does not pick up rounding.
        return signal[-1] + xp.mean(signal - signal[-1:], axis=0)

    final = [
        (mean(u[s.window :]), mean(y[s.window :])) for (u, y), s in zip(records, found, strict=True)
    ]
    final_u, final_y = (xp.stack([pair[part] for pair in final]) for part in (0, 1))
    check_independence(final_u, data.input_names)
    longest = max(u.shape[0] for u, _ in records)

    def padded(signal, value):
        beyond = xp.broadcast_to(value[None], (longest - signal.shape[0], value.shape[0]))
        return xp.concatenate([signal, beyond])

    squares = sum(
        xp.sum((y[s.window :] - f[None]) ** 2, axis=0)
        for (_, y), s, f in zip(records, found, final_y, strict=True)
    )
    freedom = sum(u.shape[0] - s.window - 1 for (u, _), s in zip(records, found, strict=True))
    arrays = dict(
        u=xp.stack([padded(u, f) for (u, _), f in zip(records, final_u, strict=True)]),
        y=xp.stack([padded(y, f) for (_, y), f in zip(records, final_y, strict=True)]),
        lengths=np.array([u.shape[0] for u, _ in records]),
        window=np.array([s.window for s in found]),
        settling=np.array([max(s.practically, 1) for s in found]),
        inputs_settled=np.array([s.inputs for s in found]),
        final_u=final_u,
        final_y=final_y,
        combination=xp.linalg.pinv(final_u.T),
        noise=xp.sqrt(squares / freedom),
    )
    return Experiments(**{name: jnp.asarray(x) for name, x in arrays.items()}, dt=data.dt)


def check_independence(final_u, names) -> None:
    """Final inputs span all inputs; not checked for tracers.

    Raises:
        ValueError: naming the input, or the inputs, that they do not tell apart.
    """
    if isinstance(final_u, Tracer):
        return
    matrix = np.asarray(final_u)
    sizes = np.linalg.norm(matrix, axis=0)
    for name, size in zip(names, sizes, strict=True):
        if size <= 1e-9 * sizes.max():
            raise ValueError(
                f"Input {name!r} ends at zero in every record: give an experiment in which it "
                f"settles at another value, or leave it out with data.select(inputs=...)."
            )
    values = np.linalg.svd(matrix / sizes, compute_uv=False)
    if values[-1] * _LARGEST_CONDITION < values[0]:
        raise ValueError(
            f"The final values of the inputs {', '.join(names)} are proportional across the "
            f"records (the matrix of final inputs is singular): step them in different "
            f"proportions, one at a time for instance."
        )
