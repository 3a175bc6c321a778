"""Where the search of a restructuring begins: objects that one can swap and combine."""

import abc
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from lpvid._linalg import excess_growth
from lpvid.models import AbstractStructure, StateSpace, balancing
from lpvid.restructure._similarity import linear_conditions, similarity_search

Vectors = Float[Array, "start parameter"]


class StartProblem(NamedTuple):
    """What a start may look at.

    Attributes:
        structure: what is looked for.
        search: the parameterisation that it is searched in: the structure's own, or the better
            behaved `structure.search_structure()`.
        black_box: continuous-time model.
        given: the vectors of `initial=`, of the structure itself.
    """

    structure: AbstractStructure
    search: AbstractStructure
    black_box: StateSpace
    given: Vectors | None


class Proposals(NamedTuple):
    """Starting vectors of the search parameterisation and of the structure itself."""

    searched: Vectors | None = None
    own: Vectors | None = None


class AbstractStarts(eqx.Module):
    """A way to find starting vectors."""

    @abc.abstractmethod
    def propose(self, problem: StartProblem, key: PRNGKeyArray | None) -> Proposals:
        """The vectors."""


class ScatteredStarts(AbstractStarts):
    """The structure's own start rule: a best guess, and random vectors about it.

    For the two-link arm these are values of the dissipative form, each of them a stable model.

    Attributes:
        count: how many.

    Raises:
        ValueError: there is to be none.

    Example:
        >>> ScatteredStarts(8).count
        8
    """

    count: int = eqx.field(static=True, default=24)

    def __check_init__(self):
        _check_count("count", self.count)

    def propose(self, problem: StartProblem, key: PRNGKeyArray | None) -> Proposals:
        """By `search.starts`."""
        key = _needed(key)
        return Proposals(searched=problem.search.starts(key, self.count, problem.black_box))


class SimilarityStarts(AbstractStarts):
    """Least squares on the matrices and the change of basis (001, equation 7), for any structure.

    ‖𝔄T − TA(ϑ)‖² + ‖𝔅 − TB(ϑ)‖² + ‖ℭT − C(ϑ)‖² is minimised from the vectors of `initial=` where
    there are some, else from the structure's start rule. The valley it descends is another one
    than that of the response, so that it reaches models the response's search misses. A black box
    of a higher order than the structure's is reduced by balanced truncation first; one of a lower
    order is met as far as its states can be mapped.

    Works under `jax.jit` and `jax.vmap` where the structure's start rule does. It takes
    (order²)³ operations a step: for orders up to about twenty.

    Attributes:
        count: how many vectors it begins from at most.
        steps: limit on the steps from each.

    Raises:
        ValueError: a count is too small.

    Example:
        >>> SimilarityStarts(count=2).steps
        80
    """

    count: int = eqx.field(static=True, default=8)
    steps: int = eqx.field(static=True, default=80)

    def __check_init__(self):
        _check_count("count", self.count)
        _check_count("steps", self.steps)

    def propose(self, problem: StartProblem, key: PRNGKeyArray | None) -> Proposals:
        """By `similarity_search` from each."""
        if problem.given is not None:
            seeds = problem.given[: self.count]
            return Proposals(own=_similar(problem.structure, seeds, problem.black_box, self.steps))
        seeds = problem.search.starts(_needed(key), self.count, problem.black_box)
        return Proposals(searched=_similar(problem.search, seeds, problem.black_box, self.steps))


class LinearConditionsStart(AbstractStarts):
    """The paper's start: the structure's entries without parameters, linear in T (001, (34)).

    It takes the T of least norm that satisfies them and fits ϑ to the matrices in that basis.
    Exact where these conditions fix T. For (32) they leave 8 of 36 unknowns free and the start is
    far off; it is here to reproduce 001.

    Example:
        >>> isinstance(LinearConditionsStart(), AbstractStarts)
        True
    """

    def propose(self, problem: StartProblem, key: PRNGKeyArray | None) -> Proposals:
        """By `linear_conditions`."""
        structure, black_box = problem.structure, problem.black_box
        if problem.given is not None:
            guess = problem.given[0]
        else:
            guess = problem.search.starts(_needed(key), 1, black_box)[0]
            guess = structure.from_search(guess)
        return Proposals(own=_linear(structure, guess, black_box)[None])


class ClosedFormStart(AbstractStarts):
    """`structure.closed_form`: exact on noise-free models, very sensitive to noise.

    Raises:
        ValueError: (in `restructure`) the structure has no closed form, or not for this black box.

    Example:
        >>> isinstance(ClosedFormStart(), AbstractStarts)
        True
    """

    def propose(self, problem: StartProblem, key: PRNGKeyArray | None) -> Proposals:
        """One vector."""
        del key
        return Proposals(own=problem.structure.closed_form(problem.black_box)[None])


def start_rules(
    starts: int | AbstractStarts | Sequence[AbstractStarts],
) -> Sequence[AbstractStarts]:
    """What `starts=` of `restructure` asks for."""
    if isinstance(starts, AbstractStarts):
        return (starts,)
    if isinstance(starts, Sequence):
        return starts
    return (ScatteredStarts(starts),) if starts > 0 else ()


def collect_starts(
    rules: Sequence[AbstractStarts], problem: StartProblem, key: PRNGKeyArray | None
) -> tuple[Array | None, Array | None]:
    """All starting vectors: those of the search parameterisation, and of the structure itself."""
    searched, own = [], [] if problem.given is None else [problem.given]
    for index, rule in enumerate(rules):
        # The first rule has the key itself: it starts alike, alone or in company.
        rule_key = key if key is None or index == 0 else jax.random.fold_in(key, index)
        proposed = rule.propose(problem, rule_key)
        searched += [] if proposed.searched is None else [proposed.searched]
        own += [] if proposed.own is None else [proposed.own]
    if not searched and not own:
        raise ValueError("starts: none left; ask for starts > 0 or give initial=.")
    joined = [jnp.concatenate(vectors) if vectors else None for vectors in (searched, own)]
    return joined[0], joined[1]


@eqx.filter_jit
def _similar(structure, seeds, black_box, steps):
    reduced = _of_order(black_box, structure.matrices(seeds[0]).nx)
    return jax.vmap(lambda seed: similarity_search(structure, seed, reduced, steps))(seeds)


@eqx.filter_jit
def _linear(structure, guess, black_box):
    reduced = _of_order(black_box, structure.matrices(guess).nx)
    return linear_conditions(structure, guess, reduced)


def _of_order(black_box: StateSpace, nx: int) -> StateSpace:
    """At most `nx` states, by balanced truncation; of an unstable model as it decays shifted."""
    if black_box.nx <= nx:
        return black_box
    shifted = black_box.A - excess_growth(black_box.A) * jnp.eye(black_box.nx)
    forward, backward, _ = balancing(StateSpace(shifted, black_box.B, black_box.C))
    forward, backward = forward[:nx], backward[:, :nx]
    A, B, C = forward @ black_box.A @ backward, forward @ black_box.B, black_box.C @ backward
    return StateSpace(A, B, C, black_box.D)


def _needed(key: PRNGKeyArray | None) -> PRNGKeyArray:
    if key is None:
        raise ValueError("key: the start rule is random; give key=jax.random.key(seed).")
    return key


def _check_count(name: str, value: int) -> None:
    if value < 1:
        raise ValueError(f"{name}: at least 1 is needed, got {value}.")
