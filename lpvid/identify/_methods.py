"""Subspace methods: which instruments, which weights."""

import abc
import dataclasses
import functools
import operator
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid.identify._factor import DataFactor, solve_lower
from lpvid.identify._order import AbstractOrderRule, NoiseFloor, Threshold

Order = int | Literal["auto"] | AbstractOrderRule


def plain(value: Any) -> Any:
    """NumPy's whole numbers as Python's."""
    return operator.index(value) if isinstance(value, np.integer) else value


class AbstractSubspaceMethod(eqx.Module):
    """A subspace method: its settings, its instruments and its weights.

    The engine factors the data, asks the method for the matrix whose range is that of the
    observability matrix, and does the rest: order, A and C, stabilisation, B, D, x0, offset and
    noise. A method of one's own says which instruments it uses and how it projects.

    Attributes:
        order: number of states, "auto" for the method's own rule (`automatic`), or a rule:
            `NoiseFloor`, `InformationCriterion`, `LargestGap`, `Threshold`.
        block_rows: s, rows of past and of future; `None` for twice the order and at least 10, or
            15 with an automatic order. Long horizons separate slow modes.
        feedthrough: whether D is estimated; `False` keeps it zero.
        stabilise: `False`, or a radius: eigenvalues of A outside it are moved onto it, and B, D
            and x0 are then estimated for the moved A.
        offset: whether the outputs have an unknown constant offset, common to all records, that is
            estimated with the model. `False` for records whose offsets are known and taken out:
            what the mean of a short record leaves of an offset shows as a spurious slow state.
            With a pole at 1 (an integrator) the offset cannot be told from the initial state.
        past_inputs: whether past inputs are among the instruments.
        past_outputs: whether past outputs are among the instruments.
        automatic: the rule behind `order="auto"`.

    Raises:
        ValueError: a setting out of its range.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.identify import AbstractSubspaceMethod, identify
        >>> class InstrumentalVariables(AbstractSubspaceMethod):
        ...     def project(self, factor):
        ...         return factor.outputs_instruments @ factor.instruments.T, None
        >>> u = np.random.default_rng(0).standard_normal(500)
        >>> y = np.convolve(u, 0.8 ** np.arange(50))[:500]
        >>> method = InstrumentalVariables(order=1, block_rows=5)
        >>> round(identify(IOData(u=u, y=y, dt=0.1), method).model.A.item(), 3)
        0.8
    """

    order: Order = eqx.field(static=True, default="auto", converter=plain)
    block_rows: int | None = eqx.field(static=True, default=None, converter=plain)
    feedthrough: bool = eqx.field(static=True, default=True, kw_only=True)
    stabilise: float | Literal[False] = eqx.field(static=True, default=False, kw_only=True)
    offset: bool = eqx.field(static=True, default=False, kw_only=True)
    past_inputs: ClassVar[bool] = True
    past_outputs: ClassVar[bool] = True
    automatic: ClassVar[AbstractOrderRule] = NoiseFloor()

    def __check_init__(self):
        order, block_rows, stabilise = self.order, self.block_rows, self.stabilise
        if not (order == "auto" or isinstance(order, AbstractOrderRule) or _is_count(order, 1)):
            raise ValueError(
                f'order={order!r}: give a positive whole number, "auto", or a rule such as '
                f"NoiseFloor()."
            )
        if block_rows is not None and not _is_count(block_rows, 2):
            raise ValueError(
                f"block_rows={block_rows!r}: give a whole number of 2 or more, or None."
            )
        for name, value, meaning in (
            ("feedthrough", self.feedthrough, "True (estimate D) or False (D = 0)"),
            ("offset", self.offset, "True (estimate a constant in y) or False (there is none)"),
        ):
            if not isinstance(value, bool):
                raise ValueError(f"{name}={value!r}: give {meaning}.")
        if stabilise is not False and not (
            isinstance(stabilise, int | float)
            and not isinstance(stabilise, bool)
            and 0.0 < stabilise < 1.0
        ):
            raise ValueError(
                f"stabilise={stabilise!r}: give False, or a radius between 0 and 1 such as 0.9999."
            )

    @abc.abstractmethod
    def project(
        self, factor: DataFactor
    ) -> tuple[
        Float[Array, "future_outputs column"], Float[Array, "future_outputs future_outputs"] | None
    ]:
        """Matrix whose dominant left range is looked for, and the weight to undo.

        Returns:
            The matrix, and the inverse of the W by which the observability matrix is multiplied in
            its range, or `None` for the identity.
        """

    @property
    def rule(self) -> AbstractOrderRule | None:
        """How the order is chosen; `None` where it is given."""
        if isinstance(self.order, AbstractOrderRule):
            return self.order
        return self.automatic if self.order == "auto" else None


@functools.lru_cache(maxsize=256)
def projection_only(method: AbstractSubspaceMethod) -> AbstractSubspaceMethod:
    """The method without the settings that do not enter the projection.

    What is compiled for one order serves every order.
    """
    return dataclasses.replace(method, order="auto", feedthrough=True, stabilise=False)


class PastOutputMOESP(AbstractSubspaceMethod):
    """PO-MOESP: past inputs and past outputs as instruments. The choice for measured data.

    With $[U_f; U_p; Y_p; Y_f] = L Q$ the range of the observability matrix is that of
    $L_{32}$, the future outputs freed of the future inputs and correlated with the past
    (Verhaegen 1994, "Identification of the deterministic part of MIMO state space models given in
    innovations form from input-output data", Automatica 30). Consistent for output noise that is
    coloured by the system or independent of the past. Settings: see `AbstractSubspaceMethod`.

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

    past_outputs = True

    def project(self, factor: DataFactor) -> tuple[Array, None]:
        """The factor's block $L_{32}$, unweighted."""
        return factor.outputs_instruments, None


class PastInputMOESP(AbstractSubspaceMethod):
    """PI-MOESP: past inputs alone as instruments.

    With $[U_f; U_p; Y_f] = L Q$ the range is that of $L_{32}$ (Verhaegen 1993, "Subspace model
    identification, part 3", Int. J. Control 58). Consistent for any output noise that is
    independent of the input, but with more variance than `PastOutputMOESP`: on short or lightly
    damped records it may come out unstable. It tells nothing of the noise: no innovation gain.
    Settings: see `AbstractSubspaceMethod`.

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

    past_outputs = False

    def project(self, factor: DataFactor) -> tuple[Array, None]:
        """The factor's block $L_{32}$, unweighted."""
        return factor.outputs_instruments, None


class N4SID(AbstractSubspaceMethod):
    r"""N4SID: the future outputs projected along the future inputs onto the past, unweighted.

    With W the past inputs and outputs, the oblique projection $Y_f /_{U_f} W$ is
    $L_{32} L_{22}^{-1} [L_{21}, L_{22}] Q$, the observability matrix times the states of a Kalman
    filter (Van Overschee and De Moor 1994, "N4SID: subspace algorithms for the identification of
    combined deterministic-stochastic systems", Automatica 30; the weights of their unifying theorem
    are identities). A, C come from its range and B, D from the simulation error, not from a
    regression on the states. Settings: see `AbstractSubspaceMethod`.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.identify import N4SID, identify
        >>> u = np.random.default_rng(0).standard_normal(500)
        >>> y = np.convolve(u, 0.8 ** np.arange(50))[:500]
        >>> fit = identify(IOData(u=u, y=y, dt=0.1), N4SID(order=1, block_rows=5))
        >>> round(fit.model.A.item(), 3)
        0.8
    """

    past_outputs = True

    def project(self, factor: DataFactor) -> tuple[Array, None]:
        """Coordinates of the oblique projection, $L_{32} [L_{22}^{-1} L_{21}, I]$."""
        past = solve_lower(factor.instruments, factor.instruments_inputs)
        return jnp.concatenate(
            [factor.outputs_instruments @ past, factor.outputs_instruments], 1
        ), None


class CVA(AbstractSubspaceMethod):
    r"""CVA: canonical correlations between the past and the future freed of the future inputs.

    The future outputs are whitened: $W L_{32}$ with $W^{-1}$ a root of
    $L_{32} L_{32}^\top + L_{33} L_{33}^\top$, so that the singular values are canonical
    correlations between 0 and 1 (Larimore 1990, "Canonical variate analysis in identification,
    filtering, and adaptive control"; the weights are those of Van Overschee and De Moor 1995,
    "A unifying theorem for three subspace system identification algorithms", Automatica 31).
    Nearly optimal where the noise passes through the system. Settings: see
    `AbstractSubspaceMethod`.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.identify import CVA, identify
        >>> u, e = np.random.default_rng(0).standard_normal((2, 500))
        >>> y = np.convolve(u, 0.8 ** np.arange(50))[:500] + 0.1 * e
        >>> fit = identify(IOData(u=u, y=y, dt=0.1), CVA(order=1, block_rows=5))
        >>> round(fit.model.A.item(), 2)
        0.8
    """

    past_outputs = True

    def project(self, factor: DataFactor) -> tuple[Array, Array]:
        """The whitened $L_{32}$, and the root that whitens it."""
        root = factor.future_root()
        return solve_lower(root, factor.outputs_instruments), root


class ORSE(AbstractSubspaceMethod):
    r"""ORSE: observability range space extraction; no instruments.

    The range of $Y Y^\top - Y U^\top (U U^\top)^+ U Y^\top$ with q block rows (Sun 2000, equations
    2-18 to 2-23, after Liu and Skelton's Q-Markov covers), here that of its triangular root, so
    that the singular values are square roots of the published ones. The order is the number of
    singular values above a threshold, by default `Threshold()`. Output noise is taken for
    dynamics: consistent only without it, though noise much weaker than the weakest mode does little
    harm. No innovation gain. `block_rows` is q; other settings as `AbstractSubspaceMethod` has
    them.

    Example:
        >>> import numpy as np
        >>> from lpvid.data import IOData
        >>> from lpvid.identify import ORSE, identify
        >>> u = np.random.default_rng(0).standard_normal(500)
        >>> y = np.convolve(u, 0.8 ** np.arange(50))[:500]
        >>> fit = identify(IOData(u=u, y=y, dt=0.1), ORSE(block_rows=5, feedthrough=True))
        >>> fit.order, round(fit.model.A.item(), 3)
        (1, 0.8)
    """

    past_inputs = False
    past_outputs = False
    automatic = Threshold()

    def project(self, factor: DataFactor) -> tuple[Array, None]:
        """The factor's block $L_{33}$: what the inputs leave of the outputs."""
        return factor.outputs, None


def _is_count(value, least):
    return isinstance(value, int) and not isinstance(value, bool) and value >= least
