"""Subspace methods: which instruments, which weights."""

import abc
from typing import Literal

import equinox as eqx
from jaxtyping import Array, Float

from lpvid.identify._factor import DataFactor


class AbstractSubspaceMethod(eqx.Module):
    """A subspace method: its settings, its instruments and its weights.

    The engine factors the data, asks the method for the matrix whose range is that of the
    observability matrix, and does the rest: order, A and C, stabilisation, B, D and x0.

    Attributes:
        order: number of states, or "auto".
        block_rows: rows of past and of future, or `None` for a default.
        feedthrough: whether D is estimated.
        stabilise: `False`, or the radius that eigenvalues of A are moved onto.
        past_outputs: whether past outputs are among the instruments.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.identify import AbstractSubspaceMethod, identify
        >>> class InstrumentalVariables(AbstractSubspaceMethod):
        ...     order: int = 1
        ...     block_rows: int = 5
        ...     feedthrough: bool = True
        ...     stabilise: bool = False
        ...     past_outputs = True
        ...     def project(self, factor):
        ...         return factor.outputs_instruments @ factor.instruments.T, None
        >>> u = np.random.default_rng(0).standard_normal(500)
        >>> y = np.convolve(u, 0.8 ** np.arange(50))[:500]
        >>> fit = identify(IOData(u=u, y=y, dt=0.1), InstrumentalVariables())
        >>> round(fit.model.A.item(), 3)
        0.8
    """

    order: eqx.AbstractVar[int | Literal["auto"]]
    block_rows: eqx.AbstractVar[int | None]
    feedthrough: eqx.AbstractVar[bool]
    stabilise: eqx.AbstractVar[float | Literal[False]]
    past_outputs: eqx.AbstractClassVar[bool]

    @abc.abstractmethod
    def project(
        self, factor: DataFactor
    ) -> tuple[
        Float[Array, "future_outputs column"], Float[Array, "future_outputs future_outputs"] | None
    ]:
        """Matrix whose dominant left range is looked for, and the weight to undo.

        Returns:
            The matrix, and the W by which the observability matrix is multiplied in its range, or
            `None` for the identity.
        """


class PastOutputMOESP(AbstractSubspaceMethod):
    """PO-MOESP: past inputs and past outputs as instruments. The choice for measured data.

    With $[U_f; U_p; Y_p; Y_f] = L Q$ the range of the observability matrix is that of
    $L_{32}$, the future outputs freed of the future inputs and correlated with the past
    (Verhaegen 1994, "Identification of the deterministic part of MIMO state space models given in
    innovations form from input-output data", Automatica 30). Consistent for output noise that is
    coloured by the system or independent of the past.

    Args:
        order: number of states, or "auto" for the largest gap between the singular values.
        block_rows: s, the rows of past and of future; `None` for twice the order and at least 10,
            or 15 with `order="auto"`. Long horizons separate slow modes.
        feedthrough: whether D is estimated; `False` keeps it zero.
        stabilise: `False`, or a radius: eigenvalues of A outside it are moved onto it, and B, D
            and x0 are then estimated for the moved A.

    Raises:
        ValueError: a setting out of its range.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.identify import PastOutputMOESP, identify
        >>> u = np.random.default_rng(0).standard_normal(500)
        >>> y = np.convolve(u, 0.8 ** np.arange(50))[:500]
        >>> method = PastOutputMOESP(order="auto", block_rows=5, feedthrough=True)
        >>> identify(IOData(u=u, y=y, dt=0.1), method).order
        1
    """

    order: int | Literal["auto"] = eqx.field(static=True)
    block_rows: int | None = eqx.field(static=True)
    feedthrough: bool = eqx.field(static=True)
    stabilise: float | Literal[False] = eqx.field(static=True)
    past_outputs = True

    def __init__(
        self,
        order: int | Literal["auto"] = "auto",
        block_rows: int | None = None,
        *,
        feedthrough: bool = True,
        stabilise: float | Literal[False] = False,
    ):
        self.order, self.block_rows, self.feedthrough, self.stabilise = _checked(
            order, block_rows, feedthrough, stabilise
        )

    def project(self, factor: DataFactor) -> tuple[Array, None]:
        """The factor's block $L_{32}$, unweighted."""
        return factor.outputs_instruments, None


class PastInputMOESP(AbstractSubspaceMethod):
    """PI-MOESP: past inputs alone as instruments.

    With $[U_f; U_p; Y_f] = L Q$ the range is that of $L_{32}$ (Verhaegen 1993, "Subspace model
    identification, part 3", Int. J. Control 58). Consistent for any output noise that is
    independent of the input, but with more variance than `PastOutputMOESP`: on short or lightly
    damped records it may come out unstable.

    Args:
        order: number of states, or "auto" for the largest gap between the singular values.
        block_rows: s, the rows of past and of future; `None` for twice the order and at least 10,
            or 15 with `order="auto"`. Long horizons separate slow modes.
        feedthrough: whether D is estimated; `False` keeps it zero.
        stabilise: `False`, or a radius: eigenvalues of A outside it are moved onto it, and B, D
            and x0 are then estimated for the moved A.

    Raises:
        ValueError: a setting out of its range.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.identify import PastInputMOESP, identify
        >>> u = np.random.default_rng(0).standard_normal(500)
        >>> y = np.convolve(u, 0.8 ** np.arange(50))[:500]
        >>> fit = identify(IOData(u=u, y=y, dt=0.1), PastInputMOESP(order=1, block_rows=5))
        >>> round(fit.model.A.item(), 2)
        0.8
    """

    order: int | Literal["auto"] = eqx.field(static=True)
    block_rows: int | None = eqx.field(static=True)
    feedthrough: bool = eqx.field(static=True)
    stabilise: float | Literal[False] = eqx.field(static=True)
    past_outputs = False

    def __init__(
        self,
        order: int | Literal["auto"] = "auto",
        block_rows: int | None = None,
        *,
        feedthrough: bool = True,
        stabilise: float | Literal[False] = False,
    ):
        self.order, self.block_rows, self.feedthrough, self.stabilise = _checked(
            order, block_rows, feedthrough, stabilise
        )

    def project(self, factor: DataFactor) -> tuple[Array, None]:
        """The factor's block $L_{32}$, unweighted."""
        return factor.outputs_instruments, None


def _checked(order, block_rows, feedthrough, stabilise):
    if order != "auto" and (isinstance(order, bool) or not isinstance(order, int) or order < 1):
        raise ValueError(f'order={order!r}: give a positive whole number, or "auto".')
    if block_rows is not None and (
        isinstance(block_rows, bool) or not isinstance(block_rows, int) or block_rows < 2
    ):
        raise ValueError(f"block_rows={block_rows!r}: give a whole number of 2 or more, or None.")
    if not isinstance(feedthrough, bool):
        raise ValueError(f"feedthrough={feedthrough!r}: give True (estimate D) or False (D = 0).")
    if stabilise is not False and not (
        isinstance(stabilise, int | float)
        and not isinstance(stabilise, bool)
        and 0.0 < stabilise < 1.0
    ):
        raise ValueError(
            f"stabilise={stabilise!r}: give False, or a radius between 0 and 1 such as 0.9999."
        )
    return order, block_rows, feedthrough, stabilise
