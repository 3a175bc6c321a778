"""The order of the rooms, and who may import what, read from the sources."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "lpvid"
# Each room imports from rooms to its left and from itself.
ORDER = (
    "_runtime _types _files _results _linalg data effects _solve _batch models analysis mechanics "
    "identify refinement restructure interpolate reduce control loop plot io montecarlo study "
    "report commands __main__"
).split()
MODULES = sorted(path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py"))
MODULES.remove(Path("__init__.py"))


def room(module: Path) -> str:
    return module.parts[0].removesuffix(".py")


def name_of(module: Path) -> str:
    parts = module.with_suffix("").parts
    return ".".join(("lpvid", *(parts[:-1] if parts[-1] == "__init__" else parts)))


def tree_of(module: Path) -> ast.Module:
    return ast.parse((PACKAGE / module).read_text())


def imports(module: Path, *, top_level: bool = False) -> set[str]:
    """Full names of what a module imports, `package.module.name` for `from` imports."""
    tree = tree_of(module)
    nodes = _outside_functions(tree) if top_level else ast.walk(tree)
    names = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def _outside_functions(node):
    """What runs on import: neither bodies of functions nor what type checkers alone read."""
    for child in ast.iter_child_nodes(node):
        typing_only = isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING"
        if not isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef) and not typing_only:
            yield child
            yield from _outside_functions(child)


def own(names: set[str]) -> set[str]:
    return {name for name in names if name == "lpvid" or name.startswith("lpvid.")}


def external(names: set[str]) -> set[str]:
    return {name.split(".")[0] for name in names}


def test_there_is_something_to_check():
    assert len(MODULES) > 50
    assert "lpvid.models.StateSpace" in imports(Path("restructure/_matching.py"))


@pytest.mark.parametrize("module", MODULES, ids=str)
def test_rooms_are_known_and_imports_run_one_way(module):
    assert room(module) in ORDER, f"{module} belongs to no room"
    place = ORDER.index(room(module))
    for name in own(imports(module)):
        if name.startswith("lpvid.__version__"):
            continue
        other = name.split(".")[1] if "." in name else ""
        assert other in ORDER, f"{module} imports {name}: import from the room itself"
        assert ORDER.index(other) <= place, f"{module} imports upwards: {name}"


@pytest.mark.parametrize("module", MODULES, ids=str)
def test_private_files_stay_in_their_room(module):
    for name in own(imports(module)):
        parts = name.split(".")
        if len(parts) > 2 and parts[2].startswith("_"):
            inside_folder = (PACKAGE / parts[1]).is_dir()
            foreign = parts[1] != room(module)
            assert not (inside_folder and foreign), f"{module} imports a private file: {name}"


def test_no_cycles_between_modules():
    known = {name_of(module): module for module in MODULES}
    edges = {}
    for name, module in known.items():
        targets = set()
        for imported in own(imports(module, top_level=True)):
            # The longest prefix that is a module: `from room import Name` means the room.
            parts = imported.split(".")
            while parts and ".".join(parts) not in known:
                parts.pop()
            if parts and ".".join(parts) != name:
                targets.add(".".join(parts))
        edges[name] = targets
    done, path = set(), []

    def visit(name):
        assert name not in path, f"cycle: {' -> '.join([*path[path.index(name) :], name])}"
        if name in done:
            return
        path.append(name)
        for target in sorted(edges[name]):
            visit(target)
        path.pop()
        done.add(name)

    for name in edges:
        visit(name)


@pytest.mark.parametrize("solver", ["optimistix", "jaxopt"])
def test_solvers_are_called_in_one_place(solver):
    users = [str(module) for module in MODULES if solver in external(imports(module))]
    assert users == ["_solve.py"]


def test_matplotlib_waits_until_a_figure_is_drawn():
    early = [m for m in MODULES if "matplotlib" in external(imports(m, top_level=True))]
    assert early == []


@pytest.mark.parametrize("module", MODULES, ids=str)
def test_modules_are_short_and_named_by_what_they_do(module):
    assert len((PACKAGE / module).read_text().splitlines()) < 400
    assert "utils" not in module.stem and "helpers" not in module.stem


@pytest.mark.parametrize(
    "module", [m for m in MODULES if room(m) not in ("commands", "__main__")], ids=str
)
def test_only_the_command_line_prints(module):
    calls = [
        node.lineno
        for node in ast.walk(tree_of(module))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id == "print"
    ]
    assert calls == []


def test_the_top_re_exports_and_nothing_else():
    allowed = ast.Import | ast.ImportFrom | ast.Assign | ast.Expr
    assert all(isinstance(node, allowed) for node in tree_of(Path("__init__.py")).body)
