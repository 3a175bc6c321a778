"""Many runs of one function: the one place that decides map, vmap or shard, and keeps progress.

On a CPU the runs of a chunk are gone through one after the other (`lax.map`: small LAPACK calls
vectorise badly), several chunks at a time by threads; on an accelerator a chunk is one `vmap`. The
runs of a chunk are sharded over all devices of all processes.
"""

import concurrent.futures
import hashlib
import json
import os
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
from jax.experimental import multihost_utils
from jax.extend.core import jaxpr_as_fun
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from jaxtyping import PyTree
from tqdm import tqdm

from lpvid._files import read_arrays, write_arrays

# Runs of one compiled call on each device: few on a CPU, for progress and an even load; many on an
# accelerator, which is fast only when it is full.
_RUNS_ON_CPU = 8
_RUNS_ON_ACCELERATOR = 256

Path = str | os.PathLike[str]


def run_batch(
    function: Callable[[Any, Any], PyTree],
    shared: PyTree,
    count: int,
    *,
    chunk: int | None = None,
    checkpoint: Path | None = None,
    progress: str | None = None,
) -> PyTree:
    """`function(shared, index)` for every index from 0 to `count`, stacked along a leading axis.

    What a run gives depends on its index alone: neither the number of devices and processes nor
    the chunks matter. Compiled once for each function (by identity), kind of `shared` and chunk.
    Where there are several processes (`jax.distributed.initialize`), all of them must call this
    with the same arguments, and all get the whole result.

    Args:
        function: traceable by JAX, from a pytree and an index to a pytree of arrays.
        shared: what all runs share, copied to every device.
        count: how many runs.
        chunk: runs of one compiled call, rounded up to a multiple of the number of devices.
        checkpoint: file that holds the finished runs, written after every chunk; where it exists
            they are not run again. With several processes it must be visible to all of them.
        progress: title of a progress bar, none by default.

    Returns:
        The function's pytree with NumPy arrays for leaves.

    Raises:
        ValueError: the checkpoint belongs to other runs or is damaged, or a count is too small.
        KeyboardInterrupt: as pressed; with several threads on a CPU once the chunks under way are
            finished and saved.

    Example:
        >>> run_batch(lambda shared, index: shared * index, jnp.asarray(2), 4).tolist()
        [0, 2, 4, 6]
    """
    for name, number in (("count", count), ("chunk", chunk)):
        if number is not None and number < 1:
            raise ValueError(f"{name}: at least 1 is needed, got {number}.")
    shared = jax.tree.map(
        lambda leaf: jnp.asarray(leaf) if isinstance(leaf, np.ndarray) else leaf, shared
    )
    place = _Place.of(chunk, count)
    record = _Record.empty(count)
    if checkpoint is not None:
        record = _Record.resumed(function, shared, count, checkpoint)
    bar = tqdm(
        total=count,
        initial=int(record.done.sum()),
        desc=progress,
        unit="run",
        disable=progress is None or jax.process_index() > 0,
    )

    def take(indices, outputs):
        record.add(indices, outputs)
        if checkpoint is not None and jax.process_index() == 0:
            record.write(checkpoint)
        bar.update(len(indices))

    with bar:
        _run_chunks(function, shared, np.flatnonzero(~record.done), place, take)
    return record.values()


class _Place(NamedTuple):
    """Where the runs go, and how many in one call."""

    mesh: Mesh
    chunk: int
    together: bool
    threads: int

    @classmethod
    def of(cls, chunk: int | None, count: int) -> "_Place":
        devices = jax.devices()
        on_cpu = devices[0].platform == "cpu"
        each = _RUNS_ON_CPU if on_cpu else _RUNS_ON_ACCELERATOR
        wanted = min(chunk or each * len(devices), count)
        return cls(
            mesh=Mesh(np.array(devices), ("run",)),
            chunk=-(-wanted // len(devices)) * len(devices),
            together=not on_cpu,
            threads=_threads() if on_cpu else 1,
        )


def _threads() -> int:
    """How many chunks at a time: a CPU device works through one call mostly on one core."""
    if jax.process_count() > 1:
        # Processes have to make the same calls in the same order.
        return 1
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    if jaxlib.version.__version_info__ < (0, 12):
        # Batched LAPACK calls wait in the thread pool they run in (see `_runtime`): each chunk has
        # room for some.
        cores = min(cores, max(2, int(os.environ.get("NPROC", cores)) // 16))
    return max(1, cores // jax.local_device_count())


def _run_chunks(function, shared, pending: np.ndarray, place: _Place, take) -> None:
    """Hand every finished chunk to `take`: which runs, and what they gave."""
    groups = [pending[i : i + place.chunk] for i in range(0, len(pending), place.chunk)]
    if not groups:
        return
    shared = jax.tree.map(
        lambda leaf: _spread(leaf, place.mesh, P()) if eqx.is_array(leaf) else leaf, shared
    )

    def call(indices):
        # The last chunk is filled up: one length, one compilation.
        filled = _spread(np.resize(indices, place.chunk), place.mesh, P("run"))
        outputs = _call(function, shared, filled, place.mesh, place.together)
        if jax.process_count() > 1:
            outputs = multihost_utils.process_allgather(outputs, tiled=True)
        return jax.tree.map(lambda leaf: np.asarray(leaf)[: len(indices)], outputs)

    # The first one alone: it compiles.
    take(groups[0], call(groups[0]))
    if place.threads == 1:
        for group in groups[1:]:
            take(group, call(group))
        return
    with concurrent.futures.ThreadPoolExecutor(place.threads) as pool:
        waiting = {pool.submit(call, group): group for group in groups[1:]}
        try:
            for future in concurrent.futures.as_completed(list(waiting)):
                take(waiting.pop(future), future.result())
        except BaseException:
            # A compiled call cannot be stopped: what is under way is finished, and counts.
            pool.shutdown(wait=True, cancel_futures=True)
            for future, group in waiting.items():
                if not future.cancelled() and future.exception() is None:
                    take(group, future.result())
            raise


def _spread(leaf: Any, mesh: Mesh, spec: P) -> jax.Array:
    """An array that every process has, on the devices of all of them."""
    numbers = _plain(leaf)
    spread = jax.make_array_from_callback(
        numbers.shape, NamedSharding(mesh, spec), lambda part: numbers[part]
    )
    return (
        jax.random.wrap_key_data(spread, impl=jax.random.key_impl(leaf))
        if _is_key(leaf)
        else spread
    )


@eqx.filter_jit
def _call(function, shared, indices, mesh, together):
    # Traced here: inside of shard_map arrays have shardings, which lineax 0.1 takes for shapes.
    closed, shape = _trace(function, shared)
    treedef = jax.tree.structure(shape)
    arrays = jax.tree.leaves(eqx.filter(shared, eqx.is_array))

    def on_one_device(arrays, indices):
        def one(index):
            return jax.tree.unflatten(treedef, jaxpr_as_fun(closed)(*arrays, index))

        return jax.vmap(one)(indices) if together else jax.lax.map(one, indices)

    spread = jax.shard_map(
        on_one_device, mesh=mesh, in_specs=(P(), P("run")), out_specs=P("run"), check_vma=False
    )
    return spread(arrays, indices)


def _trace(function, shared):
    """The program of one run, with the arrays in `shared` for arguments, and what it gives."""
    arrays, static = eqx.partition(shared, eqx.is_array)
    shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), arrays)
    return jax.make_jaxpr(
        lambda arrays, index: function(eqx.combine(arrays, static), index), return_shape=True
    )(shapes, jax.ShapeDtypeStruct((), jnp.int64))


class _Record:
    """Finished runs: which, and their leaves."""

    def __init__(self, done: np.ndarray, leaves: list[np.ndarray], treedef: Any, identity: dict):
        self.done, self.leaves, self.treedef, self.identity = done, leaves, treedef, identity

    @classmethod
    def empty(cls, count: int) -> "_Record":
        return cls(np.zeros(count, bool), [], None, {})

    @classmethod
    def resumed(cls, function, shared, count: int, path: Path) -> "_Record":
        """What the file holds, if there is one; refused where it belongs to other runs."""
        record = cls.empty(count)
        shape, record.identity = _identity(function, shared, count)
        if not os.path.exists(path):
            return record
        try:
            stored = read_arrays(path)
            identity = json.loads(str(stored.pop("identity")))
            record.done = stored.pop("done")
        except (ValueError, KeyError) as error:
            raise ValueError(
                f"checkpoint: {path} is damaged or holds no runs; delete it or give another path."
            ) from error
        for name, what in _PARTS.items():
            if identity.get(name) != record.identity[name]:
                raise ValueError(
                    f"checkpoint: {path} was begun with {what}; give another path, or delete it to "
                    "start again."
                )
        expected, record.treedef = jax.tree.flatten(shape)
        record.leaves = [stored[f"leaf{k}"] for k in range(len(expected))]
        return record

    def add(self, indices: np.ndarray, outputs: PyTree) -> None:
        new, self.treedef = jax.tree.flatten(outputs)
        if not self.leaves:
            count = len(self.done)
            self.leaves = [np.zeros((count, *leaf.shape[1:]), leaf.dtype) for leaf in new]
        for leaf, part in zip(self.leaves, new, strict=True):
            leaf[indices] = part
        self.done[indices] = True

    def write(self, path: Path) -> None:
        arrays = {f"leaf{k}": leaf for k, leaf in enumerate(self.leaves)}
        write_arrays(
            path, {"identity": np.array(json.dumps(self.identity)), "done": self.done, **arrays}
        )

    def values(self) -> PyTree:
        return jax.tree.unflatten(self.treedef, self.leaves)


# In the order in which a difference is told.
_PARTS = {
    "count": "another number of runs",
    "inputs": "other keys, points or data",
    "jax": "another version of JAX",
    "program": "another pipeline",
}


def _identity(function, shared, count: int) -> tuple[PyTree, dict]:
    """What a run gives, and by what a checkpoint is known: its inputs and its program."""
    leaves = [_plain(leaf) for leaf in jax.tree.leaves(eqx.filter(shared, eqx.is_array))]
    closed, shape = _trace(function, shared)
    # Functions are printed with their addresses, which change from process to process.
    program = re.sub(r"0x[0-9a-f]+", "", str(closed.jaxpr)).encode()
    constants = [_plain(value) for value in closed.consts]
    return shape, {
        "count": count,
        "inputs": _digest(leaves),
        "jax": jax.__version__,
        "program": _digest([np.frombuffer(program, np.uint8), *constants]),
    }


def _plain(leaf: Any) -> np.ndarray:
    """Numbers of an array, of random keys too."""
    return np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)


def _is_key(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and bool(jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key))


def _digest(arrays: list[np.ndarray]) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
