"""Preprocessing as a chain of steps, each with a reversal that undoes it."""

import abc

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from lpvid.data._io_data import IOData


class AbstractReversal(eqx.Module):
    """What one step keeps to be undone; `AbstractStep` shows one.

    Attributes:
        step: the step that repeats this one on other data with the same settings.
    """

    # The step that repeats this one on other data with the same settings.
    step: eqx.AbstractVar["AbstractStep"]

    @abc.abstractmethod
    def restore(self, data: IOData) -> IOData:
        """The step's input from its output.

        Raises:
            ValueError: the data have other records or channels than the step produced.
        """

    @abc.abstractmethod
    def output(self, y: Float[Array, "_ ny"], trend: bool) -> Float[Array, "_ ny"]:
        """A model's output for the processed data, in the step's input's rate and units.

        Args:
            y: (time, ny), all records one after the other.
            trend: whether trends that the step took out are added back.

        Raises:
            ValueError: the output has another shape than the step's.
        """


class AbstractStep(eqx.Module):
    """One preprocessing step; write `apply` to add your own.

    Example:
        >>> from lpvid.data import AbstractReversal, AbstractStep, IOData, preprocess
        >>> class Negated(AbstractReversal):
        ...     step: AbstractStep
        ...     def restore(self, data):
        ...         return data.replace(y=-data.y)
        ...     def output(self, y, trend):
        ...         return -y
        >>> class Negate(AbstractStep):
        ...     def apply(self, data):
        ...         return data.replace(y=-data.y), Negated(self)
        >>> data = IOData(u=[0.0, 1.0], y=[0.0, 2.0], dt=0.1)
        >>> processed, undo = preprocess(data, Negate())
        >>> processed.y[1].item(), undo(processed).y[1].item()
        (-2.0, 2.0)
    """

    @abc.abstractmethod
    def apply(self, data: IOData) -> tuple[IOData, AbstractReversal]:
        """Processed data, and what undoes it.

        Raises:
            ValueError: the step does not fit the data.
        """


class Undo(eqx.Module):
    """What `preprocess` did, ready to be undone: call it with the processed data. A pytree.

    - `undo(processed)` is the original data, to rounding, where `processed` is untouched. Where
      it was changed, the change comes back too: the parts that filters removed are added to it.
    - `undo.output(y_hat)` brings a model's output for the processed data to the original rate and
      units, to be compared with the measured output. Trends are added back (they are offsets and
      drift that the model never saw; `trend=False` leaves them out); the parts that filters
      removed are not (no model of the processed data can know them).
    - `undo.steps` repeats the same preprocessing on other data, with the same scale factors:
      `preprocess(test, *undo.steps)`. Trends are estimated anew: they belong to a record.

    Attributes:
        reversals: what each step keeps, in the order they were applied.

    Example:
        >>> from lpvid.data import Detrend, IOData, Scale, preprocess
        >>> data = IOData(u=[1.0, 3.0], y=[4.0, 8.0], dt=0.1)
        >>> processed, undo = preprocess(data, Detrend(), Scale("peak"))
        >>> undo.output(processed.y)[:, 0].tolist()
        [4.0, 8.0]
    """

    reversals: tuple[AbstractReversal, ...]

    @property
    def steps(self) -> tuple[AbstractStep, ...]:
        """Steps that repeat this preprocessing on other data."""
        return tuple(reversal.step for reversal in self.reversals)

    def __call__(self, processed: IOData) -> IOData:
        """The original data.

        Raises:
            ValueError: a step that keeps samples (a trend, a filter's remainder) meets records of
                other lengths or channels than it produced.
        """
        for reversal in reversed(self.reversals):
            processed = reversal.restore(processed)
        return processed

    def output(self, y: ArrayLike, *, trend: bool = True) -> Float[Array, "_ ny"]:
        """A model's output for the processed data, at the original rate and in the original units.

        Args:
            y: (time, ny), records one after the other, as `IOData.y` stores them; or (time,).
            trend: whether trends are added back.

        Raises:
            ValueError: `y` does not have the processed data's shape.
        """
        signal = jnp.asarray(y, float)
        signal = signal[:, None] if signal.ndim == 1 else signal
        if signal.ndim != 2:
            raise ValueError(f"y has shape {signal.shape}: give (time, ny), records one by one.")
        for reversal in reversed(self.reversals):
            signal = reversal.output(signal, trend)
        return signal


def preprocess(data: IOData, *steps: AbstractStep) -> tuple[IOData, Undo]:
    """Apply steps from left to right; return the processed data and what undoes them.

    Every step treats inputs and outputs alike (or scales them), so that a linear plant between
    them stays what it was. Steps work record by record. `Detrend`, `Offset` and `Scale` are written
    in JAX and differentiate; `Lowpass` and `Decimate` filter through SciPy, outside `jit` and
    `grad` only.

    Args:
        data: one or several records.
        *steps: what to do, in this order.

    Returns:
        The processed data, and the `Undo` that takes it back.

    Raises:
        ValueError: a step does not fit the data (a cutoff above the Nyquist frequency, a record too
            short for the filter).

    Example:
        >>> import numpy as np
        >>> from lpvid.data import Decimate, Detrend, IOData, preprocess
        >>> t = 0.01 * np.arange(800)
        >>> train, test = IOData(u=np.sin(t), y=3 + np.sin(t), dt=0.01).split(0.5)
        >>> clean, undo = preprocess(train, Detrend(), Decimate(10))
        >>> bool(np.abs(undo(clean).y - train.y).max() < 1e-12)
        True
        >>> clean_test, undo_test = preprocess(test, *undo.steps)
        >>> undo_test.output(clean_test.y).shape == test.y.shape
        True
    """
    reversals = []
    for step in steps:
        data, reversal = step.apply(data)
        reversals.append(reversal)
    return data, Undo(tuple(reversals))


def check_restorable(
    data: IOData, lengths: tuple[int, ...], channels: tuple[int, int], step: AbstractStep
) -> None:
    """Find out whether data have the records and channels that a step produced.

    Raises:
        ValueError: they do not.
    """
    if data.lengths != lengths or (data.nu, data.ny) != channels:
        raise ValueError(
            f"undo: {type(step).__name__} produced records of {lengths} samples with {channels[0]} "
            f"input(s) and {channels[1]} output(s), but was given {data!r}; undo what preprocess "
            f"returned, before cutting or selecting."
        )


def check_output(
    y: Float[Array, "_ channel"], lengths: tuple[int, ...], ny: int, step: AbstractStep
) -> None:
    """Find out whether a model's output has the shape of the outputs that a step produced.

    Raises:
        ValueError: it does not.
    """
    if y.shape != (sum(lengths), ny):
        raise ValueError(
            f"undo.output: y has shape {y.shape} where {type(step).__name__} produced "
            f"{(sum(lengths), ny)}; simulate all samples of the processed data."
        )


def to_numpy(signal: Float[Array, "_ channel"], step: AbstractStep) -> np.ndarray:
    """The samples for SciPy; tracers have none.

    Raises:
        ValueError: the signal is a tracer.
    """
    if isinstance(signal, Tracer):
        raise ValueError(
            f"{type(step).__name__} filters through SciPy and is not differentiable: preprocess "
            f"outside jit, grad and vmap, then pass the processed data in."
        )
    return np.asarray(signal)
