"""State bases that are coherent along κ, for black boxes without a structure."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from lpvid.interpolate._local import Points, operating_points
from lpvid.interpolate._sections import (
    Section,
    assemble,
    coherent_bases,
    matched,
    sections_of,
)
from lpvid.models import StateSpace, align, balance


def balance_along(models: Sequence[StateSpace]) -> list[StateSpace]:
    """Balanced realisations of models ordered along κ, each state signed as its neighbour's.

    The naive way of 001. `modal_along` and `align_along` give bases that can be interpolated.

    Args:
        models: stable, minimal models of one size, in any bases.

    Raises:
        ValueError: for an unstable model, which has no balanced form.

    Example:
        >>> models = [StateSpace([[-k]], [[k]], [[-1.0]]) for k in (1.0, 2.0)]
        >>> [model.A.round(6).item() for model in balance_along(models)]
        [-1.0, -2.0]
    """
    balanced = [balance(model)[0] for model in models]
    for index in range(1, len(balanced)):
        balanced[index] = _same_signs(balanced[index], balanced[index - 1])
    return balanced


def _same_signs(model: StateSpace, neighbour: StateSpace) -> StateSpace:
    """Flip the states of a balanced model whose input and output rows point the other way."""
    agreement = jnp.sum(model.B * neighbour.B, axis=1) + jnp.sum(model.C * neighbour.C, axis=0)
    signs = jnp.where(agreement < 0, -1.0, 1.0)
    return StateSpace(
        signs[:, None] * model.A * signs[None],
        signs[:, None] * model.B,
        model.C * signs[None],
        model.D,
        model.dt,
    )


def align_along(models: Sequence[StateSpace], kappas: ArrayLike | Sequence) -> list[StateSpace]:
    """The same models in state bases that go on from each other, starting from a balanced one.

    From the middle point on, each model is put by `align` in the basis nearest to that of its
    nearest neighbour already done: bases drift along κ as the models do, also where balanced ones
    jump. Responses are compared with a forgetting factor, one over the models' median frequency:
    over long times those of two lightly damped modes a few bandwidths apart have nothing in common.
    For models without distinct modes; where there are modes, `modal_along` is far closer.

    Differentiable in the models.

    Args:
        models: minimal models of one size, in any bases, none growing faster than it is forgotten.
        kappas: where they were identified, shape (n_points,) or (n_points, n_scheduling).

    Raises:
        ValueError: models of different sizes; one that is too unstable to be aligned.

    Example:
        >>> models = [StateSpace([[-k]], [[10.0 * k]], [[-0.1]]) for k in (1.0, 2.0)]
        >>> [round(model.A.item(), 6) for model in align_along(models, [0.0, 1.0])]
        [-1.0, -2.0]
    """
    points = _checked(models, kappas)
    frequencies = jnp.stack([jax.lax.stop_gradient(model).modes().frequency for model in models])
    rate = jnp.median(frequencies)
    forgetful = [_shifted(model, -rate) for model in models]
    unstable = [
        index
        for index, model in enumerate(forgetful)
        if not isinstance(model.A, Tracer) and not bool(model.is_stable())
    ]
    if unstable:
        raise ValueError(
            f"models: too unstable at point(s) {unstable} to be aligned; stabilise them, or take "
            "modal_along."
        )
    first, path = walk(points)
    aligned = {first: balance(forgetful[first])[0]}
    for index, neighbour in path:
        aligned[index] = align(forgetful[index], aligned[neighbour])
    return [_shifted(aligned[index], rate) for index in range(len(models))]


def _shifted(model: StateSpace, rate: Float[Array, ""]) -> StateSpace:
    """The model whose responses are multiplied by exp(rate · time)."""
    if model.is_discrete:
        A = jnp.exp(rate * model.dt) * model.A
    else:
        A = model.A + rate * jnp.eye(model.nx)
    return StateSpace(A, model.B, model.C, model.D, model.dt)


def modal_along(models: Sequence[StateSpace], kappas: ArrayLike | Sequence) -> list[StateSpace]:
    r"""The same models as sums of second-order sections that are coherent along κ.

    Every model is split into its modes, pairs of poles with $s^2 + a_1 s + a_0 = 0$ (real poles are
    paired from the slowest; with an odd order the one next to its neighbour's, at first the
    fastest, is left single). Modes are matched from point to point by frequency, damping and shape,
    also where they cross, and written with the block $[[0, w], [-a_0 / w, -a_1]]$, w one frequency
    for each mode over all points. The two free numbers of each mode's basis are chosen for B and C
    next to the neighbour's. Interpolated entry by entry, a mode's frequency and damping are smooth
    in κ, whether its poles are complex or real, and between two stable points (linearly in κ) every
    frozen model is stable. Where a complex pair turns real among other real poles, the pairing may
    change from one point to the next, and the entries are not smooth there: look at
    `leave_one_out`, and use `align_along` if it is poor.

    Lists and sorts numbers: runs eagerly, outside `jit`, `vmap` and `grad`.

    Args:
        models: of one size, in any bases, stable or not, without equal poles in different modes.
        kappas: where they were identified, shape (n_points,) or (n_points, n_scheduling).

    Raises:
        ValueError: models of different sizes, traced ones, or one whose modes cannot be told apart.

    Example:
        >>> A = [np.array([[0.0, 1.0], [-k, -0.1]]) for k in (1.0, 4.0)]
        >>> models = [StateSpace(a, [[0.0], [1.0]], [[1.0, 0.0]]) for a in A]
        >>> models[1] = models[1].transform([[1.0, 2.0], [3.0, 4.0]])
        >>> [round(model.A[1, 0].item(), 6) for model in modal_along(models, [1.0, 4.0])]
        [-0.707107, -2.828427]
    """
    points = _checked(models, kappas)
    if any(isinstance(model.A, Tracer) for model in models):
        raise ValueError("models: modal_along needs numbers; call it outside jit, vmap and grad.")
    first, path = walk(points)
    found: dict[int, list[Section]] = {first: sections_of(models[first], None, first)}
    for index, neighbour in path:
        sections = sections_of(models[index], found[neighbour], index)
        found[index] = matched(sections, found[neighbour])
    ordered = [found[index] for index in range(len(models))]
    for mode in range(len(ordered[0])):
        coherent_bases([sections[mode] for sections in ordered], first, path)
    return [assemble(each, model) for each, model in zip(ordered, models, strict=True)]


def _checked(models: Sequence[StateSpace], kappas: ArrayLike | Sequence) -> Points:
    sizes = {(m.nx, m.nu, m.ny, m.dt, m.batch_shape) for m in models}
    if len(sizes) != 1 or models[0].batch_shape:
        raise ValueError(
            "models: single models of one size and sample time are needed; got (order, inputs, "
            f"outputs, dt, batch axes) {sorted(sizes)}."
        )
    return operating_points(kappas, len(models))


def walk(points: Points) -> tuple[int, list[tuple[int, int]]]:
    """A middle point, and the others in order of their distance from those done (Prim's tree).

    Returns:
        The first point, then (point, its nearest one done before).
    """
    low, high = points.min(axis=0), points.max(axis=0)
    scaled = (points - low) / np.where(high > low, high - low, 1.0)
    first = int(np.argmin(np.sum((scaled - scaled.mean(axis=0)) ** 2, axis=1)))
    apart = np.sum((scaled[:, None] - scaled[None]) ** 2, axis=2)
    done, path = [first], []
    left = [index for index in range(len(points)) if index != first]
    while left:
        distances = apart[np.ix_(left, done)]
        row, column = np.unravel_index(np.argmin(distances), distances.shape)
        index = left.pop(int(row))
        path.append((index, done[int(column)]))
        done.append(index)
    return first, path
