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
    setting_faults,
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
        if "NAME" not in path and not list(ROOT.glob(path.rstrip("/"))):
            yield f"{path}: there is no such file or folder"
    for name in MODULE.findall(text):
        if not module_exists(name):
            yield f"{name}: there is no such module, nor a name in it"
    for package, names in re.findall(r"from (dpcli[\w.]*) import (\w+(?:, \w+)*)", text):
        missing = [name for name in names.split(", ") if not module_exists(f"{package}.{name}")]
        yield from (f"{package} has no {name}" for name in missing)
    for span in spans(text):
        if (
            re.fullmatch(r"[a-z][\w/]*\.py", span)
            and "NAME" not in span
            and not called(span)
            and f"Save this as `{span}`" not in text
        ):
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
            room = Has(dpc().below.get(about, anything()).options, anything().settings)
            yield from option_faults(re.split(r"[ /]|, ", span), room, about or "dpc")
        elif about in dpc().below and re.fullmatch(r"[a-z_]+=\S+", span):
            yield from setting_faults(span, anything(), "dpc")


@cache
def anything() -> Has:
    """What any command, or a program behind a goal of the Makefile, takes."""
    programs = [ROOT / file for file in FILES if file.startswith(("dpcli/reproduce", "tests/fuzz"))]
    options = {name for path in programs for name in re.findall(r'"(--[a-z][\w-]*)"', path.read_text())}
    return Has(dpc().options | dict.fromkeys(options, set()), dpc().settings)


@each_document()
def test_commands_options_and_settings_exist(document):
    text, _, _ = document.read_text().partition("\n### Changed")  # what changed names what is no more
    page = document.stem if document.parent.name == "docs" else ""
    assert list(command_faults(text, PAGE_OF.get(page, page))) == []


def test_the_documents_hold_many_commands():
    found = [words for one in documents() for code in code_blocks(one.read_text()) for words in commands(code)]
    found += [words for one in documents() for code in spans(one.read_text()) for words in commands(code)]
    assert len(found) > 200
    assert len({tuple(words[:2]) for words in found}) > 30


GIVEN = [
    f"{name}=raw"
    for name in "MSRACTION NVGESTURE SHREC17 NTU60 MODELNET SAPIEN MESHES KITTI_SF KITTI_DET SEMANTICKITTI".split()
]


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
@pytest.mark.parametrize("given", [GIVEN, []], ids=["with data", "without"])
def test_the_goals_of_the_makefile_run_commands_that_exist(given, tmp_path):
    makefile = (ROOT / "Makefile").read_text()
    goals = sorted(
        set(re.findall(r"^((?:table|figure)-[\w.]+|demo|bench|fuzz|soak|prior)[ :]", makefile, re.MULTILINE))
    )
    words = ["make", "-n", f"VENV={tmp_path}", *given, *(goals if given else ["demo"])]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, env={**os.environ, "MAKEFLAGS": ""})
    assert done.returncode == 0, done.stderr
    found = list(commands(done.stdout))
    assert len(found) >= (25 if given else 12) and [fault for words in found for fault in faults(words)] == []
    modules = re.findall(r"-m ((?:dpcli|tests)[\w.]+)", done.stdout)
    assert len(modules) > 10 or not given
    assert [name for name in modules if not module_exists(name)] == []


def test_every_goal_of_the_makefile_runs_though_a_folder_has_its_name():
    """Such as soak/ and demo/, which the goals themselves make."""
    makefile = (ROOT / "Makefile").read_text()
    goals = set(re.findall(r"^([a-z][\w.-]*(?: [a-z][\w.-]*)*):(?!=)", makefile, re.MULTILINE))
    phony = set(" ".join(re.findall(r"^\.PHONY: (.*)", makefile, re.MULTILINE)).split())
    assert {goal for line in goals for goal in line.split()} == phony


# The page that tells where things are


def tree(text: str) -> set[str]:
    """The folders that a drawn tree names, at the beginnings of lines and in the words behind."""
    found: set[str] = set()
    above: list[tuple[int, str]] = []
    for line in text.splitlines():
        depth, (first, *words) = len(line) - len(line.lstrip()), line.split()
        above = [one for one in above if one[0] < depth]
        above.append((depth, first))
        folder = "".join(name for _, name in above)
        found |= {folder, *(folder + word for word in words if re.fullmatch(r"\w+/", word))}
    return {folder.rstrip("/") for folder in found}


def folders() -> set[str]:
    """The folders of the package, but for the link to the recipes."""
    with_files = {Path(file).parent for file in FILES if file.startswith("dpcli/")}
    every = with_files | {above for one in with_files for above in one.parents}
    return {str(one) for one in every if one.parts[:1] == ("dpcli",) and "data_recipes" not in one.parts}


def test_the_tree_shows_the_folders_that_there_are():
    drawn = re.search(r"<!-- tree -->\n\n((?: +\S.*\n)+)", ARCHITECTURE.read_text())[1]
    assert tree("\n".join(line[4:] for line in drawn.splitlines())) == folders()


def where_is() -> dict[str, tuple[list[str], list[str]]]:
    """The tables of terms, the thesis's among them: the files of each, and the names to begin at."""
    of_the_thesis = (ROOT / "docs" / "glossary.md").read_text().partition("\n## Words of the thesis")[2]
    tables = ARCHITECTURE.read_text() + of_the_thesis
    rows = re.findall(r"^\| (.*?) \| (.*`.*) \| (.*)\|$", tables, re.MULTILINE)
    cells = {term: tuple(re.findall(r"`([^`]+)`", cell) for cell in rest) for term, *rest in rows}
    return {term: both for term, both in cells.items() if any("/" in file for file in both[0])}


@pytest.mark.parametrize("term", where_is())
def test_a_term_is_where_the_table_says(term):
    paths, names = where_is()[term]
    assert [path for path in paths if not (ROOT / "dpcli" / path).is_file()] == []
    known = set().union(*(defined(f"dpcli/{path}") for path in paths))
    assert [name for name in names if name not in known] == []


def test_a_term_of_the_thesis_is_found_in_the_code_itself():
    """One of a row's words is written where the row leads, so that a search through the code finds it, too."""
    of_the_thesis = (ROOT / "docs" / "glossary.md").read_text().partition("\n## Words of the thesis")[2]
    rows = {term: files for term, (files, _) in where_is().items() if f"\n| {term} |" in of_the_thesis}
    assert len(rows) > 35
    for term, files in rows.items():
        code = " ".join(" ".join((ROOT / "dpcli" / file).read_text() for file in files).lower().split())
        words = [re.sub(r" [A-Zβτα]$", "", word.strip()).lower() for word in re.split(r"[,;()]|`[^`]*`", term)]
        assert any(word in code for word in words if word and not word.startswith("equation")), term


# Terms of the field, and the word by which a stranger looks for each.
TERMS = {
    "surface solver": "surface",
    "consensus loss": "consensus",
    "weighted Kabsch": "kabsch",
    "cross-view split": "cross_view",
    "SDS loss": "sds",
    "FVD's feature extractor": "feature",
    "HDF5 schema": "schema",
    "resume journal": "journal",
    "icosahedral group": "icosahedral",
    "densification": "densify",
    "FlowStep3D network": "flowstep3d",
    "confusion matrix picture": "confusion",
    "presets `quick`": "presets",
    "Hungarian part matching": "hungarian",
    "learning-rate schedule": "learning_rate",
    "Wilson interval": "wilson",
    "rigid/non-rigid blend": "blend",
    "point activation cloud": "activation_cloud",
}


@pytest.mark.parametrize("term", TERMS)
def test_a_term_is_found_by_a_word_of_its_own(term):
    """Its word is in the name of a file that the table gives, or of a function to begin at there."""
    rows = [both for name, both in where_is().items() if term in name]
    assert len(rows) == 1
    files, names = rows[0]
    assert any(TERMS[term] in word.lower() for word in (*map(os.path.basename, files), *names))


# The checks themselves


WRONG = """# A page

See [there](nowhere.md), [below](#no-such-heading) and [here](#a-page).

    dpc prepare nothing RAW -o x.h5
    T="--set no_such_setting=1"
    dpc classify train x.h5 --no-such-option -o run $T   # runs on

`dpc segment train x.h5 --preset compact --set neighbours=3`, `dpc evaluate | dpc info -`, `--no-such-flag`;
BUDGET="--epoch 3". `NO_SUCH_NAME` in `dpcli/evaluate/choices.py`, `TOP_K` in `dpcli/evaluate/choices.py`,
`dpcli/nowhere/`, `dpcli.ops.nothing`, `no_such_file.py`.
"""


@pytest.mark.parametrize(
    "check, expected",
    [
        (lambda text: link_faults(ROOT / "README.md", text), ["nowhere.md", "#no-such-heading"]),
        (path_faults, ["dpcli/nowhere/", "dpcli.ops.nothing", "no_such_file.py"]),
        (name_faults, ["NO_SUCH_NAME"]),
        (
            command_faults,
            [
                "no command nothing",
                "no option --no-such-option",
                "no setting no_such_setting",
                "no setting neighbours",
                "no option --epoch",
                "no option --no-such-flag",
            ],
        ),
    ],
)
def test_each_fault_is_found(check, expected):
    found = list(check(WRONG))
    assert len(found) == len(expected)
    for words, fault in zip(expected, found):
        assert words in fault
