"""Where the shapes of laws may lie, from the sizes of the signals."""

import numpy as np

from lpvid.effects._law import Scales

LEAST = 1e-12


def span(low: float, high: float, *, ratio: float = 4.0) -> tuple[float, float]:
    """A range that is never empty: positive, and `high` at least `ratio` times `low`.

    Args:
        low: least value wanted; not below 1e-12.
        high: greatest value wanted.
        ratio: of the two at least.

    Example:
        >>> span(0.0, 2.0)
        (1e-12, 2.0)
    """
    low = max(float(low), LEAST)
    return low, max(float(high), ratio * low)


def inside(low: float, high: float, count: int) -> np.ndarray:
    """Values in geometric progression, strictly between two.

    Args:
        low: below the first one.
        high: above the last one.
        count: how many.

    Example:
        >>> inside(1.0, 16.0, 3)
        array([2., 4., 8.])
    """
    return np.geomspace(low, high, count + 2)[1:-1]


def sign_width(scales: Scales) -> tuple[float, float]:
    """Range of the speed vs over which a friction's sign changes.

    A free vs runs to zero, where only noise decides and an explicit step is no longer stable: it
    stays above a tenth of the velocity's noise and a hundredth of what it moves in a sample: laws
    are read at several points of their way over a step.

    Args:
        scales: sizes of the signals at the port.

    Example:
        >>> one = Size(rms=1.0, peak=3.0, noise=0.01)
        >>> sign_width(Scales(one, one, one, one, one, one, dt=0.001, duration=10.0))
        (0.003, 0.5)
    """
    velocity = scales.velocity
    resolved = 0.01 * scales.acceleration.rms * scales.dt
    return span(max(0.1 * velocity.noise, resolved, 0.003 * velocity.rms), 0.5 * velocity.rms)


def travel(scales: Scales) -> float:
    """Length below which a displacement is presliding: 0.3 of the position's root mean square.

    Args:
        scales: sizes of the signals at the port.

    Example:
        >>> one = Size(rms=1.0, peak=3.0, noise=0.01)
        >>> travel(Scales(one, one, one, one, one, one, dt=0.001, duration=10.0))
        0.3
    """
    return max(0.3 * scales.position.rms, 10.0 * LEAST)
