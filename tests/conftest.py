"""Shapes and dtypes enforced, float64 everywhere, measured data found or skipped."""

import gc
import os
from pathlib import Path

# One BLAS thread per test process: the suite itself runs in parallel.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")

import jax
from jaxtyping import install_import_hook

_hook = install_import_hook("lpvid", "beartype.beartype")

import pytest  # noqa: E402

import lpvid  # noqa: E402, F401

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

ROOT = Path(__file__).resolve().parents[1]

# Compilation is most of the suite's time: what took long to compile is kept for the next run.
jax.config.update("jax_compilation_cache_dir", str(ROOT / ".jax_cache"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


# Linux lets a process have 65530 memory maps; every compiled function takes several, and LLVM
# aborts the process when there are no more.
MOST_MAPS = 15_000
MAPS = Path("/proc/self/maps")


@pytest.fixture(scope="module", autouse=True)
def bounded_compiled_code():
    """Forget compiled functions between files before they fill the process's memory maps."""
    yield
    if MAPS.exists() and MAPS.read_bytes().count(b"\n") > MOST_MAPS:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(scope="session")
def measured_data() -> Path:
    """Folder of the measured records, or a skip that says where they were looked for."""
    folder = Path(os.environ.get("LPVID_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"measured data not found in {folder}; set LPVID_DATA to its folder")
    return folder


def pytest_collection_modifyitems(items):
    """The longest file first: whole files go to one process each, and none is left to wait."""
    items.sort(key=lambda item: item.path.name != "test_examples.py")
