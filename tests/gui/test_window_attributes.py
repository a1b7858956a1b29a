"""Every attribute that the window's classes read of themselves exists.

The type checker cannot see it: the types of PyQt5 give QObject a `__getattr__`, so any name passes.
"""

import ast
import importlib
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")

import wavefocus.gui

FOLDER = Path(wavefocus.gui.__file__).resolve().parent
MODULES = sorted(path.relative_to(FOLDER) for path in FOLDER.rglob("*.py"))


def classes_in(path: Path) -> Iterator[tuple[ast.ClassDef, type]]:
    """The classes at the top of a module: as text, and as objects."""
    name = ".".join(["wavefocus.gui", *path.with_suffix("").parts]).removesuffix(".__init__")
    module = importlib.import_module(name)
    for node in ast.parse((FOLDER / path).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ClassDef):
            yield node, getattr(module, node.name)


def attributes(node: ast.AST, context: type[ast.expr_context]) -> set[str]:
    """Names that are read (Load) or set (Store) of `self`."""
    return {
        one.attr
        for one in ast.walk(node)
        if isinstance(one, ast.Attribute) and isinstance(one.value, ast.Name) and one.value.id == "self"
        and isinstance(one.ctx, context)
    }  # fmt: skip


def missing(node: ast.ClassDef, kind: type, set_in: dict[type, set[str]]) -> set[str]:
    """Names that a class reads of itself, and that neither it nor a base has."""
    held = set(dir(kind))
    for base in kind.__mro__:
        held |= set_in.get(base, set()) | set(getattr(base, "__annotations__", ()))
    return attributes(node, ast.Load) - held


@pytest.fixture(scope="module")
def set_in():
    """What the methods of each class of the window set."""
    return {kind: attributes(node, ast.Store) for path in MODULES for node, kind in classes_in(path)}


def test_given_all_classes_of_the_window_then_what_they_read_of_themselves_exists(set_in):
    assert len(set_in) > 60
    found = {
        f"{path.as_posix()}: {node.name}": names
        for path in MODULES
        for node, kind in classes_in(path)
        if (names := missing(node, kind, set_in))
    }
    assert found == {}
