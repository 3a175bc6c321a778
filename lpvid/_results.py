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
        "The estimated model is unstable. Ask for stabilisation, lower the order, or use "
        "past outputs as instruments."
    )
    poor_match = (
        "The structured model is no closer to the black box than no model at all. Give more or "
        "better starts, another structure, or a black box that is stable."
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
