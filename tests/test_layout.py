"""Layout of the program: imports go downward, class names are unique, docstrings stand alone."""

from __future__ import annotations

import ast
import functools
from collections import Counter
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path
from typing import TypeVar

Node = TypeVar("Node", bound=ast.AST)

_ROOT = Path(__file__).parents[1]
_FLOORS = (
    ("base",),
    ("scene",),
    ("simulate", "scenes"),
    ("adapters", "reference", "report"),
    ("checks",),
    ("measure",),
    ("dataset",),
    ("learn",),
    ("testing",),
    ("studies",),
    ("api", "__init__", "commands", "__main__"),
)
"""Packages and top-level modules from the bottom up; each imports from its own floor and below."""
_FRAGMENTS = ("Of ", "Its ", "Their ", "Whose ", "In which ", "By which ", "Beside ")
"""Openings of docstrings that only continue the name above them."""
_MOST_LINES = 400
_FLOOR = {name: floor for floor, names in enumerate(_FLOORS) for name in names}


def _sources() -> Iterator[Path]:
    for folder in ("mbds_xsim", "adapters", "scenes"):
        yield from sorted((_ROOT / folder).rglob("*.py"))


def _module(path: Path) -> str:
    parts = path.relative_to(_ROOT).with_suffix("").parts
    name = ".".join(parts if parts[0] == "mbds_xsim" else (f"mbds_xsim_{parts[0]}", *parts[1:]))
    return name.removesuffix(".__init__")


_MODULES = {_module(path): path for path in _sources()}


@functools.cache
def _tree(module: str) -> ast.Module:
    return ast.parse(_MODULES[module].read_text("utf-8"))


def _imported(tree: ast.AST, *, types: bool) -> Iterator[str]:
    """Yield the modules of the program that a module imports, also inside functions."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING" and not types:
            continue
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                yield inner if inner in _MODULES else node.module
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        else:
            yield from _imported(node, types=types)


def _package(module: str) -> str:
    first, *rest = module.split(".")
    return first.removeprefix("mbds_xsim_") if first != "mbds_xsim" else [*rest, "__init__"][0]


def _graph(*, types: bool) -> dict[str, set[str]]:
    return {
        name: {other for other in _imported(_tree(name), types=types) if other in _MODULES} - {name}
        for name in _MODULES
    }


def _imports() -> Iterator[tuple[str, str]]:
    for name, others in _graph(types=True).items():
        yield from ((name, other) for other in others)


def _nodes(kind: type[Node]) -> Iterator[tuple[str, Node]]:
    """Yield the nodes of a kind, each with the name of its module."""
    for name in _MODULES:
        yield from ((name, node) for node in ast.walk(_tree(name)) if isinstance(node, kind))


def test_imports_go_downward() -> None:
    upward = [
        f"{name} imports {other}"
        for name, other in _imports()
        if _FLOOR[_package(other)] > _FLOOR[_package(name)]
    ]

    assert not upward


def test_packages_of_a_floor_do_not_import_each_other() -> None:
    beside = [
        f"{name} imports {other}"
        for name, other in _imports()
        if _package(other) != _package(name)
        and _FLOOR[_package(other)] == _FLOOR[_package(name)] < len(_FLOORS) - 1
    ]

    assert not beside


def test_nothing_imports_in_circles() -> None:
    TopologicalSorter(_graph(types=False)).prepare()  # names a circle where there is one


def test_no_class_name_stands_twice() -> None:
    names = Counter(node.name for _, node in _nodes(ast.ClassDef))

    assert [name for name, count in names.items() if count > 1] == []


def test_no_module_imports_private_names() -> None:
    private = [
        f"{name} imports {alias.name} of {node.module}"
        for name, node in _nodes(ast.ImportFrom)
        for alias in node.names
        if alias.name.startswith("_")
    ]

    assert not private


def test_modules_are_short() -> None:
    lines = {name: path.read_text("utf-8").count("\n") for name, path in _MODULES.items()}

    assert {name: count for name, count in lines.items() if count > _MOST_LINES} == {}


def test_docstrings_stand_alone() -> None:
    fragments = [
        f"{name}:{node.lineno}: {text}"
        for name, node in _nodes(ast.Expr)
        if isinstance(node.value, ast.Constant)
        and (text := str(node.value.value)).startswith(_FRAGMENTS)
    ]

    assert not fragments
