"""What a fit minimises: a loss of the residual, with the noise of every channel estimated."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

Residual = Float[Array, "record time ny"]
Mask = Bool[Array, "record time"]

# Share of an output's power below which its residual counts as rounding.
_ROUNDING = 1e-20


class Whitening(eqx.Module):
    """How a residual r enters the normal equations: as factor · (√weights ∘ r).

    Attributes:
        factor: upper triangular or diagonal, (ny, ny).
        weights: of every sample, (record, time, ny).
    """

    factor: Float[Array, "ny ny"]
    weights: Residual


class AbstractLoss(eqx.Module):
    """A loss of the residual over all records.

    `floor` is each output's smallest residual variance that is told from rounding. Residuals are
    zero where `mask` is false.
    """

    @property
    @abc.abstractmethod
    def rounds(self) -> int:
        """How often the scale is estimated anew and the fit repeated."""

    @abc.abstractmethod
    def scale(self, residual: Residual, mask: Mask, floor: Array) -> Float[Array, " ny"]:
        """Scale of every output's residual, held through one round."""

    @abc.abstractmethod
    def cost(self, residual: Residual, mask: Mask, scale: Array, floor: Array) -> Array:
        """The loss, in units of a negative log likelihood."""

    @abc.abstractmethod
    def whitening(self, residual: Residual, mask: Mask, scale: Array, floor: Array) -> Whitening:
        """Gauss–Newton weights at a residual."""

    @abc.abstractmethod
    def influence(self, residual: Residual, mask: Mask, scale: Array) -> Residual:
        """The residual as it moves the estimate: what the covariance is computed from."""

    @abc.abstractmethod
    def curvature(
        self, residual: Residual, mask: Mask, scale: Array, noise: Float[Array, "ny ny"]
    ) -> Float[Array, "ny ny"]:
        """F with Fᵀ F the loss's mean second derivative by the output, a sample.

        `noise` is the covariance of the influence.
        """


def covariance(residual: Residual, mask: Mask) -> Float[Array, "ny ny"]:
    """Second moments of a residual over all records."""
    return jnp.einsum("rta,rtb->ab", residual, residual) / jnp.sum(mask, dtype=float)


class SquaredLoss(AbstractLoss):
    r"""Gaussian likelihood with an unknown noise covariance, the default.

    $\frac N2 \log\det \hat\Lambda(\vartheta)$ with $\hat\Lambda$ the residual's covariance: outputs
    are weighted by their own noise, correlated noise as it should be, and no scale has to be given.

    Example:
        >>> SquaredLoss().rounds
        1
    """

    @property
    def rounds(self) -> int:
        """One: the noise covariance is eliminated, not iterated."""
        return 1

    def scale(self, residual: Residual, mask: Mask, floor: Array) -> Float[Array, " ny"]:
        """Not used."""
        del residual, mask
        return jnp.ones_like(floor)

    def cost(self, residual: Residual, mask: Mask, scale: Array, floor: Array) -> Array:
        """½ N log det of the residual's covariance."""
        del scale
        noise = covariance(residual, mask) + jnp.diag(floor)
        return 0.5 * jnp.sum(mask, dtype=float) * jnp.linalg.slogdet(noise)[1]

    def whitening(self, residual: Residual, mask: Mask, scale: Array, floor: Array) -> Whitening:
        """The inverse Cholesky factor of the covariance, all samples alike."""
        del scale
        noise = covariance(residual, mask) + jnp.diag(floor)
        return Whitening(inverse_factor(noise), jnp.ones_like(residual))

    def influence(self, residual: Residual, mask: Mask, scale: Array) -> Residual:
        """The residual itself."""
        del mask, scale
        return residual

    def curvature(
        self, residual: Residual, mask: Mask, scale: Array, noise: Float[Array, "ny ny"]
    ) -> Float[Array, "ny ny"]:
        """The inverse Cholesky factor of the noise: the weights are the best ones."""
        del residual, mask, scale
        return inverse_factor(noise)


class HuberLoss(AbstractLoss):
    """Quadratic for small residuals, linear for large ones: outliers cannot carry the fit away.

    Each output is scaled by its residual's median absolute deviation, estimated anew in three
    rounds; noise is taken as uncorrelated between outputs.

    Attributes:
        threshold: where the loss turns linear, in standard deviations of the noise without
            outliers. At the default 1.345 the variance is 5 % above least squares' under Gaussian
            noise.

    Raises:
        ValueError: the threshold is not positive.

    Source: Huber (1964), Annals of Mathematical Statistics 35.

    Example:
        >>> HuberLoss().threshold
        1.345
    """

    threshold: float = eqx.field(static=True, default=1.345)

    def __check_init__(self):
        if not self.threshold > 0.0:
            raise ValueError(f"threshold: a positive number is needed, got {self.threshold}.")

    @property
    def rounds(self) -> int:
        """Three: the scale of a start far off is too large."""
        return 3

    def scale(self, residual: Residual, mask: Mask, floor: Array) -> Float[Array, " ny"]:
        """Median absolute deviation over 0.6745, which is Gaussian noise's standard deviation."""
        size = jnp.where(mask[:, :, None], jnp.abs(residual), jnp.nan)
        return jnp.maximum(jnp.nanmedian(size, axis=(0, 1)) / 0.6745, jnp.sqrt(floor))

    def cost(self, residual: Residual, mask: Mask, scale: Array, floor: Array) -> Array:
        """Σ ρ(r / σ)."""
        del mask, floor
        size = jnp.abs(residual / scale[None, None, :])
        linear = self.threshold * (size - 0.5 * self.threshold)
        return jnp.sum(jnp.where(size <= self.threshold, 0.5 * size**2, linear))

    def whitening(self, residual: Residual, mask: Mask, scale: Array, floor: Array) -> Whitening:
        """Weights ψ(e) / e: those of a parabola that lies above the loss."""
        del mask, floor
        size = jnp.abs(residual / scale[None, None, :])
        return Whitening(jnp.diag(1.0 / scale), self.threshold / jnp.maximum(size, self.threshold))

    def influence(self, residual: Residual, mask: Mask, scale: Array) -> Residual:
        """σ ψ(r / σ) over the mean of ψ', whose variance is that of the estimate."""
        limit = self.threshold * scale[None, None, :]
        share = self._quadratic(residual, mask, scale)
        return jnp.clip(residual, -limit, limit) / share[None, None, :]

    def curvature(
        self, residual: Residual, mask: Mask, scale: Array, noise: Float[Array, "ny ny"]
    ) -> Float[Array, "ny ny"]:
        """Root of the mean of ψ'(r / σ) / σ²: outputs are weighted alone, correlated or not."""
        del noise
        return jnp.diag(jnp.sqrt(self._quadratic(residual, mask, scale)) / scale)

    def _quadratic(self, residual: Residual, mask: Mask, scale: Array) -> Float[Array, " ny"]:
        """Mean of ψ': share of the samples where the loss is quadratic."""
        limit = self.threshold * scale[None, None, :]
        inside = (jnp.abs(residual) <= limit) & mask[:, :, None]
        share = jnp.sum(inside, axis=(0, 1), dtype=float) / jnp.sum(mask, dtype=float)
        return jnp.maximum(share, 0.1)


def inverse_factor(noise: Float[Array, "ny ny"]) -> Float[Array, "ny ny"]:
    """F with Fᵀ F the inverse of a covariance."""
    factor = jnp.linalg.cholesky(noise)
    return jax.scipy.linalg.solve_triangular(factor, jnp.eye(noise.shape[0]), lower=True)


def rounding_floor(y: Float[Array, "record time ny"], mask: Mask) -> Float[Array, " ny"]:
    """Variance of every output that is told from rounding."""
    power = jnp.sum(y**2, axis=(0, 1)) / jnp.sum(mask, dtype=float)
    return _ROUNDING * jnp.where(power > 0.0, power, 1.0)
