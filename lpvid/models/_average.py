"""Alignment of models in a common state basis, and averages of many."""

import abc
import warnings
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float

from lpvid._linalg import continuous_sylvester, excess_growth, excess_radius, stein
from lpvid._solve import least_squares
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

    Where one of the two is unstable, both are weighted by e^{−αt} (ρ^{−k}) in these matrices, by
    as much as both need to decay: similar models decay alike, so the change of basis stays exact.

    Differentiable in the model, α taken as a constant; works under `jit` and `vmap`.

    Args:
        system: model with any batch axes.
        reference: minimal model of the same sizes and sample time.

    Raises:
        ValueError: sizes or sample times differ.

    Example:
        >>> from lpvid.models import StateSpace, align
        >>> reference = StateSpace([[-1.0]], [[1.0]], [[1.0]])
        >>> round(align(reference.transform([[5.0]]), reference).B.item(), 6)
        1.0
    """
    _check_alike(system, reference)
    decaying, fixed = _decaying(system, reference)
    forward, backward, _ = balancing(fixed)
    A, B, C = forward @ fixed.A @ backward, forward @ fixed.B, fixed.C @ backward
    _, observability = gramians(StateSpace(A, B, C, dt=fixed.dt))
    controllability, _ = gramians(decaying)
    cross = stein if fixed.is_discrete else continuous_sylvester
    right = cross(A.mT, decaying.A, C.mT @ decaying.C) + cross(A, decaying.A.mT, B @ decaying.B.mT)
    to_balanced = continuous_sylvester(-observability, -controllability, right)
    return system.transform(backward @ to_balanced)


def _decaying(system: StateSpace, reference: StateSpace) -> tuple[StateSpace, StateSpace]:
    """Each model and the reference, weighted in time by one factor such that both decay."""
    excess = excess_radius if reference.is_discrete else excess_growth
    factor = jnp.maximum(*jnp.broadcast_arrays(excess(system.A), excess(reference.A)))
    factor = factor[..., None, None]

    def damped(model: StateSpace) -> StateSpace:
        A = jnp.broadcast_to(model.A, (*factor.shape[:-2], *model.A.shape[-2:]))
        identity = jnp.broadcast_to(jnp.eye(model.nx), A.shape)
        A = A / factor if model.is_discrete else A - factor * identity
        return StateSpace(A, model.B, model.C, model.D, dt=model.dt)

    return damped(system), damped(reference)


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
        """The average of models along one batch axis, and which of them were usable."""


class NaiveAverage(AbstractAverage):
    """Entrywise mean of sign-fixed balanced realisations, as in 001; of stable models only.

    Only to reproduce that paper: where Hankel singular values nearly agree, noise rotates the
    balanced basis, and the mean is worse than the single models.

    Example:
        >>> from lpvid.models import NaiveAverage, StateSpace, average
        >>> systems = [StateSpace([[-1.0]], [[b]], [[1.0]]) for b in (4.0, -9.0)]
        >>> round(average(systems, NaiveAverage()).B.item(), 6)
        2.5
    """

    def combine(self, systems: StateSpace) -> tuple[StateSpace, Bool[Array, " model"]]:
        """Balance each model."""
        balanced, _ = balance(systems)
        usable = _finite(balanced)
        return _mean(balanced, usable), usable


class AlignedAverage(AbstractAverage):
    """Entrywise mean after alignment of each model to a reference basis.

    Attributes:
        reference: model whose basis is used; when left out, the balanced basis of the first usable
            model, and in later rounds that of the mean so far.
        rounds: number of alignments when no reference is given, at least one.
        keep_unstable: whether unstable models count: for plants that are unstable themselves.

    Raises:
        ValueError: there is to be no round.

    Example:
        >>> from lpvid.models import AlignedAverage, StateSpace, average
        >>> unstable = [StateSpace([[0.1]], [[b]], [[1.0 / b]]) for b in (1.0, -2.0)]
        >>> round(average(unstable, AlignedAverage(keep_unstable=True)).A.item(), 6)
        0.1
    """

    reference: StateSpace | None = None
    rounds: int = eqx.field(static=True, default=2)
    keep_unstable: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        if self.rounds < 1:
            raise ValueError(f"rounds is {self.rounds}; at least one alignment is needed.")

    def combine(self, systems: StateSpace) -> tuple[StateSpace, Bool[Array, " model"]]:
        """Align each model and take the mean."""
        usable = _finite(systems)
        if not self.keep_unstable:
            usable = usable & systems.is_stable()
        if self.reference is not None:
            aligned = align(systems, self.reference)
            usable = usable & _finite(aligned)
            return _mean(aligned, usable), usable
        first = jnp.argmax(usable)
        mean = jax.tree.map(lambda leaf: leaf[first], systems)
        for _ in range(self.rounds):
            aligned = align(systems, _balanced(mean))
            usable = usable & _finite(aligned)
            mean = _mean(aligned, usable)
        return mean, usable


class ResponseAverage(AbstractAverage):
    """One model fitted to the mean of the models' frequency responses.

    No basis is involved in the mean, so models need not be alike enough to be aligned well. The
    fit begins at the aligned average and moves all of its entries by least squares; D stays zero
    where it is zero in all models. Where the fit fails or loses stability the aligned average is
    returned, with a warning (outside `jit`).

    Attributes:
        omega: frequencies, rad/s; when left out, `frequencies` of them around the poles of the
            aligned average, with its resonances.
        weights: of each frequency and channel (frequency, ny, nu), to go with `omega`: reciprocal
            standard deviations, say. Reciprocal RMS of each channel when left out.
        frequencies: size of the grid that is made.
        max_steps: limit on the steps of the fit.
        keep_unstable: whether unstable models count: for plants that are unstable themselves.

    Raises:
        ValueError: a count is too small, or there are weights without frequencies of their own.

    Example:
        >>> from lpvid.models import ResponseAverage, StateSpace, average
        >>> systems = [StateSpace([[-1.0]], [[b]], [[1.0]]) for b in (1.0, 3.0)]
        >>> round(average(systems, ResponseAverage()).dc_gain().item(), 6)
        2.0
    """

    omega: Float[Array, " frequency"] | None
    weights: Float[Array, "frequency ny nu"] | None
    frequencies: int = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)
    keep_unstable: bool = eqx.field(static=True)

    def __init__(
        self,
        *,
        omega: ArrayLike | Sequence | None = None,
        weights: ArrayLike | None = None,
        frequencies: int = 100,
        max_steps: int = 50,
        keep_unstable: bool = False,
    ):
        for name, count in (("frequencies", frequencies), ("max_steps", max_steps)):
            if count < 1:
                raise ValueError(f"{name}: at least 1 is needed, got {count}.")
        self.omega = None if omega is None else jnp.atleast_1d(jnp.asarray(omega, float))
        self.weights = None if weights is None else jnp.asarray(weights, float)
        if weights is not None and omega is None:
            raise ValueError("weights: give the frequencies they belong to, omega=.")
        self.frequencies, self.max_steps = frequencies, max_steps
        self.keep_unstable = keep_unstable

    def combine(self, systems: StateSpace) -> tuple[StateSpace, Bool[Array, " model"]]:
        """Average the responses and fit a model."""
        start, usable = AlignedAverage(keep_unstable=self.keep_unstable).combine(systems)
        omega = _grid(start, self.frequencies) if self.omega is None else self.omega
        wanted = (omega.shape[0], start.ny, start.nu)
        if self.weights is not None and self.weights.shape != wanted:
            raise ValueError(f"weights: shape {wanted} is needed, got {self.weights.shape}.")
        fitted, kept = _fitted(start, systems, usable, omega, self.weights, self.max_steps)
        if not isinstance(kept, Tracer) and np.any(usable) and not kept:
            warnings.warn(
                "ResponseAverage: the fit to the mean response failed or lost stability; the "
                "aligned average is returned in its place. Give omega= where the models agree, or "
                "leave out models that do not.",
                stacklevel=2,
            )
        return fitted, usable


@eqx.filter_jit
def _fitted(
    start, systems, usable, omega, weights, max_steps
) -> tuple[StateSpace, Bool[Array, ""]]:
    """The fitted model, or `start` where it is no better, and which it is."""
    responses = systems.frequency_response(omega)
    share = usable.astype(float) / jnp.sum(usable.astype(float))
    share = share[:, None, None, None]
    # Models left out may not be finite.
    counted = jnp.where(share > 0.0, responses, 0.0)
    real, imaginary = (
        jnp.sum(part * share, axis=0) for part in (jnp.real(counted), jnp.imag(counted))
    )
    if weights is None:
        size = jnp.sqrt(jnp.mean(real**2 + imaginary**2, axis=0))
        floor = 1e-3 * jnp.max(size) + jnp.finfo(float).tiny
        weights = jnp.broadcast_to((1.0 / jnp.maximum(size, floor))[None], real.shape)
    direct = jnp.any(jnp.where(usable[:, None, None], systems.D, 0.0) != 0.0)
    leaves = (start.A, start.B, start.C, start.D)
    # Steps of one are as large as the matrix; D has that of the response.
    scales = [jnp.linalg.norm(leaf) + jnp.finfo(float).tiny for leaf in leaves[:3]]
    scales.append(jnp.where(direct, jnp.sqrt(jnp.mean(real**2 + imaginary**2)), 0.0))
    ends = np.cumsum([leaf.size for leaf in leaves])[:3]

    def moved(steps: Array) -> StateSpace:
        parts = jnp.split(steps, ends)
        parts = zip(leaves, parts, scales, strict=True)
        return StateSpace(
            *(leaf + scale * part.reshape(leaf.shape) for leaf, part, scale in parts), dt=start.dt
        )

    def residual(steps: Array) -> Array:
        response = moved(steps).frequency_response(omega)
        errors = jnp.stack([jnp.real(response) - real, jnp.imag(response) - imaginary])
        return errors * weights[None] / np.sqrt(real.size)

    start_steps = jnp.zeros(sum(leaf.size for leaf in leaves))
    found = least_squares(residual, start_steps, max_steps=max_steps)
    fitted = moved(found.value)
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(fitted)]))
    # A fit that failed, or lost stability, is no better than where it began.
    kept = finite & (fitted.is_stable() | ~start.is_stable())
    return jax.tree.map(lambda new, old: jnp.where(kept, new, old), fitted, start), kept


def _grid(model: StateSpace, count: int) -> Float[Array, " frequency"]:
    """Log-spaced around the poles, with the resonances and their half-power frequencies."""
    poles = model.modes().poles
    size = jnp.abs(poles)
    fast = jnp.max(size)
    slow = jnp.maximum(jnp.min(size), 1e-4 * fast)
    highest = np.pi / model.dt if model.is_discrete else np.inf
    top = jnp.minimum(3.0 * fast, highest)
    bottom = jnp.minimum(slow / 10.0, top / 100.0)
    spaced = jnp.exp(jnp.linspace(jnp.log(bottom), jnp.log(top), count))
    centre, width = jnp.abs(poles.imag), jnp.abs(poles.real)
    around = jnp.concatenate([centre - width, centre, centre + width])
    return jnp.sort(jnp.concatenate([spaced, jnp.clip(around, bottom, top)]))


@jax.jit
def _balanced(system: StateSpace) -> StateSpace:
    """Balanced states; of an unstable model those of the model made to decay."""
    decaying, _ = _decaying(system, system)
    forward, backward, _ = balancing(decaying)
    A, B, C = forward @ system.A @ backward, forward @ system.B, system.C @ backward
    return StateSpace(A, B, C, system.D, dt=system.dt)


_ALIGNED = AlignedAverage()


def average(
    systems: StateSpace | Sequence[StateSpace], method: AbstractAverage = _ALIGNED
) -> StateSpace:
    """One model from many of the same system, such as the runs of a Monte Carlo study.

    Models that are not finite are left out, and those that are not stable unless the method keeps
    them: an unstable estimate of a stable plant is a failed one. Works under `jit`, and under
    `vmap` over leading axes of a batch of batches.

    Args:
        systems: sequence of models, or one with batch axes (all are averaged).
        method: `AlignedAverage()`, `ResponseAverage()`, or `NaiveAverage()` to reproduce 001.

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
    mean, usable = method.combine(stacked)
    if not isinstance(usable, Tracer) and not np.any(usable):
        raise ValueError(
            "None of the models is stable and finite, so there is nothing to average; stabilise "
            "the estimates, or give AlignedAverage(keep_unstable=True) for an unstable plant."
        )
    return mean


def _finite(systems: StateSpace) -> Bool[Array, " model"]:
    finite = [jnp.all(jnp.isfinite(leaf), axis=(-2, -1)) for leaf in jax.tree.leaves(systems)]
    return jnp.all(jnp.stack(finite), axis=0)


@jax.jit
def _mean(systems: StateSpace, usable: Bool[Array, " model"]) -> StateSpace:
    mask = usable[:, None, None]
    count = jnp.sum(usable.astype(float))
    return jax.tree.map(lambda leaf: jnp.sum(jnp.where(mask, leaf, 0.0), axis=0) / count, systems)
