"""A pipeline over random keys and operating points."""

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, PyTree

from lpvid._batch import run_batch
from lpvid._results import Status
from lpvid.montecarlo._summary import Summary, summarise


class Study(eqx.Module):
    """All runs of a pipeline.

    Attributes:
        values: what the pipeline gave, every leaf with leading axes (run,), or (point, run) where
            there are points; the floating-point numbers of failed runs are NaN.
        status: how each run ended, of the shape of the leading axes.
        kept: which runs have values.
    """

    values: PyTree
    status: Status
    kept: np.ndarray

    @property
    def failed(self) -> int:
        """How many runs have no values."""
        return int(np.sum(~self.kept))

    def outcomes(self) -> dict[str, int]:
        """How many runs ended in each status, by its sentence, most first.

        Example:
            >>> keys = jax.random.split(jax.random.key(0), 3)
            >>> run(jax.random.normal, keys, progress=False).outcomes()
            {'Successful.': 3}
        """
        flat = jax.tree.map(lambda code: jnp.reshape(code, -1), self.status)
        _, first, counts = np.unique(
            np.asarray(jax.tree.leaves(flat)[0]), return_index=True, return_counts=True
        )
        order = np.argsort(-counts, kind="stable")
        return {
            Status[jax.tree.map(lambda code, k=k: np.asarray(code[first[k]]), flat)]: int(counts[k])
            for k in order
        }

    def summary(
        self,
        select: Callable[[Any], Any] | None = None,
        *,
        deviation: Callable[[Any], Any] | None = None,
        truth: ArrayLike | Sequence | None = None,
        bound: ArrayLike | Sequence | None = None,
        names: Sequence[str] | None = None,
    ) -> Summary:
        """Statistics over the runs of one quantity; see `summarise`.

        Args:
            select: picks the quantity from `values`; without it `values` must be one array.
            deviation: picks its estimated standard deviations, for the coverage.
            truth: true value of the quantity, with or without a leading axis of points.
            bound: smallest possible standard deviation, of the same shape.
            names: of the quantity's entries.

        Raises:
            ValueError: the quantity is not one array, or shapes do not fit.

        Example:
            >>> keys = jax.random.split(jax.random.key(0), 3)
            >>> study = run(jax.random.normal, keys, progress=False)
            >>> study.summary(truth=0.0).success.item()
            1.0
        """
        quantity = self.values if select is None else select(self.values)
        if not isinstance(quantity, np.ndarray | jax.Array):
            raise ValueError(
                f"select: one array is needed, got {type(quantity).__name__}; give a function that "
                "picks it, such as lambda values: values.parameters."
            )
        return summarise(
            quantity,
            kept=self.kept,
            deviation=None if deviation is None else deviation(self.values),
            truth=truth,
            bound=bound,
            names=names,
        )


def run(
    pipeline: Callable[..., PyTree],
    keys: Array,
    *,
    points: PyTree | None = None,
    accept: Sequence[Status] = (),
    chunk: int | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    progress: bool = True,
) -> Study:
    """Run a pipeline for every random key, at every operating point, in one batch.

    The pipeline is `pipeline(key)`, or `pipeline(key, point)` where there are points, and gives any
    pytree of arrays; JAX traces it, so it must not look at values in Python. Where its result has a
    `status` (an attribute or an entry of that name), a run that did not succeed counts as failed;
    so does one with a NaN or an infinity. Failed runs are NaN and have a status; they stop nothing.
    What raises at run time (`eqx.error_if`) does stop the study.

    Run r at point i gets the key `fold_in(keys[r], i)` (`keys[r]` without points), so its result
    depends neither on the number of devices and processes nor on the chunks; rounding apart, which
    may differ between kinds of devices. All devices of all processes take part. One function
    object is compiled once: define the pipeline outside of loops.

    Args:
        pipeline: what to run; a function, or an `eqx.Module` with arrays of its own.
        keys: random keys, shape (run,), such as `jax.random.split(jax.random.key(0), 100)`.
        points: pytree whose leaves have the points for leading axis: κ, records, starts.
        accept: statuses whose values are kept although they are no success.
        chunk: runs of one compiled call; a sensible number by default.
        checkpoint: file to which finished runs are saved after each chunk, whole or not at all; a
            later call with the same arguments goes on from there. An interruption from the keyboard
            is raised again; with several threads on a CPU the chunks under way are saved first.
        progress: whether to show a bar on stderr.

    Returns:
        All runs, in the order of `keys`.

    Raises:
        ValueError: `keys` or `points` have wrong shapes, or `checkpoint` belongs to another study.

    Example:
        >>> keys = jax.random.split(jax.random.key(0), 100)
        >>> def mean_of_ten(key, scale):
        ...     return jnp.mean(scale * jax.random.normal(key, (10,)))
        >>> study = run(mean_of_ten, keys, points=jnp.array([1.0, 2.0]), progress=False)
        >>> study.values.shape, study.failed
        ((2, 100), 0)
    """
    _check_keys(keys)
    n_points = _count(points)
    n_runs = keys.shape[0]
    shape = (n_runs,) if n_points is None else (n_points, n_runs)
    values, status, kept = run_batch(
        _one_run,
        (pipeline, keys, points, tuple(accept)),
        int(np.prod(shape)),
        chunk=chunk,
        checkpoint=checkpoint,
        progress="runs" if progress else None,
    )

    def by_point(leaf):
        return leaf.reshape(*shape, *leaf.shape[1:])

    values, status = jax.tree.map(by_point, (values, status))
    return Study(values, status, by_point(kept))


def _one_run(shared, index):
    pipeline, keys, points, accept = shared
    n_runs = keys.shape[0]
    key = keys[index % n_runs]
    if points is None:
        outcome = pipeline(key)
    else:
        place = index // n_runs
        point = jax.tree.map(lambda leaf: leaf[place], points)
        outcome = pipeline(jax.random.fold_in(key, place), point)
    outcome = jax.tree.map(jnp.asarray, outcome)
    numbers = [leaf for leaf in jax.tree.leaves(outcome) if _has_nan(leaf)]
    finite = jnp.all(jnp.stack([jnp.asarray(True), *(jnp.all(jnp.isfinite(n)) for n in numbers)]))
    status = Status.where(finite, Status.successful, Status.nonfinite)
    own = _own_status(outcome)
    if own is not None:
        # A status of its own says more than that a number is not finite.
        status = Status.where(own == Status.successful, status, own)
    accepted = jnp.stack([status == each for each in (Status.successful, *accept)])
    kept = finite & jnp.any(accepted)
    values = jax.tree.map(
        lambda leaf: jnp.where(kept, leaf, jnp.nan) if _has_nan(leaf) else leaf, outcome
    )
    return values, status, kept


def _has_nan(leaf: Any) -> bool:
    return bool(jnp.issubdtype(leaf.dtype, jnp.inexact))


def _own_status(outcome: PyTree) -> Status | None:
    if isinstance(outcome, Mapping):
        found = outcome.get("status")
    else:
        found = getattr(outcome, "status", None)
    if not isinstance(found, Status):
        return None
    shapes = {jnp.shape(leaf) for leaf in jax.tree.leaves(found)}
    if shapes != {()}:
        raise ValueError(
            f"pipeline: its status must be one a run, got shape {shapes.pop()}; summarise it, or "
            "leave it out of the result."
        )
    return found


def _check_keys(keys: Any) -> None:
    typed = isinstance(keys, jax.Array) and jnp.issubdtype(keys.dtype, jax.dtypes.prng_key)
    if not typed or keys.ndim != 1 or keys.shape[0] == 0:
        raise ValueError(
            "keys: an array of random keys of shape (run,) is needed; make one with "
            "jax.random.split(jax.random.key(seed), runs)."
        )


def _count(points: PyTree | None) -> int | None:
    if points is None:
        return None
    lengths = {np.shape(leaf)[:1] for leaf in jax.tree.leaves(points)}
    if len(lengths) != 1 or lengths <= {(), (0,)}:
        raise ValueError(
            "points: every leaf needs the operating points for its leading axis, and at least one "
            f"point; got leading axes {sorted(lengths)}."
        )
    return lengths.pop()[0]
