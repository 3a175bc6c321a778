"""The examples in the docstrings run, and show what comes out."""

import ast
import doctest
import importlib
import inspect
import pkgutil
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lpvid

FLAGS = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
# Modules whose examples take more than 5 s altogether, nearly all of it compilation.
SLOW = {
    "lpvid._solve",
    "lpvid.analysis._uncertainty",
    "lpvid.identify._methods",
    "lpvid.identify.gray_box._black_box",
    "lpvid.identify.gray_box._mechanical",
    "lpvid.loop._engine",
    "lpvid.mechanics._single_link_arm",
    "lpvid.mechanics._study_records",
    "lpvid.mechanics._two_link_arm",
    "lpvid.plot._search",
    "lpvid.refinement._profile",
    "lpvid.refinement._refine",
    "lpvid.restructure._restructure",
}
MODULES = sorted(module.name for module in pkgutil.walk_packages(lpvid.__path__, "lpvid."))


def public(name: str) -> dict[str, Any]:
    names = vars(importlib.import_module(name))
    return {key: value for key, value in names.items() if not key.startswith("_")}


def collected(name: str) -> list[doctest.DocTest]:
    """The examples in the docstrings of what a module defines."""
    module = importlib.import_module(name)
    # What an example may use without an import: what lpvid, the room and the module hold.
    room = ".".join(name.split(".")[:2])
    names = {"jax": jax, "jnp": jnp, "np": np} | public("lpvid") | public(room) | vars(module)
    # Object by object: the type checks of the tests wrap functions, and the finder, given the
    # module, would take those for functions of another one.
    own = {
        f"{name}.{key}": value
        for key, value in vars(module).items()
        if getattr(value, "__module__", None) == name
        and (inspect.isclass(value) or inspect.isroutine(inspect.unwrap(value)))
    }
    finder = doctest.DocTestFinder()
    return [
        test
        for title, value in ({name: module.__doc__} | own).items()
        for test in finder.find(value, title, module=False, globs=names)
    ]


def written(name: str) -> int:
    """Number of inputs in all docstrings of a module's source."""
    tree = ast.parse(inspect.getsource(importlib.import_module(name)))
    documented = ast.Module | ast.ClassDef | ast.FunctionDef
    texts = [ast.get_docstring(node) for node in ast.walk(tree) if isinstance(node, documented)]
    return sum(len(doctest.DocTestParser().get_examples(text)) for text in texts if text)


def test_slow_modules_exist():
    assert set(MODULES) >= SLOW


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in MODULES]
)
def test_examples_of_a_module_run(name, tmp_path, monkeypatch):
    tests = collected(name)
    assert sum(len(test.examples) for test in tests) == written(name)
    # Examples write files under bare names.
    monkeypatch.chdir(tmp_path)
    report = []
    for test in tests:
        doctest.DocTestRunner(optionflags=FLAGS, verbose=False).run(test, out=report.append)
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")
    assert not report, "\n" + "".join(report)
