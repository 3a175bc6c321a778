"""Every notebook runs from top to bottom at a small size, and its executed copy is up to date."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
PAGES = sorted(FOLDER.glob("*.py"))


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_notebook_runs(page, tmp_path):
    environment = {**os.environ, "LPVID_NOTEBOOK_SIZE": "small", "MPLBACKEND": "Agg"}
    done = subprocess.run(
        [sys.executable, str(page)], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_executed_copy_has_the_same_cells(page):
    import jupytext

    executed = json.loads(page.with_suffix(".ipynb").read_text())
    code = [
        "".join(cell["source"]).strip() for cell in executed["cells"] if cell["cell_type"] == "code"
    ]
    source = jupytext.read(page)
    expected = [cell.source.strip() for cell in source.cells if cell.cell_type == "code"]
    assert code == expected
    assert all(
        cell["execution_count"] is not None
        for cell in executed["cells"]
        if cell["cell_type"] == "code"
    )
