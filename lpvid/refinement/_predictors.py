"""What the output is predicted from: the input alone, or past outputs as well."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float


class AbstractPredictor(eqx.Module):
    """How a model predicts the output."""


class OutputError(AbstractPredictor):
    """Simulation from the input alone: all noise is taken as noise of the measurement.

    The estimate is consistent for coloured noise too, as long as it does not come from the input
    (no feedback).

    With `shooting` the records are cut into pieces, each from a state of its own: over so few
    samples nothing grows out of bounds, and a poor start does not run away. The pieces are free at
    first and then made to meet, by an augmented Lagrangian whose weight rises from round to round;
    the end is the same maximum of the likelihood, with the same covariance, as without. For poor or
    unstable starts, and for unstable and integrating plants, however much they grow over the
    record. The largest gap that is left, over the size of the state (of an LPV or other module: of
    the output), is in `Refined.stats["largest_gap"]`; above 1e-8 the status says so.

    Attributes:
        shooting: samples in a piece; None for whole records at once.

    Raises:
        ValueError: `shooting` is below two.

    Example:
        >>> OutputError(shooting=50).shooting
        50
    """

    shooting: int | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        if self.shooting is not None and self.shooting < 2:
            raise ValueError(f"shooting: at least 2 samples are needed, got {self.shooting}.")


class Innovation(AbstractPredictor):
    """One-step prediction x̂⁺ = A x̂ + B u + K e, e = y − C x̂ − D u, K estimated too.

    The maximum likelihood estimate where noise enters the plant as well, or the data come from a
    closed loop. In continuous time K is that of the discretised model.

    Attributes:
        gain: where K starts, (nx, ny); by default the innovation gain of the fit that is refined,
            or zero. An unstable model needs one that makes A − K C stable.

    Example:
        >>> Innovation().gain is None
        True
    """

    gain: Float[Array, "nx ny"] | None = None

    def __init__(self, gain: ArrayLike | Sequence | None = None):
        self.gain = None if gain is None else jnp.asarray(gain, float)
