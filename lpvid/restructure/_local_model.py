"""The convex local model of the squared norm: cutting planes and curvature (001, eq. 18-21)."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from lpvid._types import Scalar
from lpvid.restructure._quadratic import Rows

# Singular values closer than this share of the largest turn too fast for a quadratic model.
_LEAST_SEPARATION = 0.05
# A peak flatter than this, along the frequency's logarithm, is anywhere: a plateau.
_LEAST_PEAK = 1e-2

# Error at given frequencies after a step, and after a relative shift of each frequency.
ErrorAt = Callable[[Array, Array], Complex[Array, "place long short"]]


class Expansion(NamedTuple):
    """Σ(jω) and its derivatives at some frequencies, the short side of Σ last.

    Attributes:
        error: Σ at each frequency.
        slopes: its derivative along each direction of the parameters.
        drift: its derivative along the frequency's logarithm.
        gains: squared singular values, largest first.
        vectors: right singular vectors as columns, in the same order.
        top: the largest of all squared gains; everything is relative to it.
    """

    error: Complex[Array, "place long short"]
    slopes: Complex[Array, "direction place long short"]
    drift: Complex[Array, "place long short"]
    gains: Float[Array, "place short"]
    vectors: Complex[Array, "place short short"]
    top: Scalar


def gram_eigenvectors(
    gram: Complex[Array, "place short short"],
) -> tuple[Float[Array, "place short"], Complex[Array, "place short short"]]:
    """Eigenvalues of Hermitian matrices, largest first, and their vectors."""
    if gram.shape[-1] == 1:
        return jnp.real(gram[:, :, 0]), jnp.ones_like(gram)
    values, vectors = jnp.linalg.eigh(gram)
    return values[:, ::-1], vectors[:, :, ::-1]


def adjoint_product(left: Array, right: Array) -> Array:
    """leftᴴ right over the last two axes."""
    return jnp.conj(jnp.swapaxes(left, -1, -2)) @ right


def expand(error_at: ErrorAt, directions: int, places: int) -> Expansion:
    """Σ and its first derivatives where `error_at` is zero steps away."""
    here, still = jnp.zeros(directions), jnp.zeros(places)
    along = jax.vmap(lambda d: jax.jvp(lambda x: error_at(x, still), (here,), (d,))[1])
    error, drift = jax.jvp(lambda w: error_at(here, w), (still,), (jnp.ones(places),))
    slopes = along(jnp.eye(directions))
    gains, vectors = gram_eigenvectors(adjoint_product(error, error))
    top = jnp.max(gains[:, 0])
    return Expansion(error, slopes, drift, gains, vectors, jnp.maximum(top, 1e-300))


def cutting_planes(model: Expansion, directions: Complex[Array, "place short"]) -> Rows:
    """Planes of equations 19 and 20 with Z = v vᴴ, one for each frequency's unit vector v.

    Of half the relative square, (λ / λ_top − 1) / 2: the slopes are then those of the norm's
    logarithm.
    """
    output = jnp.einsum("fos,fs->fo", model.error, directions)
    moved = jnp.einsum("dfos,fs->dfo", model.slopes, directions)
    value = 0.5 * (jnp.sum(jnp.abs(output) ** 2, axis=1) / model.top - 1.0)
    slopes = jnp.sum(jnp.real(jnp.conj(output)[None] * moved), axis=2).T / model.top
    return Rows(slopes, jnp.ones_like(value), -value)


def model_directions(model: Expansion, step: Array) -> Complex[Array, "place short"]:
    """v that attains the local model φ after a step, at each frequency (equation 18)."""
    moved = jnp.einsum("d,dfos->fos", step.astype(model.slopes.dtype), model.slopes)
    change = adjoint_product(model.error, moved)
    gram = adjoint_product(model.error, model.error) + change
    gram = gram + jnp.conj(jnp.swapaxes(change, -1, -2))
    return gram_eigenvectors(gram)[1][:, :, 0]


def curvature(
    error_at: ErrorAt,
    model: Expansion,
    directions: Complex[Array, "plane place short"],
    multipliers: Float[Array, "plane place"],
    stationary: Array,
) -> Float[Array, "direction direction"]:
    """Second derivative of the cuts' combination, relative as the cuts are.

    Besides the curvature of each gain at its frequency it holds how the singular vector turns and
    how a peak (`stationary`) moves along the frequency: with exact multipliers it is the Hessian
    of the Lagrangian of min t, and the steps converge superlinearly.
    """
    count, places = model.slopes.shape[0], model.error.shape[0]
    dtype = model.error.dtype
    # The frequency is one more direction, of each place its own.
    slopes = jnp.concatenate([model.slopes, model.drift[None]])
    moved = jnp.einsum("dfos,pfs->pdfo", slopes, directions)
    first = jnp.einsum("pf,pdfo,pefo->fde", multipliers.astype(dtype), jnp.conj(moved), moved)
    weight = jnp.sum(multipliers, axis=0)
    change = jnp.einsum("fos,dfot->dfst", jnp.conj(model.error), slopes)
    change = change + jnp.conj(jnp.swapaxes(change, -1, -2))
    turned = jnp.einsum("fsk,dfst,ft->dfk", jnp.conj(model.vectors), change, model.vectors[:, :, 0])
    apart = jnp.maximum(model.gains[:, :1] - model.gains, _LEAST_SEPARATION * model.top)
    share = (weight[:, None] / apart).at[:, 0].set(0.0)
    second = jnp.einsum("fk,dfk,efk->fde", share.astype(dtype), jnp.conj(turned), turned)
    blocks = jnp.real(first + second)

    # What Σ's own second derivative adds, from one scalar with frozen weights.
    output = jnp.einsum("fos,pfs->pfo", model.error, directions)
    frozen = jnp.einsum("pf,pfo,pfs->fos", multipliers.astype(dtype), jnp.conj(output), directions)

    def weighted(x, w):
        return jnp.sum(jnp.real(frozen * error_at(x, w)))

    here, still = jnp.zeros(count), jnp.zeros(places)
    tangents = (jnp.eye(count + 1, count), jnp.zeros((count + 1, places)).at[count].set(1.0))
    bent = jax.vmap(
        lambda x, w: jax.jvp(jax.grad(weighted, argnums=(0, 1)), (here, still), (x, w))[1]
    )(*tangents)
    total = jnp.sum(blocks[:, :count, :count], axis=0) + bent[0][:count]
    cross = blocks[:, :count, count] + bent[1][:count].T
    along = blocks[:, count, count] + bent[1][count]
    # A maximum's own second derivative is negative; elsewhere the frequency stays.
    peaked = stationary & (along < -_LEAST_PEAK * model.top * weight)
    pull = jnp.where(peaked, -1.0 / jnp.where(peaked, along, -1.0), 0.0)
    total = total + jnp.einsum("f,fd,fe->de", pull, cross, cross)
    return 0.5 * (total + total.T) / model.top
