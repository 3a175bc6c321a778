"""Exchange of models with python-control and SciPy; both are imported only when used."""

from typing import Any

import numpy as np
from jax.core import Tracer

from lpvid.models._state_space import StateSpace


def _matrices(system: StateSpace) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    if system.batch_shape:
        raise ValueError(
            f"The model has batch axes {system.batch_shape}; convert one at a time, as in "
            f"jax.tree.map(lambda leaf: leaf[0], system)."
        )
    if isinstance(system.A, Tracer):
        raise ValueError("The model holds traced values; convert it outside jit, vmap and grad.")
    # Copies: other libraries expect to be able to write into their arrays.
    return (np.array(system.A), np.array(system.B), np.array(system.C), np.array(system.D))


def _control() -> Any:
    try:
        import control
    except ImportError as error:
        raise ImportError(
            "python-control is not installed; install it with `pip install control`."
        ) from error
    return control


def to_control(system: StateSpace) -> Any:
    """The model as a `control.StateSpace`; a batch, as `lpv.at(kappas)`, as a list of them.

    Args:
        system: a model; with one batch axis for a list, with more for a list of lists.

    Raises:
        ImportError: python-control is not installed.
        ValueError: the model holds traced values.

    Example:
        >>> from lpvid.models import StateSpace, to_control
        >>> float(to_control(StateSpace([[-1.0]], [[1.0]], [[2.0]])).dcgain())  # doctest: +SKIP
        2.0
    """
    if system.batch_shape:
        blocks = zip(system.A, system.B, system.C, system.D, strict=True)
        return [to_control(StateSpace(*each, dt=system.dt)) for each in blocks]
    return _control().ss(*_matrices(system), system.dt)


def from_control(system: Any) -> StateSpace:
    """A model from a `control.StateSpace` or `control.TransferFunction` (converted first).

    A sample time that python-control leaves unspecified (`None`) counts as continuous time.

    Raises:
        ImportError: python-control is not installed.
        ValueError: the sample time is `True` (discrete, but of unknown length).

    Example:
        >>> import control  # doctest: +SKIP
        >>> from_control(control.ss(-1, 1, 2, 0)).dc_gain().item()  # doctest: +SKIP
        2.0
    """
    realised = _control().ss(system)
    if realised.dt is True:
        raise ValueError(
            "dt is True, a discrete-time system of unknown sample time; set its dt in seconds."
        )
    dt = 0.0 if realised.dt is None else float(realised.dt)
    return StateSpace(realised.A, realised.B, realised.C, realised.D, dt=dt)


def to_scipy(system: StateSpace) -> Any:
    """The model as a `scipy.signal.StateSpace`.

    Raises:
        ValueError: the model has batch axes.

    Example:
        >>> from lpvid.models import StateSpace, to_scipy
        >>> to_scipy(StateSpace([[-1.0]], [[1.0]], [[2.0]])).A.tolist()
        [[-1.0]]
    """
    from scipy import signal

    matrices = _matrices(system)
    return (
        signal.StateSpace(*matrices, dt=system.dt)
        if system.is_discrete
        else signal.StateSpace(*matrices)
    )


def from_scipy(system: Any) -> StateSpace:
    """A model from any `scipy.signal` linear system (`StateSpace`, `TransferFunction`, …).

    Raises:
        ValueError: the sample time is `True` (discrete, but of unknown length).

    Example:
        >>> from scipy import signal
        >>> from lpvid.models import from_scipy
        >>> from_scipy(signal.lti([2.0], [1.0, 1.0])).dc_gain().item()
        2.0
    """
    realised = system.to_ss()
    if realised.dt is True:
        raise ValueError(
            "dt is True, a discrete-time system of unknown sample time; set its dt in seconds."
        )
    dt = 0.0 if realised.dt is None else float(realised.dt)
    return StateSpace(realised.A, realised.B, realised.C, realised.D, dt=dt)
