"""Records with known truth in files, and a command line without a cache of compiled code."""

import numpy as np
import pytest

from .record_files import write_table


@pytest.fixture(autouse=True)
def no_cache(monkeypatch):
    monkeypatch.setenv("LPVID_NO_CACHE", "1")
    monkeypatch.delenv("LPVID_DEBUG", raising=False)


@pytest.fixture(scope="session")
def tables(tmp_path_factory):
    """Files at three operating points, one between them, and one along a schedule."""
    folder = tmp_path_factory.mktemp("records")
    steps = np.repeat(np.linspace(0.1, 0.9, 20), 30)
    made = {
        str(kappa): write_table(
            folder / f"at{kappa}.csv", np.full(800, kappa), seed, 1e-3, (0.3, -2.0)
        )
        for seed, kappa in enumerate((0.0, 0.5, 1.0, 0.25))
    }
    made["sweep"] = write_table(folder / "sweep.csv", steps, 9)
    return made
