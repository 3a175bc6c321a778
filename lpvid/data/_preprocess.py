"""Preprocessing as a chain of steps, each with a reversal that undoes it."""

import abc

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from lpvid.data._io_data import IOData


class AbstractReversal(eqx.Module):
    """What one step keeps to be undone."""

    # The step that repeats this one on other data with the same settings.
    step: eqx.AbstractVar["AbstractStep"]

    @abc.abstractmethod
    def restore(self, data: IOData) -> IOData:
        """The step's input from its output."""

    @abc.abstractmethod
    def output(self, y: Float[Array, "_ ny"], trend: bool) -> Float[Array, "_ ny"]:
        """A model's output `y` for the processed data, in the step's input's rate and units."""


class AbstractStep(eqx.Module):
    """One preprocessing step; write `apply` to add your own."""

    @abc.abstractmethod
    def apply(self, data: IOData) -> tuple[IOData, AbstractReversal]:
        """Processed data, and what undoes it."""


class Undo(eqx.Module):
    """What `preprocess` did, ready to be undone: call it with the processed data.

    - `undo(processed)` is the original data, to rounding, where `processed` is untouched. Where
        it was changed, the change comes back too: the parts that filters removed are added to it.
    - `undo.output(y_hat)` brings a model's output for the processed data to the original rate and
        units, to be compared with the measured output. Trends are added back (they are offsets and
        drift that the model never saw; `trend=False` leaves them out); the parts that filters
        removed are not (no model of the processed data can know them).
    - `undo.steps` repeats the same preprocessing on other data, with the same scale factors:
        `preprocess(test, *undo.steps)`. Trends are estimated anew: they belong to a record.

    A pytree. `reversals` holds the record of each step, in the order they were applied.
    """

    reversals: tuple[AbstractReversal, ...]

    @property
    def steps(self) -> tuple[AbstractStep, ...]:
        """Steps that repeat this preprocessing on other data."""
        return tuple(reversal.step for reversal in self.reversals)

    def __call__(self, processed: IOData) -> IOData:
        """The original data.

        **Raises:** `ValueError` where a step that keeps samples (a trend, a filter's remainder)
        meets records of other lengths or channels than it produced.
        """
        for reversal in reversed(self.reversals):
            processed = reversal.restore(processed)
        return processed

    def output(self, y: ArrayLike, *, trend: bool = True) -> Float[Array, "_ ny"]:
        """A model's output `(time, ny)` for the processed data, at the original rate and in the
        original units; records one after the other, as `IOData.y` stores them.

        **Raises:** `ValueError` where `y` does not have the processed data's shape.
        """
        signal = jnp.asarray(y, float)
        signal = signal[:, None] if signal.ndim == 1 else signal
        if signal.ndim != 2:
            raise ValueError(f"y has shape {signal.shape}: give (time, ny), records one by one.")
        for reversal in reversed(self.reversals):
            signal = reversal.output(signal, trend)
        return signal


def preprocess(data: IOData, *steps: AbstractStep) -> tuple[IOData, Undo]:
    """Apply `steps` from left to right; return the processed data and what undoes them.

    Every step treats inputs and outputs alike (or scales them), so that a linear plant between
    them stays what it was. Steps work record by record. `Detrend` and `Scale` are written in JAX
    and differentiate; `Lowpass` and `Decimate` filter through SciPy, outside `jit` and `grad` only.

    **Raises:** `ValueError` from a step that does not fit the data (cutoff above the Nyquist
    frequency, record too short for the filter).

    !!! example

        ```python
        clean, undo = preprocess(train, Detrend(), Lowpass(50.0), Decimate(10))
        again = undo(clean)  # equals train
        clean_test, undo_test = preprocess(test, *undo.steps)
        y_hat = undo_test.output(model.simulate(u=clean_test.u))  # compare with test.y
        ```
    """
    reversals = []
    for step in steps:
        data, reversal = step.apply(data)
        reversals.append(reversal)
    return data, Undo(tuple(reversals))


def check_restorable(
    data: IOData, lengths: tuple[int, ...], channels: tuple[int, int], step: AbstractStep
) -> None:
    """Raise unless `data` has the records and channels that `step` produced."""
    if data.lengths != lengths or (data.nu, data.ny) != channels:
        raise ValueError(
            f"undo: {type(step).__name__} produced records of {lengths} samples with {channels[0]} "
            f"input(s) and {channels[1]} output(s), but was given {data!r}; undo what preprocess "
            f"returned, before cutting or selecting."
        )


def check_output(
    y: Float[Array, "_ channel"], lengths: tuple[int, ...], ny: int, step: AbstractStep
) -> None:
    """Raise unless `y` has the shape of the outputs that `step` produced."""
    if y.shape != (sum(lengths), ny):
        raise ValueError(
            f"undo.output: y has shape {y.shape} where {type(step).__name__} produced "
            f"{(sum(lengths), ny)}; simulate all samples of the processed data."
        )


def to_numpy(signal: Float[Array, "_ channel"], step: AbstractStep) -> np.ndarray:
    """The samples for SciPy; tracers have none."""
    if isinstance(signal, Tracer):
        raise ValueError(
            f"{type(step).__name__} filters through SciPy and is not differentiable: preprocess "
            f"outside jit, grad and vmap, then pass the processed data in."
        )
    return np.asarray(signal)
