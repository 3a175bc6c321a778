"""Batches of runs: the same result in chunks, on many devices and after an interruption."""

import contextlib
import os
import socket
import subprocess
import sys
import textwrap

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lpvid import _batch
from lpvid._batch import run_batch
from lpvid._solve import least_squares

COUNT = 21


def draw(shared, index):
    """A LAPACK call and a random number, of a key by index."""
    key, scale = shared
    matrix = jax.random.normal(jax.random.fold_in(key, index), (3, 3)) + scale * jnp.eye(3)
    return {"solved": jnp.linalg.solve(matrix, jnp.ones(3)), "index": index}


def shared(seed=0, scale=4.0):
    return jax.random.key(seed), jnp.asarray(scale)


@pytest.fixture(scope="module")
def expected():
    runs = [draw(shared(), jnp.asarray(index)) for index in range(COUNT)]
    return {name: np.stack([run[name] for run in runs]) for name in runs[0]}


def check(found, expected):
    np.testing.assert_array_equal(found["index"], np.arange(COUNT))
    np.testing.assert_allclose(found["solved"], expected["solved"], rtol=1e-12)


@pytest.mark.parametrize("chunk", [4, 100])
def test_every_run_is_that_of_its_index(expected, chunk):
    check(run_batch(draw, shared(), COUNT, chunk=chunk), expected)


def test_the_accelerators_way_gives_the_same(expected, monkeypatch):
    place = _batch._Place.of(7, COUNT)
    monkeypatch.setattr(
        _batch._Place, "of", lambda *_: place._replace(together=True, threads=1), raising=True
    )
    check(run_batch(draw, shared(), COUNT), expected)


@pytest.fixture
def calls(monkeypatch):
    """Indices of every compiled call."""
    seen, call = [], _batch._call

    def recorded(function, shared, indices, *rest):
        seen.append(np.asarray(indices).tolist())
        return call(function, shared, indices, *rest)

    monkeypatch.setattr(_batch, "_call", recorded)
    return seen


def interrupt_after(monkeypatch, chunks):
    write, left = _batch.write_arrays, [chunks]

    def interrupted(path, arrays):
        write(path, arrays)
        left[0] -= 1
        if left[0] == 0:
            raise KeyboardInterrupt

    monkeypatch.setattr(_batch, "write_arrays", interrupted)


def test_an_interrupted_batch_goes_on_where_it_was(expected, tmp_path, monkeypatch, calls):
    path = tmp_path / "runs.npz"
    with monkeypatch.context() as patch:
        interrupt_after(patch, 1)
        with pytest.raises(KeyboardInterrupt):
            run_batch(draw, shared(), COUNT, chunk=4, checkpoint=path)
    finished = {index for chunk in calls for index in chunk}
    assert finished == set(range(4))
    calls.clear()
    check(run_batch(draw, shared(), COUNT, chunk=4, checkpoint=path), expected)
    again = {index for chunk in calls for index in chunk}
    # The last chunk is filled up with runs of its own: nothing is run twice.
    assert again == set(range(COUNT)) - finished
    calls.clear()
    check(run_batch(draw, shared(), COUNT, chunk=5, checkpoint=path), expected)
    assert calls == []
    assert [file.name for file in tmp_path.iterdir()] == ["runs.npz"]


def test_one_broken_chunk_does_not_lose_the_others(tmp_path, monkeypatch):
    path, call = tmp_path / "runs.npz", _batch._call

    def broken(function, shared, indices, *rest):
        if 8 in np.asarray(indices):
            raise RuntimeError("out of memory")
        return call(function, shared, indices, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(_batch, "_call", broken)
        with pytest.raises(RuntimeError, match="out of memory"):
            run_batch(draw, shared(), COUNT, chunk=4, checkpoint=path)
    done = np.load(path)["done"]
    assert done[:4].all() and not done[8:12].any()


def other_draw(shared, index):
    found = draw(shared, index)
    return {**found, "solved": 2.0 * found["solved"]}


@pytest.mark.parametrize(
    ("function", "inputs", "count", "message"),
    [
        (draw, (1, 4.0), COUNT, "begun with other keys, points or data"),
        (draw, (0, 5.0), COUNT, "begun with other keys, points or data"),
        (other_draw, (0, 4.0), COUNT, "begun with another pipeline"),
        (draw, (0, 4.0), COUNT + 1, "begun with another number of runs"),
    ],
)
def test_a_checkpoint_of_other_runs_is_refused(tmp_path, function, inputs, count, message):
    path = tmp_path / "runs.npz"
    run_batch(draw, shared(), COUNT, chunk=4, checkpoint=path)
    before = path.read_bytes()
    with pytest.raises(ValueError, match=message):
        run_batch(function, shared(*inputs), count, checkpoint=path)
    assert path.read_bytes() == before


@pytest.mark.parametrize("content", [b"", b"hello", None])
def test_a_damaged_checkpoint_is_refused(tmp_path, content):
    path = tmp_path / "runs.npz"
    if content is None:
        run_batch(draw, shared(), COUNT, chunk=4, checkpoint=path)
        content = path.read_bytes()[:-100]
    path.write_bytes(content)
    with pytest.raises(ValueError, match="runs.npz is damaged"):
        run_batch(draw, shared(), COUNT, checkpoint=path)


def test_no_runs_are_refused():
    with pytest.raises(ValueError, match="count: at least 1"):
        run_batch(draw, shared(), 0)
    with pytest.raises(ValueError, match="chunk: at least 1"):
        run_batch(draw, shared(), 3, chunk=0)


def test_progress_goes_to_stderr(capsys):
    run_batch(draw, shared(), COUNT, chunk=4, progress="drawing")
    captured = capsys.readouterr()
    assert captured.out == "" and "drawing: 100%" in captured.err


PROGRAM = """
import sys
import jax, jax.numpy as jnp, numpy as np
if len(sys.argv) > 4:
    jax.distributed.initialize(sys.argv[4], num_processes=2, process_id=int(sys.argv[5]))
import lpvid
from lpvid import _batch

def draw(shared, index):
    key, scale = shared
    matrix = jax.random.normal(jax.random.fold_in(key, index), (3, 3)) + scale * jnp.eye(3)
    return {"solved": jnp.linalg.solve(matrix, jnp.ones(3)), "index": index}

out, checkpoint, devices = sys.argv[1:4]
assert len(jax.devices()) == int(devices), jax.devices()
seen, call = [], _batch._call
def recorded(function, shared, indices, mesh, together):
    assert mesh.devices.size == int(devices)
    if jax.process_count() == 1:
        seen.extend(np.asarray(indices).tolist())
    return call(function, shared, indices, mesh, together)
_batch._call = recorded
shared = jax.random.key(0), jnp.asarray(4.0)
found = _batch.run_batch(draw, shared, 21, checkpoint=checkpoint or None, chunk=8)
np.savez(out, seen=np.array(seen), **found)
"""


@contextlib.contextmanager
def programs(*arguments, devices):
    """Run the program, one process for each list of arguments; none is left behind."""
    flags = f"--xla_force_host_platform_device_count={devices}"
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", textwrap.dedent(PROGRAM), *each],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for each in arguments
    ]
    try:
        for process in processes:
            text, _ = process.communicate(timeout=100)
            assert process.returncode == 0, text
        yield
    finally:
        for process in processes:
            process.kill()
            process.communicate()


@pytest.mark.slow
def test_eight_devices_take_up_what_one_began(expected, tmp_path, monkeypatch):
    path, out = tmp_path / "runs.npz", tmp_path / "out.npz"
    with monkeypatch.context() as patch:
        interrupt_after(patch, 1)
        with pytest.raises(KeyboardInterrupt):
            run_batch(draw, shared(), COUNT, chunk=5, checkpoint=path)
    with programs([str(out), str(path), "8"], devices=8):
        found = dict(np.load(out))
    check(found, expected)
    # Another process knows the checkpoint for its own: five runs were not made again.
    assert set(found["seen"].tolist()) == set(range(5, COUNT))


@pytest.mark.slow
def test_two_processes_give_the_same(expected, tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    outs = [tmp_path / f"out{k}.npz" for k in range(2)]
    checkpoint = str(tmp_path / "runs.npz")
    arguments = [[str(outs[k]), checkpoint, "4", address, str(k)] for k in range(2)]
    with programs(*arguments, devices=2):
        for out in outs:
            check(dict(np.load(out)), expected)
        assert np.load(checkpoint)["done"].all()


def search(shared, index):
    goal = jax.random.normal(jax.random.fold_in(shared, index), (3,))
    found = least_squares(lambda x: jnp.sin(x - goal) + 0.1 * x, jnp.zeros(3), max_steps=20)
    return found.value, goal


@pytest.mark.slow
def test_searches_work_in_a_batch():
    """lineax compares shapes with shardings, which a plain shard_map would give it."""
    value, goal = run_batch(search, jax.random.key(0), 3)
    np.testing.assert_allclose(np.sin(value - goal) + 0.1 * value, 0.0, atol=1e-6)
