"""Continuous-time subspace methods: which filters, which weights."""

import abc
import dataclasses
import math
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lpvid.identify._factor import solve_lower
from lpvid.identify._methods import plain
from lpvid.identify.gray_box._filters import AbstractFilterBasis, LaguerreFilters

Order = int | Literal["auto"]


def _several(value: Any) -> Any:
    """One number or several as a tuple, in plain Python types; `None` stays."""
    if value is None:
        return None
    values = value if hasattr(value, "__len__") else (value,)
    return tuple(entry.item() if hasattr(entry, "item") else entry for entry in values)


def _is_whole(value: Any, least: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= least


def _is_positive(value: Any) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and math.isfinite(value) and value > 0


class FilteredFactor(eqx.Module):
    """Blocks of the lower-triangular L in [U_f; Z; Y_f] = L Q, Z the past inputs and outputs.

    Attributes:
        instruments_inputs: L21.
        instruments: L22.
        outputs_instruments: L32; its range is that of the observability matrix.
        outputs: L33.
    """

    instruments_inputs: Float[Array, "instruments future_inputs"]
    instruments: Float[Array, "instruments instruments"]
    outputs_instruments: Float[Array, "future_outputs instruments"]
    outputs: Float[Array, "future_outputs future_outputs"]


class AbstractContinuousTimeMethod(eqx.Module):
    """A continuous-time subspace method: its settings, its filters and its weights.

    Args:
        order: number of states, or "auto" for the largest gap between the singular values; twice
            the degrees of freedom in `identify_mechanical`.
        tau: time constant τ of the filters in s; several are tried in one batch and the best fit
            is kept; `None` tries a range taken from the records' bandwidth.
        block_rows: i, rows of future and of past, so 2 i filters in a chain; several are tried;
            `None` tries a few.
        feedthrough: whether D is estimated. Outputs are taken as straight between samples, which
            an output that jumps with its input is not.
        filters: `LaguerreFilters()`, or `FilterPowers()` as published.

    Raises:
        ValueError: a setting out of its range.

    Example:
        >>> from lpvid.identify import ContinuousTimeMOESP
        >>> ContinuousTimeMOESP(order=4, tau=0.15, block_rows=10).tau
        (0.15,)
    """

    order: Order = eqx.field(static=True, default="auto", converter=plain)
    tau: tuple[float, ...] | None = eqx.field(static=True, default=None, converter=_several)
    block_rows: tuple[int, ...] | None = eqx.field(static=True, default=None, converter=_several)
    feedthrough: bool = eqx.field(static=True, default=False)
    filters: AbstractFilterBasis = LaguerreFilters()

    def __check_init__(self):
        order, tau, block_rows = self.order, self.tau, self.block_rows
        if order != "auto" and not _is_whole(order, 1):
            raise ValueError(f'order={order!r}: give a positive whole number, or "auto".')
        if tau is not None and not (tau and all(_is_positive(value) for value in tau)):
            raise ValueError(
                f"tau={tau}: give positive time constants in seconds, or None for a search."
            )
        if block_rows is not None and not (block_rows and all(_is_whole(i, 2) for i in block_rows)):
            raise ValueError(
                f"block_rows={block_rows}: give whole numbers of 2 or more, or None for a search."
            )

    @property
    def weights(self) -> "AbstractContinuousTimeMethod":
        """The method with its other settings at their defaults: what compilations depend on."""
        return dataclasses.replace(self, order="auto", tau=None, block_rows=None, feedthrough=False)

    @abc.abstractmethod
    def project(
        self, factor: FilteredFactor
    ) -> tuple[
        Float[Array, "future_outputs column"], Float[Array, "future_outputs future_outputs"] | None
    ]:
        """Matrix whose dominant left range is looked for.

        Returns:
            The matrix, and what its range is to be multiplied by to give that of the observability
            matrix, or `None` for the identity.
        """


class ContinuousTimeMOESP(AbstractContinuousTimeMethod):
    """Past inputs and outputs as instruments, future inputs projected out. The usual choice.

    With Laguerre filters the noise of the rows is white where the measurement noise is, which is
    the case this weight is meant for. Settings: see `AbstractContinuousTimeMethod`.

    Example:
        >>> from lpvid.identify import ContinuousTimeMOESP
        >>> ContinuousTimeMOESP(order=4, tau=(0.1, 0.2), block_rows=6).block_rows
        (6,)
    """

    def project(self, factor: FilteredFactor) -> tuple[Array, None]:
        """The factor's block L32, unweighted."""
        return factor.outputs_instruments, None


class ContinuousTimeN4SID(AbstractContinuousTimeMethod):
    """The oblique projection of the future outputs along the future inputs, unweighted.

    The weight of 000 (algorithm 4.8 of Van Overschee and De Moor). It gives the directions in which
    the instruments are strong more weight than `ContinuousTimeMOESP`, and more variance with it.
    Settings: see `AbstractContinuousTimeMethod`.

    Example:
        >>> from lpvid.identify import ContinuousTimeN4SID
        >>> ContinuousTimeN4SID(order=4).order
        4
    """

    def project(self, factor: FilteredFactor) -> tuple[Array, None]:
        """Coordinates of the oblique projection, L32 [L22⁻¹ L21, I]."""
        past = solve_lower(factor.instruments, factor.instruments_inputs)
        kept = factor.outputs_instruments
        return jnp.concatenate([kept @ past, kept], axis=1), None


class ContinuousTimeCVA(AbstractContinuousTimeMethod):
    """Canonical variates: `ContinuousTimeMOESP` with the future outputs whitened first.

    Settings: see `AbstractContinuousTimeMethod`.

    Example:
        >>> from lpvid.identify import ContinuousTimeCVA
        >>> ContinuousTimeCVA(order=4).feedthrough
        False
    """

    def project(self, factor: FilteredFactor) -> tuple[Array, Array]:
        """The canonical directions, and the root of the outputs' covariance to undo."""
        both = jnp.concatenate([factor.outputs_instruments, factor.outputs], axis=1)
        root = jnp.linalg.qr(both.T, mode="r").T
        return solve_lower(root, factor.outputs_instruments), root
