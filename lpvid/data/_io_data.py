"""Measured or simulated records: inputs, outputs, scheduling, sample time."""

import operator
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from lpvid.data._labels import Labels, channel_labels, positions
from lpvid.data._signals import (
    Samples,
    Signals,
    as_records,
    as_scheduling,
    check_finite,
    common_lengths,
    sample_time,
    split_records,
    stack_records,
)


class IOData(eqx.Module):
    """Records of a system: inputs `u`, outputs `y`, scheduling `kappa`, sample time `dt`.

    Immutable, and a pytree: `u`, `y` and `kappa` are leaves, all else is static, so it passes
    through `jax.jit`, `jax.vmap` and `jax.grad`. Several records are stored one after the other in
    time; `lengths` says where one ends, and `records` takes them apart.

    Args:
        u: inputs. One record is (time,) or (time, channel); records of equal length are
            (record, time, channel); records of any lengths are a list or tuple of arrays.
        y: outputs, as many records and samples as `u`.
        dt: sample time in seconds, positive.
        kappa: scheduling κ, or `None`. One record: a scalar or (nk,) (constant, broadcast over
            time), (time,) or (time, nk); a one-dimensional kappa as long as the record is a time
            series. Several records: a scalar for all, or one such entry for each along the first
            axis.
        names: mapping from "u", "y", "kappa" to a string, or to one string for each channel; u1,
            y1, kappa1, ... by default.
        units: mapping like `names`; empty strings by default.

    Attributes:
        u: inputs of all records, (time, nu).
        y: outputs of all records, (time, ny).
        kappa: scheduling of all records, (time, nk), or `None`.
        dt: sample time in seconds.
        lengths: samples in each record.
        input_names: one for each input.
        output_names: one for each output.
        scheduling_names: one for each scheduling variable.
        input_units: one for each input.
        output_units: one for each output.
        scheduling_units: one for each scheduling variable.

    Raises:
        ValueError: naming the argument: shapes that are ambiguous (more channels than samples:
            nothing is transposed by guess), unequal lengths, a sample time that is not positive,
            records of fewer than two samples, samples that are not finite (not checked for
            tracers), labels that do not fit.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> t = 0.01 * np.arange(200)
        >>> data = IOData(u=np.sin(t), y=np.cos(t), dt=0.01, kappa=0.3, names={"u": "torque"})
        >>> data
        IOData(200 samples, 1 input (torque), 1 output (y1), kappa 1, dt=0.01 s)
        >>> train, test = data.split(0.25)
        >>> train.n_samples, test.n_samples
        (50, 150)
    """

    u: Float[Array, "time nu"]
    y: Float[Array, "time ny"]
    kappa: Float[Array, "time nk"] | None
    dt: float = eqx.field(static=True)
    lengths: tuple[int, ...] = eqx.field(static=True)
    input_names: tuple[str, ...] = eqx.field(static=True)
    output_names: tuple[str, ...] = eqx.field(static=True)
    scheduling_names: tuple[str, ...] = eqx.field(static=True)
    input_units: tuple[str, ...] = eqx.field(static=True)
    output_units: tuple[str, ...] = eqx.field(static=True)
    scheduling_units: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        *,
        u: Signals,
        y: Signals,
        dt: Any,
        kappa: Signals | None = None,
        names: Labels | None = None,
        units: Labels | None = None,
    ):
        inputs, outputs = as_records(u, "u"), as_records(y, "y")
        self.lengths = common_lengths(inputs, outputs)
        stacked = {"u": stack_records(inputs, "u"), "y": stack_records(outputs, "y")}
        if kappa is not None:
            stacked["kappa"] = stack_records(as_scheduling(kappa, self.lengths), "kappa")
        self.dt = sample_time(dt)
        counts = {"u": 0, "y": 0, "kappa": 0}
        counts.update({key: signal.shape[1] for key, signal in stacked.items()})
        labels = channel_labels(names, "names", counts)
        self.input_names, self.output_names, self.scheduling_names = labels
        self.input_units, self.output_units, self.scheduling_units = channel_labels(
            units, "units", counts
        )
        for (key, signal), channels in zip(stacked.items(), labels, strict=False):
            check_finite(signal, key, channels, self.lengths)
        self.u, self.y = jnp.asarray(stacked["u"]), jnp.asarray(stacked["y"])
        self.kappa = jnp.asarray(stacked["kappa"]) if kappa is not None else None

    # Counts come from static fields: they hold under `vmap` and for leaves that are no arrays.
    @property
    def nu(self) -> int:
        """Number of inputs."""
        return len(self.input_names)

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return len(self.output_names)

    @property
    def nk(self) -> int:
        """Number of scheduling variables, 0 without `kappa`."""
        return len(self.scheduling_names)

    @property
    def n_samples(self) -> int:
        """Number of samples in all records together."""
        return sum(self.lengths)

    @property
    def names(self) -> dict[str, tuple[str, ...]]:
        """Channel names under the keys `"u"`, `"y"`, `"kappa"`, as the constructor takes them."""
        return {"u": self.input_names, "y": self.output_names, "kappa": self.scheduling_names}

    @property
    def units(self) -> dict[str, tuple[str, ...]]:
        """Channel units under the keys `"u"`, `"y"`, `"kappa"`, as the constructor takes them."""
        return {"u": self.input_units, "y": self.output_units, "kappa": self.scheduling_units}

    @property
    def time(self) -> Float[Array, " time"]:
        """Seconds since the start of the record each sample belongs to, (time,)."""
        return jnp.asarray(np.concatenate([self.dt * np.arange(n) for n in self.lengths]))

    @property
    def records(self) -> tuple["IOData", ...]:
        """The records one by one, each an `IOData` of a single record."""
        whole = [(0, length) for length in self.lengths]
        return tuple(
            self._cut([bound if number == wanted else None for number, bound in enumerate(whole)])
            for wanted in range(len(whole))
        )

    @property
    def operating_point(self) -> Float[Array, " nk"]:
        """The constant scheduling (nk,) of a single record.

        Raises:
            ValueError: there is no `kappa`, there are several records, or `kappa` varies by more
                than rounding (1e-9 of its magnitude; not checked for tracers).
        """
        kappa = self.kappa
        if kappa is None:
            raise ValueError("operating_point: the data has no kappa; give kappa= to IOData.")
        self._require_single("operating_point")
        point = kappa[0]
        if not isinstance(kappa, Tracer):
            values = np.asarray(kappa)
            spread = np.abs(values - values[0]).max(axis=0)
            varying = spread > 1e-9 * np.abs(values).max(axis=0)
            if varying.any():
                channel = int(np.argmax(varying))
                raise ValueError(
                    f"operating_point: {self.scheduling_names[channel]!r} varies by "
                    f"{spread[channel]:.3g} within the record; use kappa itself, or cut the "
                    f"record to where it is constant."
                )
        return point

    def __getitem__(self, index: Any) -> "IOData":
        """Samples `data[a:b]` of a single record; no steps (`Decimate` filters first).

        Raises:
            ValueError: anything but a slice, a step, several records, or fewer than two samples.
        """
        if not isinstance(index, slice):
            raise ValueError(
                f"data[{index!r}]: index time by a slice such as data[100:200]; take records from "
                f"data.records and channels with data.select."
            )
        if index.step not in (None, 1):
            raise ValueError(
                f"data[::{index.step}] would alias: use preprocess(data, Decimate(factor))."
            )
        self._require_single("data[a:b]")
        start, stop, _ = index.indices(self.n_samples)
        if stop - start < 2:
            raise ValueError(
                f"data[{index.start}:{index.stop}] leaves {max(stop - start, 0)} of "
                f"{self.n_samples} samples: a record needs 2 or more."
            )
        return self._cut([(start, stop)])

    def split(self, at: float | int) -> tuple["IOData", "IOData"]:
        """First part and rest of every record.

        Args:
            at: where to cut: a fraction (float), rounded to whole samples in each record, or a
                sample index (int), from the end where it is negative.

        Returns:
            The data before the cut, and from the cut on.

        Raises:
            ValueError: the fraction does not lie between 0 and 1, or a part would have fewer than
                two samples.
        """
        if isinstance(at, float) and not 0 < at < 1:
            raise ValueError(f"split: the fraction {at} must lie between 0 and 1.")
        cuts = []
        for number, length in enumerate(self.lengths):
            cut = round(at * length) if isinstance(at, float) else operator.index(at)
            cut = cut + length if cut < 0 else cut
            if not 2 <= cut <= length - 2:
                raise ValueError(
                    f"split: {at} leaves fewer than 2 samples on one side of record {number} "
                    f"({length} samples); cut nearer to the middle."
                )
            cuts.append(cut)
        first = self._cut([(0, cut) for cut in cuts])
        rest = self._cut(list(zip(cuts, self.lengths, strict=True)))
        return first, rest

    def select(
        self,
        *,
        inputs: str | Sequence[str] | None = None,
        outputs: str | Sequence[str] | None = None,
        scheduling: str | Sequence[str] | None = None,
    ) -> "IOData":
        """Channels by name, in the order given.

        Args:
            inputs: names of the inputs to keep; `None` keeps all.
            outputs: names of the outputs to keep; `None` keeps all.
            scheduling: names of the scheduling variables to keep; `None` keeps all, `()` drops
                kappa.

        Raises:
            ValueError: a name that is not there; those that are get listed.
        """
        chosen = {
            "u": _chosen(inputs, self.input_names, "inputs"),
            "y": _chosen(outputs, self.output_names, "outputs"),
            "kappa": _chosen(scheduling, self.scheduling_names, "scheduling"),
        }

        def take(signal, key):
            columns = np.array(chosen[key], int)
            return [piece[:, columns] for piece in split_records(signal, self.lengths)]

        keeps_kappa = self.kappa is not None and len(chosen["kappa"]) > 0
        return IOData(
            u=take(self.u, "u"),
            y=take(self.y, "y"),
            kappa=take(self.kappa, "kappa") if keeps_kappa else None,
            dt=self.dt,
            names={key: [self.names[key][index] for index in chosen[key]] for key in chosen},
            units={key: [self.units[key][index] for index in chosen[key]] for key in chosen},
        )

    def replace(
        self,
        *,
        u: Signals | None = None,
        y: Signals | None = None,
        kappa: Signals | None = None,
        dt: Any = None,
        names: Labels | None = None,
        units: Labels | None = None,
    ) -> "IOData":
        """A copy with some parts replaced; `None` keeps a part.

        A signal of several records may be stacked as stored, (time, channel), or given as the
        constructor takes it. Labels are kept for channels whose number does not change, and may
        be given in part: `names={"u": "torque"}`.

        Args:
            u: inputs.
            y: outputs.
            kappa: scheduling.
            dt: sample time in seconds.
            names: channel names.
            units: channel units.

        Raises:
            ValueError: as the constructor does.
        """
        inputs = split_records(self.u, self.lengths) if u is None else self._as_records(u, "u")
        outputs = split_records(self.y, self.lengths) if y is None else self._as_records(y, "y")
        lengths = common_lengths(inputs, outputs)
        if kappa is None:
            scheduling = None if self.kappa is None else split_records(self.kappa, self.lengths)
        else:
            scheduling = as_scheduling(self._unstacked(kappa), lengths)
        nk = 0 if scheduling is None else scheduling[0].shape[1]
        counts = {"u": inputs[0].shape[1], "y": outputs[0].shape[1], "kappa": nk}
        return IOData(
            u=inputs,
            y=outputs,
            kappa=scheduling,
            dt=self.dt if dt is None else dt,
            names=_kept(self.names, counts, names),
            units=_kept(self.units, counts, units),
        )

    def _require_single(self, what: str) -> None:
        if len(self.lengths) > 1:
            raise ValueError(
                f"{what} needs a single record, but there are {len(self.lengths)}: take one from "
                f"data.records."
            )

    def _unstacked(self, signal: Signals) -> Signals:
        """Records of a signal stacked as this data stores it; anything else as it came."""
        several = len(self.lengths) > 1
        is_array = not isinstance(signal, list | tuple) and np.ndim(signal) in (1, 2)
        if several and is_array and np.shape(signal)[0] == self.n_samples:
            return split_records(signal, self.lengths)
        return signal

    def _as_records(self, signal: Signals, argument: str) -> list[Samples]:
        return as_records(self._unstacked(signal), argument)

    def _cut(self, bounds: Sequence[tuple[int, int] | None]) -> "IOData":
        """The samples `(start, stop)` of each record; `None` leaves a record out."""

        def cut(signal):
            pieces = zip(split_records(signal, self.lengths), bounds, strict=True)
            return [piece[bound[0] : bound[1]] for piece, bound in pieces if bound is not None]

        return IOData(
            u=cut(self.u),
            y=cut(self.y),
            kappa=None if self.kappa is None else cut(self.kappa),
            dt=self.dt,
            names=self.names,
            units=self.units,
        )

    def __repr__(self) -> str:
        if len(set(self.lengths)) == 1:
            records = f" x {len(self.lengths)} records" if len(self.lengths) > 1 else ""
            size = f"{max(self.lengths)} samples{records}"
        elif len(self.lengths) <= 4:
            size = f"{' + '.join(map(str, self.lengths))} samples"
        else:
            size = f"{self.n_samples} samples in {len(self.lengths)} records"
        kappa = f", kappa {self.nk}" if self.nk else ""
        return (
            f"IOData({size}, {_count(self.input_names, 'input')}, "
            f"{_count(self.output_names, 'output')}{kappa}, dt={self.dt:g} s)"
        )


def _chosen(wanted: str | Sequence[str] | None, names: tuple[str, ...], argument: str) -> list[int]:
    return list(range(len(names))) if wanted is None else positions(wanted, names, argument)


def _kept(old: dict[str, tuple[str, ...]], counts: dict[str, int], new: Labels | None) -> Labels:
    """Old labels where the number of channels still fits, overridden by the new ones."""
    fitting = {key: labels for key, labels in old.items() if len(labels) == counts[key]}
    return {**fitting, **({} if new is None else new)}


def _count(names: tuple[str, ...], noun: str) -> str:
    listed = f" ({', '.join(names)})" if len(names) <= 4 else ""
    return f"{len(names)} {noun}{'' if len(names) == 1 else 's'}{listed}"
