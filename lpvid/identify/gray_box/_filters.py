r"""First-order filters 1/(τ s + 1), the signals they give, and what a model looks like in them.

With λ = 1/(τ s + 1) and the all-pass p = (1 − τ s)/(1 + τ s) = 2 λ − 1 every product λ^k is a sum
of the Laguerre filters ℓ_j = λ p^j, j < k, and conversely. The signals are always filtered by ℓ_j,
which white noise leaves uncorrelated with one another; the powers λ^k follow from them exactly.
Time is counted in samples here: τ is τ/h.
"""

import abc
import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lpvid._linalg import expm
from lpvid.models import StateSpace


class AbstractFilterBasis(eqx.Module):
    """Which filtered signals stand in the place of delayed samples.

    Example:
        >>> from lpvid.identify.gray_box import LaguerreFilters
        >>> LaguerreFilters().combinations(2).shape
        (4, 5)
    """

    @abc.abstractmethod
    def combinations(self, block_rows: int) -> Float[np.ndarray, "row signal"]:
        """Rows of future and past in terms of the signals [unfiltered, ℓ_0, ℓ_1, …].

        Args:
            block_rows: i, rows of future and of past.

        Returns:
            (2 i, 2 i + 1): the least filtered signal first, the future its first i rows.
        """

    @abc.abstractmethod
    def continuous(
        self, shift: Float[Array, "nx nx"], tau: Float[Array, ""]
    ) -> Float[Array, "nx nx"]:
        """A of the continuous-time model from that of the extended model.

        Args:
            shift: what takes the state from one row to the next less filtered one.
            tau: time constant τ.
        """


class LaguerreFilters(AbstractFilterBasis):
    """Signals λ p^k, k = 0 … 2 i − 1, with the inverse of p in the place of the forward shift.

    z = (I − τA)⁻¹(I + τA) [p z] + (I − τA)⁻¹ τB [u + p u]: the extended model has the shape of the
    discrete-time one. The filters are orthogonal, so white measurement noise stays white from row
    to row and past outputs are valid instruments; nothing is lost at many rows (Chou, Verhaegen,
    Johansson 1999, "Continuous-time identification of SISO systems using Laguerre functions").

    Example:
        >>> from lpvid.identify.gray_box import LaguerreFilters
        >>> LaguerreFilters().combinations(1).tolist()
        [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """

    def combinations(self, block_rows: int) -> Float[np.ndarray, "row signal"]:
        """Every Laguerre filter is a row; the unfiltered signal is not used."""
        return np.eye(2 * block_rows, 2 * block_rows + 1, 1)

    def continuous(
        self, shift: Float[Array, "nx nx"], tau: Float[Array, ""]
    ) -> Float[Array, "nx nx"]:
        """A = (F − I)(F + I)⁻¹/τ."""
        identity = jnp.eye(shift.shape[0])
        return jnp.linalg.solve((shift + identity).T, (shift - identity).T).T / tau


class FilterPowers(AbstractFilterBasis):
    r"""Signals λ^k, k = 0 … 2 i − 1, as published: equations 8 to 17 of 000.

    $[\lambda^k y] = C A_\lambda^{i-1-k} [\lambda^{i-1} z] + \sum_{j=k+1}^{i-1}
    C A_\lambda^{j-k-1} B_\lambda [\lambda^j u]$ with $A_\lambda = I + \tau A$. The signals grow
    alike with k, so that beyond about i = 6 the data matrix is ill-conditioned, and noise is
    correlated from past to future rows.

    Example:
        >>> from lpvid.identify.gray_box import FilterPowers
        >>> FilterPowers().combinations(1).tolist()
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    """

    def combinations(self, block_rows: int) -> Float[np.ndarray, "row signal"]:
        """λ^k = λ ((1 + p)/2)^(k−1)."""
        rows = np.zeros((2 * block_rows, 2 * block_rows + 1))
        rows[0, 0] = 1.0
        for power in range(1, 2 * block_rows):
            weights = [math.comb(power - 1, j) for j in range(power)]
            rows[power, 1 : power + 1] = np.array(weights) / 2.0 ** (power - 1)
        return rows

    def continuous(
        self, shift: Float[Array, "nx nx"], tau: Float[Array, ""]
    ) -> Float[Array, "nx nx"]:
        """A = (A_λ − I)/τ."""
        return (shift - jnp.eye(shift.shape[0])) / tau


def laguerre_signals(
    held: Float[Array, "time nu"],
    ramps: Float[Array, "time ny"],
    tau: Float[Array, ""],
    count: int,
) -> tuple[Float[Array, "time channel signal"], Float[Array, "time signal"]]:
    """Sampled signals through ℓ_0 … ℓ_(count−1) from rest, exact at the sample instants.

    Args:
        held: samples of signals that stay from sample to sample (zero-order hold).
        ramps: samples of signals that run straight between them (first-order hold).
        tau: time constant in samples.
        count: number of filters.

    Returns:
        The filtered signals, held ones first, and the filters' own impulse responses (of unit
        energy), in whose span lies what the initial state of a plant adds to its filtered outputs.
    """
    A, b = _chain(tau, count)
    transition, hold, ramp = _hold_equivalents(A, b)
    # The ramp's next sample is moved into the output, so that the recursion sees past ones only.
    after = transition @ ramp + hold - ramp
    nothing = jnp.zeros_like(b)
    kinds = np.repeat([0, 1, 2], [held.shape[1], ramps.shape[1], 1])
    forcing = jnp.stack([hold, after, nothing])[kinds]
    direct = jnp.stack([nothing, ramp, nothing])[kinds]
    u = jnp.concatenate([held, ramps, jnp.zeros((held.shape[0], 1))], axis=1)
    start = -direct * u[0][:, None]
    start = start.at[-1].set(b * jnp.sqrt(2.0 * tau))
    chains = StateSpace(transition, forcing[:, :, None], jnp.eye(count), direct[:, :, None], dt=1.0)
    responses = chains.simulate(u=u.T[:, :, None], x0=start).transpose(1, 0, 2)
    return responses[:, :-1], responses[:, -1]


def _chain(tau, count):
    """ẋ = A x + b u whose states are the outputs of ℓ_0 … ℓ_(count−1)."""
    # τ ẋ_k = −x_k − 2 Σ_{j<k} x_j + u is the chain of −p; every second sign makes it that of p.
    sign = (-1.0) ** np.arange(count)
    matrix = -np.eye(count) - 2.0 * np.tril(np.ones((count, count)), -1)
    return jnp.asarray(sign[:, None] * matrix * sign[None, :]) / tau, jnp.asarray(sign) / tau


def _hold_equivalents(A, b):
    """exp(A), what a held unit input adds in one sample, and what a unit ramp adds."""
    n = A.shape[0]
    augmented = jnp.zeros((n + 2, n + 2))
    augmented = augmented.at[:n, :n].set(A).at[:n, n].set(b).at[n, n + 1].set(1.0)
    exponential = expm(augmented)
    return exponential[:n, :n], exponential[:n, n], exponential[:n, n + 1]
