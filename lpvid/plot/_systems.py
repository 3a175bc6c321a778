"""Models out of what the user gives, and their poles and responses as NumPy arrays."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lpvid.models import StateSpace
from lpvid.plot._figure import labelled, model_of

# From rad/s to Hz.
HZ = 2.0 * np.pi
# Responses are computed for whole blocks of frequencies, so that systems with slightly different
# grids share one compiled function.
_BLOCK = 256


def state_spaces(systems: Any, labels: Sequence[str] | str | None) -> dict[str, StateSpace]:
    """One system, a sequence or a mapping as a mapping from label to model; results give theirs.

    Raises:
        ValueError: something that is no state-space model, or labels that do not fit.
    """
    models = {}
    for label, item in labelled(systems, labels, "systems", "system").items():
        model = model_of(item)
        if not isinstance(model, StateSpace):
            raise ValueError(
                f"systems: {label!r} is a {type(item).__name__}; give state-space models (of an "
                "LPV model lpv.at(kappa))."
            )
        models[label] = model
    return models


def plane_poles(model: StateSpace) -> NDArray[np.complex128]:
    """Poles in s or z, (..., nx)."""
    return np.linalg.eigvals(np.asarray(model.A)).astype(np.complex128)


def continuous_poles(model: StateSpace) -> NDArray[np.complex128]:
    """Poles in s, rad/s; those of a discrete-time model by s = log(z) / dt (z = 0 gives −∞)."""
    poles = plane_poles(model)
    if not model.is_discrete:
        return poles
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.divide(np.log(poles), model.dt, dtype=np.complex128)


def response_of(model: StateSpace, omega: np.ndarray) -> np.ndarray:
    """Response with all batch axes as one in front: (member, frequency, ny, nu)."""
    padded = np.pad(omega, (0, -omega.size % _BLOCK), mode="edge")
    response = np.asarray(model.frequency_response(padded))[..., : omega.size, :, :]
    return response.reshape(-1, *response.shape[-3:])
