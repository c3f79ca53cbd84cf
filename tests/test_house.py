"""The house: which room may import which, how full a folder may be, and that no import goes in a circle."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "dpcli"
COMMON = {
    "config_diff",
    "errors",
    "file_cache",
    "file_lock",
    "npy_files",
    "counted",
    "path_names",
    "regular_files",
    "text_files",
    "signal_exit",
    "standard_streams",
}  # files that every room may import
GROUND = {"store", "ops", "runtime", "draw"}
ALLOWED = {
    "store": {"runtime"},
    "ops": {"runtime"},
    "runtime": set(),
    "draw": {"ops", "runtime"},
    "prepare": GROUND,
    "classify": GROUND,
    "segment": GROUND,
    "generate4d": GROUND,
    "evaluate": GROUND,
}
FULL = 15  # modules in a folder, beside `__init__`


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


MODULES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}


@cache
def nodes(path: Path) -> list[ast.AST]:
    """What `ast.walk` finds in a file, the whole module first; many tests look at each file."""
    return list(ast.walk(ast.parse(path.read_text())))


def imported(path: Path) -> Iterator[str]:
    """The modules of the package that a file imports, wherever the import stands."""
    for node in nodes(path):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("dpcli"):
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                yield full if full in MODULES else str(node.module)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in MODULES)


@cache
def imports() -> dict[str, set[str]]:
    """Which modules of the package each module imports; only the process that runs these tests reads all files."""
    return {name: set(imported(path)) & set(MODULES) - {name} for name, path in MODULES.items()}


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """The groups of nodes that reach one another, each sorted; none where the graph has no circle."""

    def reachable(start: str) -> set[str]:
        seen, todo = set(), list(graph[start])
        while todo:
            node = todo.pop()
            if node not in seen:
                seen.add(node)
                todo.extend(graph[node])
        return seen

    reach = {node: reachable(node) for node in graph}
    groups = {tuple(sorted({node} | {other for other in reach[node] if node in reach[other]})) for node in graph}
    return sorted(list(group) for group in groups if len(group) > 1)


def folders_of(room: str) -> dict[str, set[str]]:
    """Which folders of a room import which others; files that lie in the room itself belong to none."""
    inside = {name: name.split(".") for name in MODULES if name.startswith(f"dpcli.{room}.") and name.count(".") > 2}
    graph: dict[str, set[str]] = {parts[2]: set() for parts in inside.values()}
    for name, parts in inside.items():
        graph[parts[2]] |= {inside[other][2] for other in imports()[name] if other in inside} - {parts[2]}
    return graph


@pytest.mark.parametrize("room", ALLOWED)
def test_a_room_imports_only_what_it_may(room):
    for name in MODULES:
        if name.startswith(f"dpcli.{room}"):
            rooms = {other.split(".")[1] for other in imports()[name] if other != "dpcli"} - {room, *COMMON}
            assert rooms <= ALLOWED[room], f"{name} imports {sorted(rooms - ALLOWED[room])}"


def test_every_room_is_known():
    rooms = {path.name for path in PACKAGE.iterdir() if (path / "__init__.py").is_file()}
    assert rooms == {*ALLOWED, "cli", "reproduce"}


def test_no_file_imports_itself_through_others():
    assert circles(imports()) == []


@pytest.mark.parametrize("room", [*ALLOWED, "cli"])
def test_no_folder_of_a_room_imports_itself_through_others(room):
    assert circles(folders_of(room)) == []


def test_circles_are_found():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]


def test_no_folder_is_too_full():
    for folder in {path.parent for path in MODULES.values()}:
        modules = [path for path in folder.glob("*.py") if path.name != "__init__.py"]
        assert len(modules) <= FULL, f"{folder.relative_to(ROOT)} holds {len(modules)} modules"


def test_every_folder_says_what_lives_there():
    for path in MODULES.values():
        if path.name == "__init__.py":
            assert ast.get_docstring(nodes(path)[0]), f"{path.relative_to(ROOT)} has no docstring"


def functions(path: Path) -> Iterator[ast.FunctionDef]:
    yield from (node for node in nodes(path) if isinstance(node, ast.FunctionDef))


def is_kernel(node: ast.FunctionDef) -> bool:
    """Whether a function is compiled by numba, whose kernels take plain arrays and so many of them."""
    return any("kernel" in ast.unparse(one) or "inlined" in ast.unparse(one) for one in node.decorator_list)


def parameters(node: ast.FunctionDef) -> int:
    names = [one.arg for one in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
    return len([name for name in names if name not in ("self", "cls", "ctx")])


# The rasterizer is called as gsplat's; a layer of set abstraction is one autograd function of all its weights.
WIDE = ("dpcli.ops.splatting.", "dpcli.ops.grouped_mlp", "dpcli.cli.")


def test_no_function_takes_more_than_ten_parameters():
    wide = [
        f"{name}.{node.name}"
        for name, path in MODULES.items()
        if not name.startswith(WIDE)
        for node in functions(path)
        if parameters(node) > 10 and not is_kernel(node)
    ]
    assert wide == []


def test_files_and_functions_are_short():
    lengths = sorted(node.end_lineno - node.lineno + 1 for path in MODULES.values() for node in functions(path))
    assert lengths[int(0.95 * len(lengths))] < 30
    assert [name for name, path in MODULES.items() if path.read_text().count("\n") > 500] == []


def test_only_the_command_line_prints_results():
    """Results go to stdout in `cli` (and in the programs of `reproduce`); other rooms may write to stderr."""
    for name, path in MODULES.items():
        if not name.startswith(("dpcli.cli", "dpcli.reproduce")):
            for node in nodes(path):
                if isinstance(node, ast.Call) and ast.unparse(node.func) == "print":
                    assert any(one.arg == "file" for one in node.keywords), f"{name} line {node.lineno} prints"


def undocumented(node: ast.AST, name: str, known: frozenset[str] = frozenset()) -> Iterator[str]:
    """The public classes, functions and methods below a node that have no docstring, but for the methods that are known."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, (ast.FunctionDef, ast.ClassDef)) and not child.name.startswith("_"):
            if ast.get_docstring(child) is None and child.name not in known:
                yield f"{name}.{child.name}"
            if isinstance(child, ast.ClassDef):
                yield from undocumented(child, f"{name}.{child.name}", said_of_bases(child))


@cache
def said_of_bases(node: ast.ClassDef) -> frozenset[str]:
    """The methods of a class that the classes it derives from describe: an implementation needn't repeat it."""
    bases = [one for base in node.bases for one in classes().get(ast.unparse(base), ())]
    own = {
        one.name for base in bases for one in base.body if isinstance(one, ast.FunctionDef) and ast.get_docstring(one)
    }
    return frozenset(own.union(*map(said_of_bases, bases)))


@cache
def classes() -> dict[str, list[ast.ClassDef]]:
    """All classes by name."""
    found: dict[str, list[ast.ClassDef]] = {}
    for path in MODULES.values():
        for node in nodes(path):
            if isinstance(node, ast.ClassDef):
                found.setdefault(node.name, []).append(node)
    return found


def test_everything_public_is_documented():
    assert [one for name, path in MODULES.items() for one in undocumented(nodes(path)[0], name)] == []


def test_what_lacks_a_docstring_is_found():
    """A method is described where it is declared, or where a class declares it that its own derives from."""
    tree = ast.parse("class A(Reader):\n def read(self): ...\n def other(self): ...\ndef f(): ...")
    assert list(undocumented(tree, "m")) == ["m.A", "m.A.other", "m.f"]


RELATIVE = ("What", "Which", "Where", "How", "Of", "Whether", "As", "With", "When", "Who")


def test_docstrings_begin_with_a_subject_or_a_verb():
    """A relative clause alone says neither who acts nor what is returned."""
    for name, path in MODULES.items():
        for node in nodes(path):
            if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)):
                words = (ast.get_docstring(node) or "").split()
                assert not words or words[0] not in RELATIVE, f"{name}: {' '.join(words[:8])} ..."


# First words that end as a verb does, but are none: the sentences that follow them have no verb.
NO_VERBS = set(
    "As Axes Blocks Bodies Cells Centroids Class Coefficients Columns Distances Features Frames Gradients Indices Inverses Its"
    " Joints Layers Masks Matrices Means Messages Neighborhoods Pieces Points Ranges Rows Statistics Swatches This Values"
    " Vertices Weights".split()
)
# Docstrings that are whole sentences with a subject of their own: errors, which say what happened.
OWN_SUBJECT = {
    "dpcli.errors.DpcError",
    "dpcli.errors.UsageError",
    "dpcli.errors.DataError",
    "dpcli.errors.Stopped",
    "dpcli.runtime.pool.LostWorker",
    "dpcli.store.writing.journal._Changed",
}


def begins_with_a_verb(docstring: str) -> bool:
    """Whether the first word is a verb in the third person, as in "Returns the ..."; the class or function is its subject."""
    word = docstring.split()[0].rstrip(",.:")
    return word.istitle() and word.isalpha() and word.endswith("s") and word not in NO_VERBS


def described(node: ast.AST, name: str) -> Iterator[tuple[str, str]]:
    """The names and docstrings of all classes and functions below a node; those of commands are their help and are left out."""
    for child in ast.iter_child_nodes(node):
        own = isinstance(child, (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef))
        below = f"{name}.{child.name}" if own else name
        if own and child.name != "main" and (docstring := ast.get_docstring(child)):
            yield below, docstring
        yield from described(child, below)


def test_docstrings_are_sentences():
    """Those of `dpcli.cli` are help texts, which are imperative by custom."""
    found = {
        name: docstring.split("\n")[0]
        for module, path in MODULES.items()
        if not module.startswith("dpcli.cli.")
        for name, docstring in described(nodes(path)[0], module)
        if not begins_with_a_verb(docstring)
    }
    assert {name: line for name, line in found.items() if name not in OWN_SUBJECT} == {}
    assert OWN_SUBJECT <= set(found), "an exception that is needed no more"


@pytest.mark.parametrize(
    "docstring",
    [
        "Return the rows.",
        "The gradient of the rows.",
        "(R,) squared radii.",
        "Class logits (B,C).",
        "out[r] = max(x, 0)",
    ],
)
def test_what_is_no_sentence_is_found(docstring):
    tree = ast.parse(f"def f():\n    {docstring!r}\n")
    assert [begins_with_a_verb(text) for _, text in described(tree, "m")] == [False]
    assert begins_with_a_verb("Returns the rows.")
