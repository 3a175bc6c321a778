"""The README's example runs as it is printed."""

import re
from pathlib import Path

import numpy as np
import pytest

README = Path(__file__).resolve().parents[1] / "README.md"


@pytest.mark.slow
def test_the_example_runs_and_the_model_fits():
    (example,) = re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.DOTALL)
    printed = []
    namespace = {"print": printed.append}
    exec(compile(example, "README.md", "exec"), namespace)
    (score,) = printed
    assert np.all(np.asarray(score) > 80.0)


def test_pictures_and_files_named_exist():
    text = README.read_text()
    links = re.findall(r"\]\(([^)]+)\)", text)
    assert links
    for link in links:
        assert (README.parent / link).is_file(), link
