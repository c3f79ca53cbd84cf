"""What benches and fuzzers import is there: the suite runs none of them, so a name that moved would go unnoticed."""

from __future__ import annotations

import ast
from importlib import import_module
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]
FILES = sorted(path for folder in ("bench", "fuzz") for path in (TESTS / folder).glob("*.py"))


def is_there(module: str, name: str) -> bool:
    if hasattr(import_module(module), name):
        return True
    try:
        return bool(import_module(f"{module}.{name}"))
    except ModuleNotFoundError:
        return False


def missing_names(text: str) -> list[str]:
    """Names that a file imports from this project, anywhere in it, and that aren't there."""
    asked = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ImportFrom)]
    ours = [node for node in asked if node.module.split(".")[0] in ("dpcli", "tests")]
    return [f"{node.module}.{one.name}" for node in ours for one in node.names if not is_there(node.module, one.name)]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_what_is_imported_is_there(path):
    assert missing_names(path.read_text("utf-8")) == []


def test_a_name_that_moved_is_found():
    assert missing_names("def f():\n    from dpcli.evaluate.results import nothing") == [
        "dpcli.evaluate.results.nothing"
    ]
