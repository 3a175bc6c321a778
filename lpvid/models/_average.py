"""Alignment of models in a common state basis, and averages of many."""

import abc
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool

from lpvid._linalg import continuous_sylvester, stein
from lpvid.models._realisations import balance, balancing, gramians
from lpvid.models._state_space import StateSpace


@jax.jit
def align(system: StateSpace, reference: StateSpace) -> StateSpace:
    """The same model in the state basis nearest to that of a reference model.

    The states are changed by the general T that minimises ‖O_r T − O‖² + ‖T R − R_r‖², with O and
    R the infinite extended observability and reachability matrices of the model and (index r) of
    the reference in balanced states. The normal equations P T + T Q = O_rᵀ O + R_r Rᵀ hold only
    Gramians and cross-Gramians, so no long matrix is formed; continuous time has integrals in the
    place of the sums. A model similar to the reference gets exactly the reference's matrices.

    Differentiable in the model; NaN where one of the two is unstable.

    Args:
        system: stable model, with any batch axes.
        reference: stable, minimal model of the same sizes and sample time.

    Raises:
        ValueError: sizes or sample times differ.

    Example:
        >>> from lpvid.models import StateSpace, align
        >>> reference = StateSpace([[-1.0]], [[1.0]], [[1.0]])
        >>> round(align(reference.transform([[5.0]]), reference).B.item(), 6)
        1.0
    """
    _check_alike(system, reference)
    forward, backward, _ = balancing(reference)
    A, B, C = forward @ reference.A @ backward, forward @ reference.B, reference.C @ backward
    _, observability = gramians(StateSpace(A, B, C, dt=reference.dt))
    controllability, _ = gramians(system)
    cross = stein if reference.is_discrete else continuous_sylvester
    right = cross(A.mT, system.A, C.mT @ system.C) + cross(A, system.A.mT, B @ system.B.mT)
    to_balanced = continuous_sylvester(-observability, -controllability, right)
    return system.transform(backward @ to_balanced)


def _check_alike(system: StateSpace, reference: StateSpace) -> None:
    sizes, wanted = ((s.nx, s.nu, s.ny, s.dt) for s in (system, reference))
    if sizes != wanted:
        raise ValueError(
            f"The model has (nx, nu, ny, dt) = {sizes}, the reference {wanted}: they must agree. "
            f"Identify both with one order, or reduce one of them first."
        )


class AbstractAverage(eqx.Module):
    """How many models are made one."""

    @abc.abstractmethod
    def combine(self, systems: StateSpace) -> tuple[StateSpace, Bool[Array, " model"]]:
        """The models, one batch axis, in one basis, and which of them are usable."""


class NaiveAverage(AbstractAverage):
    """Entrywise mean of sign-fixed balanced realisations, as in 001.

    Only to reproduce that paper: where Hankel singular values nearly agree, noise rotates the
    balanced basis, and the mean is worse than the single models.
    """

    def combine(self, systems: StateSpace) -> tuple[StateSpace, Bool[Array, " model"]]:
        """Balance each model."""
        balanced, _ = balance(systems)
        return balanced, _usable(balanced)


class AlignedAverage(AbstractAverage):
    """Entrywise mean after alignment of each model to a reference basis.

    Attributes:
        reference: model whose basis is used; when left out, the balanced basis of the first usable
            model, and in later rounds that of the mean so far.
        rounds: number of alignments when no reference is given, at least one.
    """

    reference: StateSpace | None = None
    rounds: int = eqx.field(static=True, default=2)

    def __check_init__(self):
        if self.rounds < 1:
            raise ValueError(f"rounds is {self.rounds}; at least one alignment is needed.")

    def combine(self, systems: StateSpace) -> tuple[StateSpace, Bool[Array, " model"]]:
        """Align each model."""
        if self.reference is not None:
            aligned = align(systems, self.reference)
            return aligned, _usable(aligned)
        balanced, _ = balance(systems)
        usable = _usable(balanced)
        first = jnp.argmax(usable)
        reference = jax.tree.map(lambda leaf: leaf[first], balanced)
        aligned = align(systems, reference)
        for _ in range(self.rounds - 1):
            reference, _ = balance(_mean(aligned, usable))
            aligned = align(systems, reference)
        return aligned, usable


_ALIGNED = AlignedAverage()


def average(
    systems: StateSpace | Sequence[StateSpace], method: AbstractAverage = _ALIGNED
) -> StateSpace:
    """One model from many of the same system, such as the runs of a Monte Carlo study.

    Models that are not finite or not stable have no Gramians and are left out.

    Args:
        systems: sequence of models, or one with batch axes (all are averaged).
        method: `AlignedAverage()`, or `NaiveAverage()` to reproduce 001.

    Raises:
        ValueError: no model, models of different sizes, or none usable (not checked under `jit`,
            where the result is then NaN).

    Example:
        >>> from lpvid.models import StateSpace, average
        >>> first = StateSpace([[-1.0]], [[1.0]], [[1.0]])
        >>> round(average([first, first.transform([[-3.0]])]).dc_gain().item(), 6)
        1.0
    """
    if isinstance(systems, StateSpace):
        if not systems.batch_shape:
            raise ValueError("systems is a single model; give a sequence, or one with batch axes.")
        stacked = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[-2:]), systems)
    else:
        if not systems:
            raise ValueError("systems is empty; at least one model is needed.")
        for system in systems:
            _check_alike(system, systems[0])
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *systems)
    aligned, usable = method.combine(stacked)
    if not isinstance(usable, Tracer) and not np.any(usable):
        raise ValueError(
            "None of the models is stable and finite, so none can be put in a common basis; "
            "stabilise the estimates first."
        )
    return _mean(aligned, usable)


def _usable(systems: StateSpace) -> Bool[Array, " model"]:
    finite = [jnp.all(jnp.isfinite(leaf), axis=(-2, -1)) for leaf in jax.tree.leaves(systems)]
    return jnp.all(jnp.stack(finite), axis=0)


@jax.jit
def _mean(systems: StateSpace, usable: Bool[Array, " model"]) -> StateSpace:
    mask = usable[:, None, None]
    count = jnp.sum(usable.astype(float))
    return jax.tree.map(lambda leaf: jnp.sum(jnp.where(mask, leaf, 0.0), axis=0) / count, systems)
