"""Frequency responses of models."""

from jaxtyping import Array, Complex

from lpvid.models._state_space import Numbers, StateSpace


def frequency_response(
    system: StateSpace, omega: Numbers
) -> Complex[Array, "*batch frequency ny nu"]:
    """Transfer matrix at angular frequencies; see `StateSpace.frequency_response`.

    Example:
        >>> from lpvid.models import StateSpace, frequency_response
        >>> abs(frequency_response(StateSpace([[-1.0]], [[1.0]], [[1.0]]), 1.0)).round(3).item()
        0.707
    """
    return system.frequency_response(omega)
