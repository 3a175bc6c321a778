"""Channels brought to comparable size."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from lpvid.data._io_data import IOData
from lpvid.data._preprocess import AbstractReversal, AbstractStep

_KINDS = ("std", "range", "peak")


class Scale(AbstractStep):
    """Divide each channel of inputs and outputs by one factor, the same in all records.

    A channel for which the factor would be zero is left as it is. No offset is taken out (`Detrend`
    does that), and the scheduling keeps its values: it is an operating point. The scaled channels
    have no unit. Differentiable.

    Args:
        kind: how the factors are found, over all records together: "std" is the standard deviation,
            "range" largest minus smallest value, "peak" the largest magnitude.
        u: factors (nu,) of the inputs, or a scalar, to be used instead.
        y: factors (ny,) of the outputs, or a scalar, to be used instead.

    Raises:
        ValueError: another kind; when applied, factors that do not fit the channels.

    Example:
        >>> from lpvid.data import IOData, Scale, preprocess
        >>> data = IOData(u=[1.0, -2.0], y=[4.0, -8.0], dt=0.1)
        >>> scaled, undo = preprocess(data, Scale("peak"))
        >>> scaled.y[:, 0].tolist()
        [0.5, -1.0]
    """

    kind: str = eqx.field(static=True)
    u: Float[Array, " nu"] | None
    y: Float[Array, " ny"] | None

    def __init__(
        self, kind: str = "std", *, u: ArrayLike | None = None, y: ArrayLike | None = None
    ):
        if kind not in _KINDS:
            raise ValueError(f"Scale: kind is {kind!r}: one of {', '.join(_KINDS)}.")
        self.kind = kind
        self.u = None if u is None else jnp.atleast_1d(jnp.asarray(u, float))
        self.y = None if y is None else jnp.atleast_1d(jnp.asarray(y, float))

    def apply(self, data: IOData) -> tuple[IOData, "ScaleReversal"]:
        """Scaled data, and the factors.

        Raises:
            ValueError: the factors given do not fit the channels.
        """
        u = _factors(data.u, self.kind) if self.u is None else _given(self.u, data.nu, "u")
        y = _factors(data.y, self.kind) if self.y is None else _given(self.y, data.ny, "y")
        scaled = data.replace(
            u=data.u / u[None, :],
            y=data.y / y[None, :],
            units={"u": [""] * data.nu, "y": [""] * data.ny},
        )
        fixed = Scale(self.kind, u=u, y=y)
        return scaled, ScaleReversal(fixed, u, y, data.input_units, data.output_units)


class ScaleReversal(AbstractReversal):
    """The factors the channels were divided by.

    Attributes:
        step: the step that is undone, with these factors.
        u: factors of the inputs.
        y: factors of the outputs.
        input_units: units before.
        output_units: units before.
    """

    step: AbstractStep
    u: Float[Array, " nu"]
    y: Float[Array, " ny"]
    input_units: tuple[str, ...] = eqx.field(static=True)
    output_units: tuple[str, ...] = eqx.field(static=True)

    def restore(self, data: IOData) -> IOData:
        """Data in its units."""
        if (data.nu, data.ny) != (self.u.shape[0], self.y.shape[0]):
            raise ValueError(
                f"undo: Scale has factors for {self.u.shape[0]} input(s) and {self.y.shape[0]} "
                f"output(s), but was given {data!r}; undo before selecting channels."
            )
        return data.replace(
            u=data.u * self.u[None, :],
            y=data.y * self.y[None, :],
            units={"u": self.input_units, "y": self.output_units},
        )

    def output(self, y: Float[Array, "_ ny"], trend: bool) -> Float[Array, "_ ny"]:
        """Output in its units."""
        del trend
        if y.shape[1] != self.y.shape[0]:
            raise ValueError(
                f"undo.output: y has {y.shape[1]} channel(s) but Scale has {self.y.shape[0]}."
            )
        return y * self.y[None, :]


def _factors(signal: Float[Array, "_ channel"], kind: str) -> Float[Array, " channel"]:
    if kind == "peak":
        size = jnp.max(jnp.abs(signal), axis=0)
    elif kind == "range":
        size = jnp.max(signal, axis=0) - jnp.min(signal, axis=0)
    else:
        # The root of zero has no derivative: it is taken of one instead, where it is not used.
        variance = jnp.var(signal, axis=0)
        positive = variance > 0
        size = jnp.where(positive, jnp.sqrt(jnp.where(positive, variance, 1.0)), 0.0)
    return jnp.where(size > 0, size, 1.0)


def _given(factors: Float[Array, " _"], channels: int, argument: str) -> Float[Array, " _"]:
    if factors.shape[0] not in (1, channels):
        raise ValueError(
            f"Scale: {argument} has {factors.shape[0]} factors but the data has {channels} "
            f"channel(s): give one for each, or a scalar."
        )
    return jnp.broadcast_to(factors, (channels,))
