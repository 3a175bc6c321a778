"""Parameters that a model's response says nothing about, by name."""

from collections.abc import Iterable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float, Int

from lpvid.models import AbstractStructure
from lpvid.refinement import Ties, select
from lpvid.restructure._matching import Target, channel_weights, make_target, response_error

# A move that leaves the response within this share of its size is one that it does not see.
_UNSEEN = 1e-6
_FACTOR = 1.5
# A parameter that moves by less than this share of the largest mover takes no part.
_PART = 1e-6


class Identifiability(eqx.Module):
    """What the frequency response says about the parameters at one point.

    Attributes:
        structure: the structure.
        parameters: ϑ, the point.
        omega: the frequencies looked at, rad/s.
        singular_values: of the response's Jacobian with columns of unit length, largest first: a
            value of 1e-3 is a combination that noise enters a thousand times as strongly.
        rank: how many combinations of the parameters the response tells.
        directions: the combinations that it does not tell, in units of the parameters: moving
            along a row changes nothing to first order. The largest entry of each row is one in
            shares of the parameter's own size.
        groups: indices of the parameters that share one value.
    """

    structure: AbstractStructure
    parameters: Float[Array, " parameter"]
    omega: Float[Array, " frequency"]
    singular_values: Float[Array, " free"]
    rank: Int[Array, ""]
    directions: Float[Array, "unseen parameter"]
    groups: tuple[tuple[int, ...], ...] = eqx.field(static=True, default=())

    @property
    def names(self) -> tuple[str, ...]:
        """Parameters that take part in an unseen combination: none of them is known."""
        moving = np.any(np.abs(self._shares()) > _PART, axis=0)
        return tuple(np.asarray(self.structure.parameter_names)[moving].tolist())

    def _shares(self) -> np.ndarray:
        """The directions in shares of each parameter's own size (of one, where that is zero)."""
        return np.asarray(self.directions) / _sizes(np.asarray(self.parameters))[None]

    def describe(self) -> tuple[str, ...]:
        """A sentence for each unseen combination; empty where all parameters can be told.

        That parameters enter only as a product, a ratio, a sum or a difference is said after the
        move has been made over a finite distance and left the response unchanged.
        """
        return tuple(self._sentence(share) for share in self._shares())

    def _sentence(self, share: np.ndarray) -> str:
        every = np.flatnonzero(np.abs(share) > _PART)
        together = {group[0]: group for group in self.groups}
        others = {index for group in self.groups for index in group[1:]}
        part = np.array([index for index in every if index not in others])
        all_names = self.structure.parameter_names
        names = [" = ".join(all_names[k] for k in together.get(i, (i,))) for i in part]
        values, point = share[part], np.asarray(self.parameters)
        listed = _listed(names)
        if part.size == 1:
            return f"{listed} does not enter the response: fix it."
        # All by one factor (or its reciprocal), with the parameters' signs kept.
        if np.all(np.abs(point[every]) > 0.0):
            scaled = point.copy()
            scaled[every] = point[every] * _FACTOR ** share[every]
            if self._unseen(scaled):
                return self._scaling(names, values)
        added = point + share * _sizes(point) * (_FACTOR - 1.0)
        steps = values * _sizes(point)[part]
        steps = steps / np.max(np.abs(steps))
        if self._unseen(added):
            return self._addition(names, steps)
        return (
            f"{listed} cannot be told apart here: the response stays, to first order, when they "
            f"move together ({_moves(names, steps)}). Fix or tie one of them."
        )

    def _scaling(self, names: Sequence[str], values: np.ndarray) -> str:
        listed, equal = _listed(names), np.isclose(np.abs(values), np.max(np.abs(values)))
        advice = "fix one of them, or tie them"
        if len(names) == 2 and np.all(equal):
            sign = "*" if values[0] * values[1] < 0 else "/"
            return f"{listed} enter only as {names[0]}{sign}{names[1]}: {advice}."
        if np.all(equal) and np.all(values * values[0] > 0):
            return f"{listed} enter only by their ratios: {advice}."
        powers = " ".join(f"{name}^{value:.3g}" for name, value in zip(names, values, strict=True))
        return (
            f"{listed} enter only by combinations that stay when each is multiplied by its power "
            f"of one factor ({powers}): {advice}."
        )

    def _addition(self, names: Sequence[str], steps: np.ndarray) -> str:
        listed, equal = _listed(names), np.isclose(np.abs(steps), 1.0)
        advice = "fix one of them, or tie them"
        if len(names) == 2 and np.all(equal):
            sign = "+" if steps[0] * steps[1] < 0 else "-"
            return f"{listed} enter only as {names[0]} {sign} {names[1]}: {advice}."
        return (
            f"{listed} enter only by combinations that stay when they move together "
            f"({_moves(names, steps)}): {advice}."
        )

    def _unseen(self, moved: np.ndarray) -> bool:
        lower, upper = (np.asarray(bound) for bound in self.structure.bounds())
        if np.any(moved < lower) or np.any(moved > upper):
            return False
        model = self.structure.matrices(self.parameters)
        response = model.frequency_response(self.omega)
        target = Target(self.omega, response, None)
        error = response_error(self.structure, jnp.asarray(moved), target)
        return bool(jnp.max(jnp.abs(error) * channel_weights(target)[None]) < _UNSEEN)


def identifiability(
    structure: AbstractStructure,
    parameters: ArrayLike | Sequence,
    *,
    omega: ArrayLike | Sequence | None = None,
    tolerance: float = 1e-8,
    fixed: Iterable[str] = (),
    tied: Ties = (),
) -> Identifiability:
    """Which combinations of the parameters the frequency response does not tell, at one point.

    The null space of the response's Jacobian with respect to ϑ, exact derivatives, channels
    weighted to equal size. It holds at this point and to first order. Not for `jit`: how many
    combinations there are depends on the numbers.

    Args:
        structure: the structure.
        parameters: ϑ, such as `restructure(...).parameters`.
        omega: frequencies that the data cover, rad/s; a grid around the model's poles by default.
        tolerance: singular values below this share of the largest count as zero. Raise it to ask
            what noisy data tell: 1e-3, say, for a model good to a thousandth.
        fixed: names of parameters that are known (patterns with * and ?), and not asked about; nor
            are those that the structure's bounds fix (lower equal to upper).
        tied: names of parameters that share one value: a pattern, or several patterns, a group.

    Raises:
        ValueError: the number of parameters is not the structure's, one is not finite, a pattern
            matches nothing, or the call is inside `jit`.

    Example:
        >>> def spring(p):
        ...     A = jnp.array([[0.0, 1.0], [-p[0] * p[1], -1.0]])
        ...     return A, jnp.eye(2)[:, 1:], jnp.eye(2)[:1]
        >>> structure = FunctionStructure(spring, nominal=[2.0, 3.0], names=("k1", "k2"))
        >>> identifiability(structure, [2.0, 3.0]).describe()
        ('k1 and k2 enter only as k1*k2: fix one of them, or tie them.',)
    """
    point = jnp.asarray(parameters, float)
    if isinstance(point, Tracer):
        raise ValueError("identifiability needs numbers: call it outside jit, vmap and grad.")
    if point.shape != (structure.n_parameters,) or not np.all(np.isfinite(point)):
        raise ValueError(
            f"parameters: {structure.n_parameters} finite numbers are needed, see "
            f"structure.parameter_names; got shape {point.shape}."
        )
    if omega is None and structure.matrices(point).is_discrete:
        raise ValueError("omega: frequencies are needed for a structure in discrete time, rad/s.")
    if omega is None:
        grid = make_target(structure.matrices(point), 60, np.inf).omega
    else:
        grid = jnp.atleast_1d(jnp.asarray(omega, float))
    if not np.all(np.isfinite(grid)):
        raise ValueError(
            "omega: no grid follows from poles at zero alone; give frequencies, rad/s."
        )
    selection = select(structure.parameter_names, point, tuple(fixed), tied)
    moves = np.asarray(selection.matrix)
    lower, upper = (np.asarray(bound) for bound in structure.bounds())
    moves = moves[:, ~np.any(moves[upper <= lower] > 0.0, axis=0)]
    if moves.shape[1] == 0:
        raise ValueError("structure: its bounds leave no parameter free.")
    sizes = np.max(moves * _sizes(np.asarray(point))[:, None], axis=0)
    shares = np.asarray(_jacobian(structure, point, grid)) @ moves * sizes[None]
    length = np.linalg.norm(shares, axis=0)
    length = np.where(length > tolerance * np.max(length), length, np.inf)
    values, right = np.linalg.svd(shares / length[None], full_matrices=True)[1:]
    values = np.concatenate([values, np.zeros(sizes.size - values.shape[0])])
    rank = int(np.sum(values > tolerance * max(values[0], np.finfo(float).tiny)))
    # A parameter without any effect has a zero column, and keeps its own size.
    scale = np.where(np.isfinite(length), length, 1.0)
    directions = _sparse(right[rank:] / scale[None]) * sizes[None]
    groups = (tuple(np.flatnonzero(column).tolist()) for column in moves.T)
    return Identifiability(
        structure=structure,
        parameters=point,
        omega=grid,
        singular_values=jnp.asarray(values),
        rank=jnp.asarray(rank),
        directions=jnp.asarray(directions @ moves.T),
        groups=tuple(group for group in groups if len(group) > 1),
    )


@eqx.filter_jit
def _jacobian(structure: AbstractStructure, point: Array, omega: Array) -> Array:
    response = structure.matrices(point).frequency_response(omega)
    target = Target(omega, response, None)
    weights = channel_weights(target)[None]

    def weighted(parameters):
        error = response_error(structure, parameters, target)
        parts = [(part * weights).reshape(-1) for part in (jnp.real(error), jnp.imag(error))]
        return jnp.concatenate(parts)

    return jax.jacfwd(weighted)(point)


def _sizes(point: np.ndarray) -> np.ndarray:
    return np.where(point != 0.0, np.abs(point), 1.0)


def _sparse(directions: np.ndarray) -> np.ndarray:
    """A basis of the same space with few parameters in each row: Gauss–Jordan, full pivoting."""
    reduced = directions.copy()
    taken: list[int] = []
    for row in range(reduced.shape[0]):
        rest = np.abs(reduced[row:])
        rest[:, taken] = 0.0
        k, column = np.unravel_index(np.argmax(rest), rest.shape)
        reduced[[row, row + k]] = reduced[[row + k, row]]
        reduced[row] /= reduced[row, column]
        others = np.arange(reduced.shape[0]) != row
        reduced[others] -= reduced[others, column][:, None] * reduced[row][None]
        taken.append(int(column))
    largest = np.max(np.abs(reduced), axis=1, keepdims=True, initial=np.finfo(float).tiny)
    # Rounding of the elimination is no part of a combination.
    return np.where(np.abs(reduced) > _PART * largest, reduced / largest, 0.0)


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _moves(names: Sequence[str], steps: np.ndarray) -> str:
    return ", ".join(f"{name} {step:+.3g}" for name, step in zip(names, steps, strict=True))
