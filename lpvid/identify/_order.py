"""The order from the singular values: rules that can be swapped."""

import abc
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

# Singular values below this share of the largest are rounding: no gap is looked for among them.
_FLOOR = 1e-11


class Evidence(NamedTuple):
    """What a rule may look at.

    Attributes:
        singular_values: of the projected data, largest first.
        correlations: canonical correlations between past and future, largest first; empty for a
            method without instruments.
        instruments: rows of the past.
        columns: columns of the data matrix, about the number of samples.
        nu: inputs.
        ny: outputs.
        largest: largest order to consider.
    """

    singular_values: Float[np.ndarray, " row"]
    correlations: Float[np.ndarray, " row"]
    instruments: int
    columns: int
    nu: int
    ny: int
    largest: int


class AbstractOrderRule(eqx.Module):
    """How many of the singular values are states.

    Example:
        >>> from lpvid.identify import AbstractOrderRule, PastOutputMOESP
        >>> class Even(AbstractOrderRule):
        ...     def choose(self, evidence):
        ...         return min(2, evidence.largest)
        >>> PastOutputMOESP(order=Even()).rule
        Even()
    """

    @abc.abstractmethod
    def choose(self, evidence: Evidence) -> int:
        """The order, at least 1.

        Raises:
            ValueError: the rule does not fit the method.
        """


class NoiseFloor(AbstractOrderRule):
    r"""Singular values above what noise alone could give. The default with instruments.

    With the future whitened by its noise, $L_{33}^{-1} L_{32}$, a direction that holds no state has
    entries of variance 1/M (M columns), and the largest singular value of m rows and r instruments
    is about $(\sqrt m + \sqrt r)/\sqrt M$ (the edge of the Marchenko–Pastur law; the Hankel
    structure raises it by a logarithm, which `margin` is for). In long records with little noise
    that edge counts ever smaller traces of what is not linear in the machine, so a state must
    matter as well: have a singular value of its own above a share of the largest.

    Args:
        margin: how far above that edge a state must stand.
        share: of the largest singular value, about the share of the output's amplitude.

    Example:
        >>> from lpvid.identify import NoiseFloor, PastOutputMOESP
        >>> PastOutputMOESP(order=NoiseFloor(margin=2.0)).rule.margin
        2.0
    """

    margin: float = eqx.field(static=True, default=1.5)
    share: float = eqx.field(static=True, default=1e-4)

    def choose(self, evidence: Evidence) -> int:
        """Count the signal-to-noise ratios above the edge, and the singular values that matter."""
        correlations = _correlations(evidence, "NoiseFloor")
        edge = np.sqrt(evidence.singular_values.size) + np.sqrt(evidence.instruments)
        edge = self.margin * edge / np.sqrt(evidence.columns)
        # A ratio ρ/√(1 − ρ²) above the edge, without dividing by nothing.
        above = correlations > edge * np.sqrt(np.maximum(1.0 - correlations**2, 0.0))
        values = evidence.singular_values
        matter = int(np.sum(values > self.share * values[0]))
        return max(min(int(np.sum(above[: evidence.largest])), matter), 1)


class InformationCriterion(AbstractOrderRule):
    r"""Bauer's singular value criterion SVC on the canonical correlations.

    Minimises $\rho_{n+1}^2 + n (2 n_y + n_u) \log(M) / M$ over n (Bauer 2001, "Order
    estimation for subspace methods", Automatica 37): the first correlation left out against the
    price of the parameters.

    Args:
        price: factor of the parameters' term.

    Example:
        >>> from lpvid.identify import CVA, InformationCriterion
        >>> CVA(order=InformationCriterion()).rule.price
        1.0
    """

    price: float = eqx.field(static=True, default=1.0)

    def choose(self, evidence: Evidence) -> int:
        """Minimise the criterion over orders from 1."""
        correlations = _correlations(evidence, "InformationCriterion")
        order = np.arange(1, min(evidence.largest, correlations.size - 1) + 1)
        parameters = order * (2 * evidence.ny + evidence.nu)
        price = self.price * parameters * np.log(evidence.columns) / evidence.columns
        return int(order[np.argmin(correlations[order] ** 2 + price)])


class LargestGap(AbstractOrderRule):
    """Order after which the singular values fall most, as a ratio.

    Right where there is a clear gap; otherwise weak modes are missed.

    Example:
        >>> from lpvid.identify import LargestGap, PastInputMOESP
        >>> PastInputMOESP(order=LargestGap()).rule
        LargestGap()
    """

    def choose(self, evidence: Evidence) -> int:
        """Compare every singular value with the next."""
        values = evidence.singular_values
        floored = np.maximum(values, _FLOOR * values[0])
        largest = min(evidence.largest, floored.shape[0] - 1)
        return int(np.argmax(floored[:largest] / floored[1 : largest + 1])) + 1


class Threshold(AbstractOrderRule):
    """Singular values above a share of the largest. ORSE's rule.

    Args:
        share: of the largest singular value.

    Example:
        >>> from lpvid.identify import ORSE, Threshold
        >>> ORSE(order=Threshold(1e-3)).rule.share
        0.001
    """

    share: float = eqx.field(static=True, default=0.02)

    def choose(self, evidence: Evidence) -> int:
        """Count them."""
        values = evidence.singular_values
        return int(np.clip(np.sum(values > self.share * values[0]), 1, evidence.largest))


def _correlations(evidence: Evidence, rule: str) -> Float[np.ndarray, " row"]:
    if not evidence.correlations.size:
        raise ValueError(
            f"order={rule}() compares past with future, and the method has no instruments: give "
            f"order=Threshold() or LargestGap(), or a method such as PastOutputMOESP."
        )
    return evidence.correlations
