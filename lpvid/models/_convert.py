"""Conversion of models between continuous and discrete time."""

from lpvid.models._hold import AbstractConversion, ZeroOrderHold
from lpvid.models._state_space import StateSpace

_ZERO_ORDER_HOLD = ZeroOrderHold()


def c2d(system: StateSpace, dt: float, method: AbstractConversion = _ZERO_ORDER_HOLD) -> StateSpace:
    """Discrete-time model with sample time `dt` in seconds; see `StateSpace.discretise`.

    Example:
        >>> from lpvid.models import StateSpace, Tustin, c2d
        >>> c2d(StateSpace([[-1.0]], [[1.0]], [[1.0]]), 2.0, Tustin()).D.item()
        0.5
    """
    return system.discretise(dt, method)


def d2c(system: StateSpace, method: AbstractConversion = _ZERO_ORDER_HOLD) -> StateSpace:
    """Continuous-time model of a discrete-time one; see `StateSpace.to_continuous`.

    Example:
        >>> from lpvid.models import StateSpace, c2d, d2c
        >>> system = StateSpace([[-1.0]], [[1.0]], [[1.0]])
        >>> round(d2c(c2d(system, 0.1)).A.item(), 6)
        -1.0
    """
    return system.to_continuous(method)
