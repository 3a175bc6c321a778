"""Which modes matter most: what a modal truncation goes by."""

import abc
import math

import equinox as eqx
import numpy as np
from jaxtyping import Float

from lpvid.reduce._modal_table import ModalTable


class AbstractModeRank(eqx.Module):
    """How much each mode of a table matters; a rank of one's own gives `scores`.

    Example:
        >>> import numpy as np
        >>> from lpvid.reduce import AbstractModeRank
        >>> class Slowest(AbstractModeRank):
        ...     def scores(self, table):
        ...         return -np.asarray(table.frequency)
    """

    @abc.abstractmethod
    def scores(self, table: ModalTable) -> Float[np.ndarray, " mode"]:
        """One number for each mode, larger for what is to be kept before others.

        Args:
            table: of the model.

        Raises:
            ValueError: the table lacks what the rank goes by.
        """


class ModalResponseMagnitude(AbstractModeRank):
    """MRM: the mode's mean response to the input that the model is for (002, equation 3-8).

    Example:
        >>> from lpvid.models import StateSpace
        >>> from lpvid.reduce import ModalResponseMagnitude, modal_table
        >>> table = modal_table(StateSpace([[0.5]], [[1.0]], [[1.0]], dt=0.1))
        >>> ModalResponseMagnitude().scores(table)
        Traceback (most recent call last):
        ...
        ValueError: data: the modal response magnitude needs the input that the model is for.
    """

    def scores(self, table: ModalTable) -> Float[np.ndarray, " mode"]:
        """The MRM."""
        found = np.asarray(table.response_magnitude)
        if np.any(np.isnan(found)):
            raise ValueError(
                "data: the modal response magnitude needs the input that the model is for."
            )
        return found


class ModeSingularValue(AbstractModeRank):
    """MSV: the mode's share in the response to a pulse (002, equation 3-4).

    A heavily damped mode dies out quickly after a pulse and so ranks low, though a persistent input
    may keep it moving.

    Example:
        >>> from lpvid.models import StateSpace
        >>> from lpvid.reduce import ModeSingularValue, modal_table
        >>> table = modal_table(StateSpace([[0.75]], [[1.0]], [[1.0]], dt=0.1))
        >>> ModeSingularValue().scores(table)
        array([2.])
    """

    def scores(self, table: ModalTable) -> Float[np.ndarray, " mode"]:
        """The MSV."""
        found = np.asarray(table.singular_value)
        if np.any(np.isnan(found)):
            raise ValueError(
                "data: the mode singular value is that of a sampled model; give a record, or "
                "discretise the model."
            )
        return found


class ModalHankelValue(AbstractModeRank):
    """Balanced modal truncation: the mode's own largest Hankel singular value.

    For light damping and poles apart, what balanced truncation goes by (C. Gregory, J. Guid.
    Control Dyn. 7 (1984) 725-732). Unstable modes come first.

    Example:
        >>> from lpvid.models import StateSpace
        >>> from lpvid.reduce import ModalHankelValue, modal_table
        >>> table = modal_table(StateSpace([[-1.0]], [[4.0]], [[1.0]]))
        >>> ModalHankelValue().scores(table).round(6)
        array([2.])
    """

    def scores(self, table: ModalTable) -> Float[np.ndarray, " mode"]:
        """The Hankel singular value."""
        return np.asarray(table.hankel_values)[:, 0]


class KnownFrequencies(AbstractModeRank):
    """MRMC: first a mode for each known vibration, then what the other modes' rank says.

    For each frequency that of the complex modes within `width` of it which ranks highest, or the
    nearest one where none is that close. 002 chooses by eye "the complex modes whose natural
    frequencies are close to the three known vibratory modes with strong MRM ranking"; `width` makes
    that a rule.

    Attributes:
        hertz: known natural frequencies, Hz.
        width: how far a mode may lie from one and still be taken for it, relative.
        most_damping: damping ratio beyond which a complex mode is a rigid one.
        rank: of the modes close to a frequency, and of the rest: MRM by default.

    Raises:
        ValueError: no frequency, one that is not positive, or a width that is not.

    Source: 002, section 3.2.

    Example:
        >>> from lpvid.reduce import KnownFrequencies
        >>> KnownFrequencies((9.4, 22.9, 46.0)).width
        0.25
    """

    hertz: tuple[float, ...] = eqx.field(
        static=True, converter=lambda values: tuple(float(v) for v in values)
    )
    width: float = eqx.field(static=True, default=0.25)
    most_damping: float = eqx.field(static=True, default=0.5)
    rank: AbstractModeRank = eqx.field(default_factory=ModalResponseMagnitude)

    def __check_init__(self):
        if not self.hertz or not all(0.0 < f < math.inf for f in self.hertz):
            raise ValueError(f"hertz={self.hertz}: give one or several positive frequencies in Hz.")
        if not self.width > 0.0:
            raise ValueError(f"width={self.width} must be positive: 0.25 is a quarter.")

    def scores(self, table: ModalTable) -> Float[np.ndarray, " mode"]:
        """Infinite for the modes taken for a known one, else those of `rank`."""
        found = np.array(self.rank.scores(table), float)
        hertz = np.asarray(table.frequency) / (2.0 * math.pi)
        free = (np.array(table.sizes) == 2) & (np.asarray(table.damping) < self.most_damping)
        scores = found.copy()
        for known in self.hertz:
            if not free.any():
                break
            away = np.where(free, np.abs(hertz / known - 1.0), np.inf)
            close = away <= self.width
            best = np.argmax(np.where(close, found, -np.inf)) if close.any() else np.argmin(away)
            scores[best], free[best] = np.inf, False
        return scores
