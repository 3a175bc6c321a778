"""Balanced truncation and its variant that keeps the static gain."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float

from lpvid.models import StateSpace, balancing
from lpvid.reduce._hankel import hankel_singular_values
from lpvid.reduce._spectral_split import spectral_split

# Below this share of the largest, a Hankel singular value belongs to a state that is not there.
_NOTHING = 1e-12


class Reduction(eqx.Module):
    """A model of fewer states and how far it can be from the original.

    Attributes:
        model: the reduced model.
        singular_values: Hankel singular values of the original, largest first (of its stable part,
            where the unstable one is kept); `lpvid.plot.scree` draws them.
        bound: largest possible H-infinity norm of the error, twice the sum of the Hankel singular
            values left out; output unit over input unit.
    """

    model: StateSpace
    singular_values: Float[Array, "*batch stable"]
    bound: Float[Array, "*batch"]


def balanced_truncation(
    model: StateSpace, order: int, *, match_dc: bool = False, keep_unstable: bool = False
) -> Reduction:
    """Reduce a model to the `order` balanced states that pass most from input to output.

    Square-root method (A. J. Laub et al., IEEE Trans. Autom. Control 32 (1987) 115-122). The
    reduced model is stable where the Hankel singular values on both sides of the cut differ, and
    ‖G − G_r‖∞ ≤ 2 (σ_{r+1} + … + σ_n), continuous or discrete (D. Enns, CDC 1984; U. Al-Saggaf and
    G. Franklin, IEEE Trans. Autom. Control 32 (1987) 815-819). With `match_dc` the states left out
    are not set to zero but to rest (singular perturbation: Y. Liu and B. Anderson, Int. J. Control
    50 (1989) 1379-1405): exact at frequency zero instead of at infinity (continuous), with the same
    bound, and D other than the original's.

    Works under `jit`, `vmap` and on batches (`order` static) and differentiates as `balance` does:
    where the Gramians' eigenvalues and the Hankel singular values are distinct; the values and the
    bound wherever the Hankel singular values are. With `keep_unstable` it needs numbers.

    Args:
        model: continuous or discrete model, with or without D, any leading batch axes.
        order: number of states kept, those of the unstable part included.
        match_dc: keep the static gain; of the whole model, also with an unstable part kept.
        keep_unstable: reduce only the stable part and add the unstable one (poles on the stability
            boundary included) to the result as it is. One model, no batch.

    Returns:
        The reduced model, Hankel singular values and the error bound.

    Raises:
        ValueError: an order outside 1 … nx; (outside `jit` only) an unstable model without
            `keep_unstable`, more unstable poles than the order, or an order beyond that of a
            minimal realisation. Under `jit` an unstable model gives NaN.

    Example:
        >>> from lpvid.models import StateSpace
        >>> from lpvid.reduce import balanced_truncation
        >>> model = StateSpace([[-1.0, 0.0], [0.0, -10.0]], [[1.0], [1.0]], [[1.0, 0.1]])
        >>> reduced = balanced_truncation(model, 1, match_dc=True)
        >>> round(reduced.model.dc_gain().item(), 6), reduced.bound.item() < 0.01
        (1.01, True)
    """
    if not 1 <= order <= model.nx:
        raise ValueError(f"order is {order}; keep between 1 and the model's {model.nx} states.")
    if keep_unstable:
        return _beside_unstable(model, order, match_dc)
    if not isinstance(model.A, Tracer) and not bool(jnp.all(model.is_stable())):
        raise ValueError(
            "The model has poles on or beyond the stability boundary, so it has no Gramians. Keep "
            "its unstable part with keep_unstable=True, or stabilise it."
        )
    reduction = _reduce(model, order, match_dc)
    hankel = reduction.singular_values
    if not isinstance(hankel, Tracer):
        _check_minimal(hankel, order)
    return reduction


def _check_minimal(hankel: Array, order: int) -> None:
    present = jnp.min(jnp.sum(hankel > _NOTHING * hankel[..., :1], axis=-1))
    if order > int(present):
        raise ValueError(
            f"order is {order}, but only {int(present)} states take part in passing input to "
            f"output (Hankel singular values above {_NOTHING:g} of the largest). Lower the order."
        )


def _beside_unstable(model: StateSpace, order: int, match_dc: bool) -> Reduction:
    if isinstance(model.A, Tracer) or model.batch_shape:
        raise ValueError(
            "keep_unstable needs one model of numbers: the size of its unstable part depends on "
            "them. Call it outside jit, vmap and grad, and on each model of a batch."
        )
    stable, unstable = spectral_split(model)
    if unstable.nx == 0:
        return balanced_truncation(model, order, match_dc=match_dc)
    kept = order - unstable.nx
    if kept < min(1, stable.nx):
        raise ValueError(
            f"order is {order}, but {unstable.nx} poles are on or beyond the stability boundary "
            f"and are all kept; ask for {unstable.nx + min(1, stable.nx)} or more."
        )
    if stable.nx == 0:
        return Reduction(model, jnp.zeros(0), jnp.asarray(0.0))
    part = balanced_truncation(stable, kept, match_dc=match_dc)
    return Reduction(part.model + unstable, part.singular_values, part.bound)


@partial(jax.jit, static_argnums=(1, 2))
def _reduce(model: StateSpace, order: int, match_dc: bool) -> Reduction:
    forward, backward, _ = balancing(model)
    rows, columns = forward[..., :order, :], backward[..., :, :order]
    A, B, C, D = model.A, model.B, model.C, model.D
    if match_dc:
        # G in 1/s (1/(z - 1)) has the same Gramians (up to scale): truncate it and turn back.
        shift = jnp.broadcast_to(jnp.eye(model.nx), A.shape) if model.is_discrete else 0.0 * A
        F, B, C, D = _reciprocal(A - shift, B, C, D)
        F, B, C, D = _reciprocal(rows @ F @ columns, rows @ B, C @ columns, D)
        A = F + shift[..., :order, :order]
    else:
        A, B, C = rows @ A @ columns, rows @ B, C @ columns
    hankel = hankel_singular_values(model)
    bound = 2.0 * jnp.sum(hankel[..., order:], axis=-1)
    return Reduction(StateSpace(A, B, C, D, dt=model.dt), hankel, bound)


def _reciprocal(F, B, C, D):
    """G(1/p) of G(s) = D + C (s - F)⁻¹ B; its own inverse."""
    inverse = jnp.linalg.inv(F)
    states = inverse @ B
    return inverse, states, -C @ inverse, D - C @ states
