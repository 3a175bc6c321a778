"""Connections of LPV models with each other and with LTI models."""

import math
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from lpvid.models._connected import (
    AbstractConnection,
    ConnectedStructure,
    Feedback,
    FixedStructure,
    Parallel,
    Series,
)
from lpvid.models._gray_box_lpv import GrayBoxLPV
from lpvid.models._hull import ConvexHull
from lpvid.models._lpv import LPVStateSpace
from lpvid.models._scheduling import JoinedBasis
from lpvid.models._state_space import StateSpace

Model: TypeAlias = StateSpace | LPVStateSpace | GrayBoxLPV
Connected: TypeAlias = StateSpace | LPVStateSpace


def series(first: Model, second: Model) -> Connected:
    """The second model driven by the output of the first.

    Of LPV models, and of LPV and LTI ones, the result is an `LPVStateSpace` whose structure holds
    both: it is frozen, simulated, refined and saved as any other. κ is that of both models, and the
    model is one inside of both hulls; an LTI part has no parameters. States are those of the first
    model, then those of the second. Composes with `jit`, `vmap` and `grad`.

    Args:
        first: `StateSpace` or `LPVStateSpace` that takes the input.
        second: of the same sample time.

    Returns:
        A `StateSpace` if both are, else an `LPVStateSpace`.

    Raises:
        ValueError: channels, sample times or scheduling variables do not fit.

    Example:
        >>> lag = StateSpace([[-1.0]], [[1.0]], [[3.0]])
        >>> series(lag, lag).dc_gain().item()
        9.0
    """
    return _connected(Series(), first, second)


def parallel(first: Model, second: Model, sign: int = 1) -> Connected:
    """Both models driven by one input, their outputs added (or subtracted).

    Args:
        first: `StateSpace` or `LPVStateSpace`; see `series`.
        second: of the same sizes and sample time.
        sign: of the second model's output, 1 or −1.

    Returns:
        A `StateSpace` if both are, else an `LPVStateSpace`.

    Raises:
        ValueError: as for `series`; or the sign is neither 1 nor −1.

    Example:
        >>> lag = StateSpace([[-1.0]], [[1.0]], [[3.0]])
        >>> parallel(lag, lag).dc_gain().item()
        6.0
    """
    return _connected(Parallel(sign), first, second)


def feedback(forward: Model, back: Model, sign: int = -1) -> Connected:
    """A closed loop: the output of `forward` returns to its input through `back`.

    Args:
        forward: `StateSpace` or `LPVStateSpace` from the loop's input to its output; see `series`.
        back: from that output to what is added to the input.
        sign: −1 for negative feedback, or 1.

    Returns:
        A `StateSpace` if both are, else an `LPVStateSpace`.

    Raises:
        ValueError: as for `series`; the sign is neither −1 nor 1; or, with two LTI models, the
            feedthroughs leave the loop without solution (an LPV model is not finite there).

    Example:
        >>> lag = StateSpace([[-1.0]], [[1.0]], [[3.0]])
        >>> feedback(lag, StateSpace([[-9.0]], [[9.0]], [[1.0]])).dc_gain().item()
        0.75
    """
    return _connected(Feedback(sign), forward, back)


def _connected(connection: AbstractConnection, first: Model, second: Model) -> Connected:
    if isinstance(first, StateSpace) and isinstance(second, StateSpace):
        return connection.connect(first, second)
    first, second = (
        model.lpv if isinstance(model, GrayBoxLPV) else model for model in (first, second)
    )
    dts = first.dt, second.dt
    if not math.isclose(*dts, rel_tol=1e-9):
        raise ValueError(
            f"Cannot connect models with dt = {dts[0]} s and {dts[1]} s: convert one of them with "
            "discretise()."
        )
    structure = ConnectedStructure(connection, _structure(first), _structure(second))
    varying = [model for model in (first, second) if isinstance(model, LPVStateSpace)]
    model = varying[0]
    basis, coefficients = model.basis, model.coefficients
    low, high, hull = model.kappa_low, model.kappa_high, model.hull
    if len(varying) == 2:
        other = varying[1]
        if model.n_scheduling != other.n_scheduling:
            raise ValueError(
                f"Cannot connect models of {model.n_scheduling} and {other.n_scheduling} "
                "scheduling variables: κ must be the same for both."
            )
        basis, coefficients = _joined(model, other)
        low, high = jnp.maximum(low, other.kappa_low), jnp.minimum(high, other.kappa_high)
        if not isinstance(low, Tracer) and np.any(np.asarray(low) > np.asarray(high)):
            raise ValueError("Cannot connect models whose ranges of κ have nothing in common.")
        if model.hull is not None or other.hull is not None:
            hull = _hull(model).intersection(_hull(other))
    connected = LPVStateSpace(structure, basis, coefficients, low, high, hull)
    # Channels are compared as a frozen model is built; its shapes are enough.
    jax.eval_shape(connected.at, low)
    return connected


def _structure(model: Connected):
    if isinstance(model, LPVStateSpace):
        return model.structure
    if model.batch_shape:
        raise ValueError("Cannot connect an LPV model to a model with batch axes; use jax.vmap.")
    return FixedStructure(model)


def _joined(first: LPVStateSpace, second: LPVStateSpace):
    """Basis and coefficients of both models' parameters."""
    same = eqx.tree_equal(first.basis, second.basis)
    if not isinstance(same, Tracer) and bool(same):
        return first.basis, jnp.concatenate([first.coefficients, second.coefficients], axis=1)
    columns = first.coefficients.shape[1]
    above = jnp.pad(first.coefficients, ((0, 0), (0, second.coefficients.shape[1])))
    below = jnp.pad(second.coefficients, ((0, 0), (columns, 0)))
    return JoinedBasis(first.basis, second.basis), jnp.concatenate([above, below])


def _hull(model: LPVStateSpace) -> ConvexHull:
    if model.hull is not None:
        return model.hull
    half = jnp.where(model.kappa_high > model.kappa_low, model.kappa_high - model.kappa_low, 2.0)
    normals = jnp.diag(2.0 / half)
    normals = jnp.concatenate([normals, -normals])
    ends = jnp.concatenate([2.0 * model.kappa_high / half, -2.0 * model.kappa_low / half])
    return ConvexHull(normals, ends)
