"""The documents against the project: links, paths, names, and every `dpc` command that a reader could type."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from tests.support.documents import (
    ROOT,
    Has,
    anchors,
    assigned,
    code_blocks,
    commands,
    documents,
    dpc,
    faults,
    links,
    option_faults,
    spans,
)

ARCHITECTURE = ROOT / "docs" / "architecture.md"
PATH = re.compile(r"(?<![\w./-])(?:dpcli|tests|docs|data_recipes)/[\w./*-]*[\w*/]")
MODULE = re.compile(r"(?<![\w/])(?:dpcli|tests)(?:\.\w+)+")
# Variables of the Makefile that hold words for a command.
WORDS_FOR = {
    "BUDGET": ("classify", "train"),
    "MORE": ("classify", "train"),
    "PRETRAIN": ("classify", "train"),
    "DEMO_TRAIN": ("classify", "train"),
    "T42_TRAIN": ("segment", "train"),
    "PREPARE": ("prepare",),
}

# Pages about a room that don't bear its name.
PAGE_OF = {"explain": "classify", "classify_stream": "classify", "backbones": "classify", "priors": "generate4d"}


def each_document(of=documents):
    return pytest.mark.parametrize("document", of(), ids=lambda path: str(path.relative_to(ROOT)))


# Links


def link_faults(document: Path, text: str) -> Iterator[str]:
    for target in links(text):
        path, _, anchor = target.partition("#")
        file = (document.parent / path) if path else document
        if not file.exists():
            yield f"{target}: there is no such file"
        elif anchor and anchor not in anchors(text if file == document else file.read_text()):
            yield f"{target}: the page has no such heading"


@each_document()
def test_links_and_anchors_resolve(document):
    assert list(link_faults(document, document.read_text())) == []


# Paths, modules and names


def files() -> list[str]:
    """Every file of the project that a document may name, from the project's folder on."""
    folders = [ROOT / name for name in ("dpcli", "tests", "docs", "data_recipes", ".ci")]
    inside = [path for folder in folders for path in folder.rglob("*") if "__pycache__" not in path.parts]
    return [str(path.relative_to(ROOT)) for path in (*inside, *ROOT.glob("*.*")) if path.is_file()]


FILES = files()


def called(name: str) -> list[str]:
    """The files that a path means, given from the project's folder on or from any folder in it."""
    return [file for file in FILES if file == name or file.endswith(f"/{name}")]


@cache
def defined(file: str) -> set[str]:
    """The names that a file of Python defines: functions, classes, their methods and fields, and variables."""
    nodes = list(ast.walk(ast.parse((ROOT / file).read_text())))
    named = {node.name for node in nodes if isinstance(node, (ast.FunctionDef, ast.ClassDef))}
    return named | {node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}


def module_exists(name: str) -> bool:
    """Whether a dotted name is a module of the project, or a name that one defines."""
    path = ROOT.joinpath(*name.split("."))
    if path.is_dir() or path.with_suffix(".py").is_file():
        return True
    above = path.parent.with_suffix(".py") if path.parent.with_suffix(".py").is_file() else path.parent / "__init__.py"
    return above.is_file() and re.search(rf"\b{path.name}\b", above.read_text()) is not None


def path_faults(text: str) -> Iterator[str]:
    for path in PATH.findall(text):
        if not "NAME" in path and not list(ROOT.glob(path.rstrip("/"))):
            yield f"{path}: there is no such file or folder"
    for name in MODULE.findall(text):
        if not module_exists(name):
            yield f"{name}: there is no such module, nor a name in it"
    for package, names in re.findall(r"from (dpcli[\w.]*) import (\w+(?:, \w+)*)", text):
        missing = [name for name in names.split(", ") if not module_exists(f"{package}.{name}")]
        yield from (f"{package} has no {name}" for name in missing)
    for span in spans(text):
        if re.fullmatch(r"[a-z][\w/]*\.py", span) and "NAME" not in span and not called(span) and f"Save this as `{span}`" not in text:
            yield f"{span}: there is no such file"


@each_document()
def test_paths_and_modules_exist(document):
    assert list(path_faults(document.read_text())) == []


def name_faults(text: str) -> Iterator[str]:
    """Names said to be in a file, as "`PRIORS` in `config.py`", that it does not define."""
    said = " ".join(text.split())
    for name, file in re.findall(r"`([A-Za-z_]\w*)(?:\(\))?`,? (?:in|of) `([\w/.]+\.py)`", said):
        if called(file) and not any(name in defined(one) for one in called(file)):
            yield f"{file} has no {name}"


@each_document()
def test_names_are_in_the_files_that_are_said_to_have_them(document):
    assert list(name_faults(document.read_text())) == []


def test_contributing_uses_words_that_the_code_uses():
    code = "\n".join((ROOT / file).read_text() for file in FILES if file.endswith((".py", ".toml", "Makefile")))
    known = set(re.findall(r"\w+", code))
    for span in spans((ROOT / "CONTRIBUTING.md").read_text()):
        if re.fullmatch(r"@?[A-Za-z_]\w*", span) and span != "NAME":
            assert span.lstrip("@") in known, f"CONTRIBUTING.md: nothing is called {span}"


# Commands


def command_faults(text: str, about: str = "") -> Iterator[str]:
    """Commands, options and settings that don't exist. about: the room whose page this is, if it is one's."""
    for code in [*code_blocks(text), *spans(text)]:
        for words in commands(code):
            yield from (f"{fault}, in: dpc {' '.join(words)}" for fault in faults(words))
    for name, value in assigned(text):
        if name in WORDS_FOR:
            yield from faults([*WORDS_FOR[name], *value.split()])
    for span in spans(text):  # a few words of a command line
        if re.match(r"--?[a-z]", span):
            yield from option_faults(re.split(r"[ /,]+", span), dpc().below.get(about, anything()), about or "dpc")


@cache
def anything() -> Has:
    """What any command, or a program behind a goal of the Makefile, takes."""
    programs = [ROOT / file for file in FILES if file.startswith(("dpcli/reproduce", "tests/fuzz"))]
    options = {name for path in programs for name in re.findall(r'"(--[a-z][\w-]*)"', path.read_text())}
    return Has(dpc().options | options, dpc().settings)


@each_document()
def test_commands_options_and_settings_exist(document):
    text, page = document.read_text(), document.stem if document.parent.name == "docs" else ""
    assert list(command_faults(text, PAGE_OF.get(page, page))) == []


def test_the_documents_hold_many_commands():
    found = [words for one in documents() for code in code_blocks(one.read_text()) for words in commands(code)]
    found += [words for one in documents() for code in spans(one.read_text()) for words in commands(code)]
    assert len(found) > 200
    assert len({tuple(words[:2]) for words in found}) > 30


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
@pytest.mark.parametrize("data", ["MSRACTION", "NVGESTURE"])
def test_the_goals_of_the_makefile_run_commands_that_exist(data, tmp_path):
    makefile = (ROOT / "Makefile").read_text()
    goals = sorted(set(re.findall(r"^((?:table|figure)-[\w.]+|demo|bench|fuzz)[ :]", makefile, re.MULTILINE)))
    given = ["MSRACTION=raw", "SHREC17=raw", "NTU60=raw", "SAPIEN=raw", "MESHES=raw", f"{data}=raw", "NVGESTURE=raw"]
    done = subprocess.run(
        ["make", "-n", f"VENV={tmp_path}", *given, *goals],
        cwd=ROOT,
        capture_output=True,
        text=True,
        env={**os.environ, "MAKEFLAGS": ""},
    )
    assert done.returncode == 0, done.stderr
    found = list(commands(done.stdout))
    assert len(found) > 25 and [fault for words in found for fault in faults(words)] == []
    modules = re.findall(r"-m ((?:dpcli|tests)[\w.]+)", done.stdout)
    assert len(modules) > 10 and [name for name in modules if not module_exists(name)] == []


# The page that tells where things are
