"""A record in chunks gives what it gives in memory, and never lies in memory whole."""

import inspect
import weakref

import numpy as np
import pytest

from lpvid._results import Status
from lpvid.data import IOData
from lpvid.identify import Chunks, PastOutputMOESP, _chunks, identify

from .helpers import common_problem, respond, sorted_poles

DT = 1 / 50
METHOD = PastOutputMOESP(order=6, block_rows=8, offset=True)


@pytest.fixture(autouse=True)
def small_pieces(monkeypatch):
    monkeypatch.setattr(_chunks, "_PIECE", 512)


def chunked(u, y, cuts):
    """Chunks that end at `cuts`, read anew for every pass."""

    def source():
        for first, last in zip([0, *cuts], [*cuts, len(u)], strict=True):
            yield IOData(u=u[first:last], y=y[first:last], dt=DT)

    return Chunks(source)


@pytest.mark.parametrize("noise", [True, False])
def test_chunks_give_what_the_whole_record_gives(noise):
    """By the Gram matrix with noise, by reflections without; 512 samples do not divide 1300."""
    u, clean, noisy = common_problem(1300)
    y = (noisy if noise else clean) + np.array([3.0, -2.0])
    whole = identify(IOData(u=u, y=y, dt=DT), METHOD)
    fit = identify(chunked(u, y, [2, 30, 700, 1100]), METHOD)
    assert bool(fit.stats["reflections"]) == bool(whole.stats["reflections"]) == (not noise)
    assert fit.status == Status.successful
    close = dict(rtol=1e-6, atol=1e-9)
    values = np.asarray(whole.singular_values[:6])
    np.testing.assert_allclose(fit.singular_values[:6], values, rtol=1e-7)
    np.testing.assert_allclose(sorted_poles(fit.model.A), sorted_poles(whole.model.A), atol=1e-9)
    # One basis, up to signs: compare what both basis and signs leave alone.
    np.testing.assert_allclose(fit.model.C @ fit.model.B, whole.model.C @ whole.model.B, **close)
    np.testing.assert_allclose(fit.model.D, whole.model.D, **close)
    np.testing.assert_allclose(fit.model.C @ fit.x0[0], whole.model.C @ whole.x0[0], **close)
    np.testing.assert_allclose(fit.output_offset, whole.output_offset, rtol=1e-6)
    np.testing.assert_allclose(
        fit.stats["residual_std"], whole.stats["residual_std"], rtol=1e-6, atol=1e-6
    )
    if noise:
        np.testing.assert_allclose(fit.innovation_covariance, whole.innovation_covariance, **close)


def test_at_most_two_chunks_exist_at_a_time():
    u, _, y = common_problem(6000)
    alive, most = [], 0

    def source():
        nonlocal most
        for first in range(0, len(u), 600):
            chunk = IOData(u=u[first : first + 600], y=y[first : first + 600], dt=DT)
            # The samples themselves, which views of them keep alive too.
            alive.append(weakref.ref(chunk.u))
            most = max(most, sum(known() is not None for known in alive))
            yield chunk
            del chunk

    fit = identify(Chunks(source), METHOD)
    assert fit.status == Status.successful
    assert most <= 3  # the one for the channel names, the one at work, the one being read


@pytest.mark.slow
def test_arrays_on_disk(tmp_path):
    u, _, y = common_problem(1301)
    for name, signal in (("u", u), ("y", y)):
        np.save(tmp_path / f"{name}.npy", signal)
    on_disk = [np.load(tmp_path / f"{name}.npy", mmap_mode="r") for name in "uy"]
    # 100 divides 1300: the last sample alone goes with the chunk before it.
    fit = identify(Chunks.of_arrays(*on_disk, DT, size=100), METHOD)
    whole = identify(chunked(u, y, []), METHOD)
    np.testing.assert_allclose(fit.model.D, whole.model.D, rtol=1e-9)
    assert fit.moments.columns == 1301 - 15


def test_faults_name_the_chunk():
    u, _, y = common_problem(200)

    def source(**changes):
        def chunks():
            yield IOData(u=u[:100], y=y[:100], dt=DT)
            yield IOData(**(dict(u=u[100:], y=y[100:], dt=DT) | changes))

        return Chunks(chunks)

    with pytest.raises(ValueError, match="Chunk 1 has dt=0.03 s but chunk 0 has dt=0.02"):
        identify(source(dt=0.03), METHOD)
    with pytest.raises(ValueError, match=r"Chunk 1 has the channels \('a', 'u2'\)"):
        identify(source(names={"u": ("a", "u2")}), METHOD)
    with pytest.raises(ValueError, match="Chunk 1 holds 2 records"):
        identify(source(u=[u[:50], u[50:100]], y=[y[:50], y[50:100]]), METHOD)
    with pytest.raises(ValueError, match="200 samples, but block_rows=30"):
        identify(source(), PastOutputMOESP(order=6, block_rows=30))
    with pytest.raises(ValueError, match="can be read only once"):
        inspect.unwrap(Chunks.__init__)(object.__new__(Chunks), iter([]))
    with pytest.raises(ValueError, match="gave no chunks"):
        identify(Chunks(lambda: []), METHOD)


def test_constant_channels_are_found_over_all_chunks():
    u, _, y = common_problem(1300)
    still = np.column_stack([u[:, 0], np.full(1300, 3.0)])
    with pytest.raises(ValueError, match="Input 'u2' is constant"):
        identify(chunked(still, y, [600]), METHOD)


def test_weak_excitation_is_judged_on_all_chunks():
    """Two frequencies, of which the first piece shows one: the other has yet to grow."""
    u, _, y = common_problem(1300)
    time = np.arange(1300)
    sines = np.sin(0.3 * time) + np.exp(0.035 * (time - 1300)) * np.sin(1.1 * time)
    with pytest.raises(ValueError, match="Input 'u2' excites 4 of the 16"):
        identify(chunked(np.column_stack([u[:, 0], sines]), y, [2, 30, 700]), METHOD)


def test_an_unstable_window_longer_than_a_piece():
    """The residual is that of the samples used: one piece of 512, not a window of 694."""
    rng = np.random.default_rng(4)
    u, noise = rng.standard_normal((2, 1400, 1))
    y = respond(([[1.01]], [[1.0]], [[1.0]], [[0.0]]), u) + 0.5 * noise
    with pytest.warns(UserWarning, match="unstable"):
        fit = identify(chunked(u, y, [600]), PastOutputMOESP(order=1, block_rows=8))
    model = (fit.model.A, fit.model.B, fit.model.C, fit.model.D)
    missed = y[:512] - respond(model, u[:512], fit.x0[0])
    rms = np.sqrt(np.mean(missed**2))
    np.testing.assert_allclose(fit.stats["residual_std"], rms, rtol=1e-4)
    assert fit.moments.dilution == pytest.approx(512 / (512 - 3))


@pytest.mark.slow
def test_memory_does_not_grow_with_the_record(monkeypatch):
    """What NumPy holds at most, by tracemalloc, for records a hundred times as long."""
    import tracemalloc

    monkeypatch.setattr(_chunks, "_PIECE", 4096)
    u, _, y = common_problem(4096)

    def peak(repeats):
        def source():
            for _ in range(repeats):
                yield IOData(u=u, y=y, dt=DT)

        tracemalloc.start()
        identify(Chunks(source), PastOutputMOESP(order=6, block_rows=8))
        found = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return found

    peak(2)
    short, long = peak(3), peak(300)
    assert long < 1.5 * short
