"""How a computation ended: a value with advice in it, not an exception."""

import equinox as eqx
from jaxtyping import Array, Float, Int


class Status(eqx.Enumeration):
    """Outcome of a computation; an integer code under `jit` and `vmap`, a sentence when printed.

    Example:
        >>> Status[Status.successful]
        'Successful.'
    """

    successful = "Successful."
    max_steps = (
        "The iteration limit was reached before the tolerance. The result is the best seen. "
        "Raise the limit, loosen the tolerance or give a better start."
    )
    nonfinite = (
        "A non-finite number appeared. Look for non-finite samples, unstable starts or a badly "
        "scaled problem."
    )
    ill_conditioned = (
        "The data matrix is nearly rank deficient. The input excites too little, or order and "
        "block rows are too large for this record: excite every input, or lower them."
    )
    unstable = (
        "The estimated model is unstable. Lower the order, raise the block rows, or ask for "
        "stabilisation where the method has it."
    )
    constant_channel = (
        "A channel is constant, so nothing can be learned from it. Excite the input, check the "
        "output's sensor, or leave the channel out with data.select."
    )
    no_stable_gain = (
        "The Riccati equation of the innovation gain has no stabilising solution, so the gain is "
        "zero. Take more samples or more block rows, or stabilise the model."
    )
    poor_match = (
        "The structured model is no closer to the black box than no model at all. Give more or "
        "better starts, another structure, or a black box that is stable."
    )
    uncertified = (
        "The norm may still fall: no certificate of a minimum was found within the steps. Raise "
        "HinfMatching(bundle_steps=...) or its tolerance, or give a better start."
    )
    at_bound = (
        "A parameter ended at its bound; its uncertainty is not given, that of the others holds "
        "for this value. Widen the bound if the data are to decide."
    )
    unidentified = (
        "The records say nothing about some parameters or combinations of them. Fix or tie them, "
        "or excite what they act on; their intervals are infinite."
    )
    overflow = (
        "The simulation grows without bound from this start. Give a stable start, shorter records, "
        "Innovation() with a gain that makes the predictor stable, or OutputError(shooting=...)."
    )
    discontinuous = (
        "The pieces of the shooting search do not meet, so no simulation of a whole record stands "
        "behind the fit. Raise max_steps, choose longer or shorter pieces, or give a better start."
    )
    indefinite = (
        "The records alone give an indefinite mass, damping or stiffness matrix; the nearest "
        "definite one is returned. Check signs, the pairing of inputs with outputs, and the length "
        "of the records."
    )
    unstable_predictor = (
        "K makes the predictor unstable: its predictions never forget the first state, the cost "
        "looks lower than it is, and intervals mean nothing. Start from a gain that makes it "
        "stable, take longer records, or refine with OutputError()."
    )
    infeasible = (
        "The margins asked for were not reached within the bounds; the design nearest to them is "
        "returned. Widen the bounds, give other starts, or ask for less."
    )
    close_poles = (
        "Poles nearly coincide, so that single modes mean little: their parts cancel. Reduce with "
        "balanced_truncation, or identify at a lower order."
    )
    infinite_norm = (
        "The system has a pole on the stability boundary, so its norm is infinite. Remove the "
        "marginal mode or add damping."
    )
    l_infinity = (
        "The system is unstable: this is the L-infinity norm, the peak of its frequency response, "
        "not an input-output gain. Stabilise the system if a gain is wanted."
    )


def is_successful(status: Status):
    """Whether a status says success (a boolean array under `jit` and `vmap`).

    Args:
        status: how a computation ended.

    Example:
        >>> bool(is_successful(Status.max_steps))
        False
    """
    return status == Status.successful


class Solution(eqx.Module):
    """Outcome of one minimisation.

    Attributes:
        value: the best point seen.
        cost: its cost, infinite where it is not finite.
        status: how the search ended.
        steps: how many steps it took.
    """

    value: Float[Array, " parameter"]
    cost: Float[Array, ""]
    status: Status
    steps: Int[Array, ""]
