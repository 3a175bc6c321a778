"""Linear regression for equations of motion, by modulating functions over windows."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.polynomial import Polynomial

from lpvid.data import IOData
from lpvid.loop.structures._windows import Windows

# (1 − s²)³ vanishes with two derivatives at the window's ends; the factors make the means zero, so
# that a constant force within the window drops out.
_BELL = Polynomial([1.0, 0.0, -1.0]) ** 3
_FACTORS = (Polynomial([0, 1.0]), Polynomial([-1 / 9, 0, 1.0]), Polynomial([0, -3 / 11, 0, 1.0]))


class Moments(NamedTuple):
    """∫φ of the signals and of their derivatives, with the derivatives moved onto φ.

    Attributes:
        inputs: (input, equation).
        positions: (output, equation).
        velocities: (output, equation).
        accelerations: (output, equation).
    """

    inputs: Float[np.ndarray, "nu equation"]
    positions: Float[np.ndarray, "ny equation"]
    velocities: Float[np.ndarray, "ny equation"]
    accelerations: Float[np.ndarray, "ny equation"]


def moments(windows: Windows, nu: int, ny: int) -> Moments:
    """Moments of all windows of one length with three modulating functions."""
    samples = windows.samples
    half = 0.5 * (samples - 1) * windows.step
    place = np.linspace(-1.0, 1.0, samples)
    functions = [_BELL * factor for factor in _FACTORS]
    values = np.array([function(place) for function in functions])
    first = np.array([function.deriv()(place) for function in functions]) / half
    second = np.array([function.deriv(2)(place) for function in functions]) / half**2
    mean = 0.5 * (values[:, 1:] + values[:, :-1])
    rise = (values[:, 1:] - values[:, :-1]) / 6.0
    outputs = windows.outputs.reshape(len(windows.outputs), samples, ny, -1)
    inputs = windows.inputs.reshape(len(windows.inputs), samples, 2 * nu, -1)[:, :-1]

    def over(weights, signal):
        return np.einsum("ft,gtjc->jgfc", weights, signal).reshape(signal.shape[2], -1)

    return Moments(
        over(mean, inputs[:, :, :nu]) + over(rise, inputs[:, :, nu:]),
        over(values, outputs),
        -over(first, outputs),
        over(second, outputs),
    )


def least_squares(
    regressors: Float[np.ndarray, "equation unknown"], target: Float[np.ndarray, " equation"]
) -> Float[np.ndarray, " unknown"]:
    """Solution over columns of unit length."""
    size = np.maximum(np.linalg.norm(regressors, axis=0), 1e-300)
    return np.linalg.lstsq(regressors / size, target, rcond=None)[0] / size


def drive_sign(data: IOData, *, rate: bool = False) -> float:
    """Whether the input pushes the first output up (1) or down (−1): the work it does is positive.

    A passive machine with any friction takes in energy on the whole, whatever resonances, gravity
    or load it has; feedback from a noisy output only adds to that.

    Args:
        data: records of one input.
        rate: whether the first output is a velocity.
    """
    work = 0.0
    for record in data.records:
        u, y = np.asarray(record.u)[:-1, 0], np.asarray(record.y)[:, 0]
        # A constant input holds a load; what it lifts on the whole says nothing of the drive.
        work += float((u - u.mean()) @ (y[1:] if rate else np.diff(y)))
    return -1.0 if work < 0.0 else 1.0


def rigid_body(
    scales: Sequence[Windows], *, ny: int, rate: bool = False
) -> Float[np.ndarray, "scale 2"]:
    """Inertia and viscous friction for one unit of input, by windows of each length.

    Args:
        scales: windows of one input and `ny` outputs, of which the first counts.
        ny: number of outputs.
        rate: whether the output is a velocity.
    """
    rows = []
    for windows in scales:
        known = moments(windows, 1, ny)
        above, below = known.accelerations, known.velocities
        if rate:
            above, below = known.velocities, known.positions
        rows.append(least_squares(np.stack([above[0], below[0]], axis=1), known.inputs[0]))
    return np.array(rows)
