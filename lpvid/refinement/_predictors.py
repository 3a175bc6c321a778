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
    """One-step prediction x̂⁺ = f(x̂, u) + K (y − ŷ), ŷ = h(x̂, u), with K estimated too.

    The maximum likelihood estimate where noise enters the plant as well, or the data come from a
    closed loop. For linear models f(x, u) = A x + B u and h(x, u) = C x + D u (in continuous time
    K is that of the discretised model), for an `LPVStateSpace` or a `GrayBoxLPV` the same with the
    matrices at every sample's κ (of a continuous-time model discretised there), for others their
    `step`. K is one constant matrix, along moving schedules and over all records too: there and in
    nonlinear models the best gain may vary, and a constant one is then a compromise, which shows
    in a residual that is not quite white.

    There is no `shooting`: an unstable plant needs no pieces, because y and not the model carries
    the motion wherever K makes the predictor stable (for matrices, A − K C). Give a `gain` that
    does at the start, such as a Kalman gain of the model linearised there; where the start is too
    poor for one, refine with `OutputError(shooting=...)` first. Pieces with states of their own
    would leave K undetermined until they meet.

    With the first state free, a predictor pole outside the unit circle makes the likelihood look
    better than it is. The search of a linear model of constant matrices stays within the circle
    (to 0.1 %); wherever a fit ends at predictions that do not forget their start, and on short
    records of nearly pure output noise it may, the status is `unstable_predictor`.

    A module of one's own needs `n_states` (or `nx`) and `step(x, u, *, dt)` → (state one sample
    later, output at this one), `kappa` as one more keyword where it depends on a schedule, written
    with `jax.numpy` and smooth in the state and in the module's arrays. A plant with ẋ = f(x, u)
    gets all that from `NonlinearModel`.

    Attributes:
        gain: where K starts, (nx, ny); by default the innovation gain of the fit that is refined,
            or zero.

    Source: Ljung (1999), System Identification, sections 3.2 and 7.4, on the innovation form.

    Example:
        >>> import equinox as eqx
        >>> class Tank(eqx.Module):
        ...     outflow: jax.Array
        ...     n_states = 1
        ...     def step(self, x, u, *, dt):
        ...         return x + dt * (u - self.outflow * jnp.sqrt(1.0 + x)), x
        >>> Tank(jnp.asarray(1.0)).step(jnp.zeros(1), jnp.full(1, 2.0), dt=0.1)[0].tolist()
        [0.1]
        >>> predictor = Innovation(gain=[[0.4]])
    """

    gain: Float[Array, "nx ny"] | None = None

    def __init__(self, gain: ArrayLike | Sequence | None = None):
        self.gain = None if gain is None else jnp.asarray(gain, float)
