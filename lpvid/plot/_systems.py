"""Models out of what the user gives, and their poles and responses as NumPy arrays."""

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from lpvid.analysis import (
    PoleUncertainty,
    frequency_response_covariance,
    pole_covariance,
)
from lpvid.models import StateSpace
from lpvid.plot._figure import labelled, model_of

# From rad/s to Hz.
HZ = 2.0 * np.pi
# Responses are computed for whole blocks of frequencies, so that systems with slightly different
# grids share one compiled function.
_BLOCK = 256


@runtime_checkable
class UncertainModel(Protocol):
    """A result that knows how well it knows its parameters, such as a `Refined`."""

    parameters: Any
    covariance: Any

    def model_at(self, parameters: Any, /) -> Any:
        """Model for other parameters."""


def state_spaces(systems: Any, labels: Sequence[str] | str | None) -> dict[str, StateSpace]:
    """One system, a sequence or a mapping as a mapping from label to model; results give theirs.

    Raises:
        ValueError: something that is no state-space model, or labels that do not fit.
    """
    models = {}
    for label, item in labelled(systems, labels, "systems", "system").items():
        model = model_of(item)
        # A structured model has its matrices so.
        model = getattr(model, "state_space", model)
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


def uncertain(
    systems: Any, labels: Sequence[str] | str | None, level: float | None
) -> dict[str, UncertainModel]:
    """Those of the systems that have a covariance, by label; none without a level.

    Raises:
        ValueError: a level that is no probability.
    """
    if level is None:
        return {}
    if not 0.0 < level < 1.0:
        raise ValueError(f"level is {level}; give a probability such as 0.95, or None.")
    found = labelled(systems, labels, "systems", "system")
    return {label: item for label, item in found.items() if isinstance(item, UncertainModel)}


def response_uncertainty(
    item: UncertainModel, omega: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Response at frequencies in rad/s, standard deviations of its magnitude and phase (rad)."""
    padded = np.pad(omega, (0, -omega.size % _BLOCK), mode="edge")
    known = frequency_response_covariance(item.model_at, item.parameters, item.covariance, padded)
    parts = (known.response, known.magnitude_std, known.phase_std)
    response, size, turn = (np.asarray(part)[: omega.size] for part in parts)
    return response, size, turn


def pole_uncertainty(item: UncertainModel) -> PoleUncertainty:
    """Poles with their covariances."""
    return pole_covariance(item.model_at, item.parameters, item.covariance)
