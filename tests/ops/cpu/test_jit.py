"""The cache of compiled kernels: used again, not after an edit of code that other files' kernels are made of; and what users hear."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from unittest.mock import Mock

import pytest

from dpcli.ops.cpu import jit
from dpcli.runtime.tuning import tune_environment

PACKAGE = Path(jit.__file__).parents[2]
KERNEL = """
import sys
import dpcli.ops.cpu.jit as jit
jit.SHARED_CODE, jit._PATIENCE = sys.argv[1], float(sys.argv[2])
from own import twice
print(twice(3.0), len(twice.stats.cache_hits), len(twice.stats.cache_misses))
"""


TWICE = "from dpcli.ops.cpu.jit import kernel\n\n\n@kernel\ndef twice(x):\n    return 2 * x\n"


def run(folder: Path, shared: str, patience: float = 0) -> tuple[str, str]:
    """What a fresh process that compiles or loads a kernel prints and says, where `shared` stands for the shared code's digest."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(PACKAGE.parent)])}
    command = [sys.executable, "-c", KERNEL, shared, str(patience)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip(), done.stderr


def test_a_kernel_is_compiled_once_and_the_user_is_told(tmp_path):
    """The last: an edit of the shared code makes what is cached stale."""
    (tmp_path / "own.py").write_text(TWICE)
    said = "dpc: compiling fast code for this machine, once; this may take half a minute\n"
    assert run(tmp_path, "before") == ("6.0 0 1", said)
    assert run(tmp_path, "before") == ("6.0 1 0", "")
    assert run(tmp_path, "after", patience=60) == ("6.0 0 1", "")


def test_a_switch_for_code_of_a_user_s_own_leaves_kernels_compiled(tmp_path, monkeypatch):
    """NUMBA_DISABLE_JIT=1, as people set it to debug; numba looks at it again when another variable of its own changes.
    A threading layer that isn't installed, and no threads, which stand for all in other programs, ended commands as bugs.
    """
    for name, value in {"DISABLE_JIT": "1", "THREADING_LAYER": "absent", "NUM_THREADS": "0"}.items():
        monkeypatch.setenv(f"NUMBA_{name}", value)
    tune_environment()
    assert "NUMBA_NUM_THREADS" not in os.environ
    fake = "import sys\nfrom unittest.mock import Mock\nsys.modules['torch'] = Mock(get_num_threads=lambda: 1)\n"
    threads = f"{fake}from dpcli.runtime.tuning import numba_threads_as_torch\nnumba_threads_as_torch()\n"
    (tmp_path / "own.py").write_text(
        f"import os, numba\n{threads}os.environ['NUMBA_OPT'] = '2'\nnumba.core.config.reload_config()\n{TWICE}"
    )
    assert run(tmp_path, "any", patience=60) == ("6.0 0 1", "")


@pytest.fixture
def compiled(tmp_path, monkeypatch):
    """Calls a kernel for the first time in this process, so to say; returns whether it was found in the cache."""
    (tmp_path / "own.py").write_text(TWICE)
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "own", raising=False)
    function = import_module("own").twice.py_func

    def call(number: float = 3.0) -> bool:
        kernel = jit.kernel(function)
        assert kernel(number) == 2 * number
        return bool(kernel.stats.cache_hits)

    return call


@pytest.mark.parametrize("ending", ["nbi", "nbc"])
def test_a_damaged_cache_is_written_anew(compiled, tmp_path, ending):
    """As a crash of the machine leaves it: the index and the code lie in files of their own."""
    assert [compiled(), compiled()] == [False, True]
    (file,) = (tmp_path / "cache").rglob(f"*.{ending}")
    file.write_bytes(b"")
    assert [compiled(), compiled()] == [False, True]


def test_code_for_other_types_is_not_taken(compiled, tmp_path):
    """Two processes that had each just compiled a kernel could overwrite each other's code, but not its place in the index."""
    assert [compiled(0.5), compiled(1 << 40)] == [False, False]
    one, other = sorted((tmp_path / "cache").rglob("*.nbc"))
    one.write_bytes(other.read_bytes())
    assert [compiled(0.5), compiled(0.5), compiled(1 << 40)] == [False, True, True]


def test_a_cache_that_takes_nothing_is_done_without(compiled, monkeypatch, capsys):
    announcement = jit._Announcement()
    monkeypatch.setattr(jit, "_announcement", announcement)
    monkeypatch.setattr("numba.core.caching.IndexDataCacheFile._save_data", Mock(side_effect=OSError(28, "disk full")))
    assert [compiled(), compiled()] == [False, False]
    monkeypatch.setattr(jit, "_PATIENCE", 0)
    announcement.on_start(None)
    announcement.on_start(None)
    assert capsys.readouterr().err.count("half a minute, in every run") == 1


def kernel_files() -> dict[Path, str]:
    """The files that decorate kernels, and their text."""
    texts = {path: path.read_text("utf-8") for path in PACKAGE.rglob("*.py")}
    return {path: text for path, text in texts.items() if "from dpcli.ops.cpu.jit import" in text}


def names_from(path: Path) -> set[Path]:
    """The files of the package from which a file takes something, but for the decorators."""
    modules = {str(node.module) for node in ast.parse(path.read_text()).body if isinstance(node, ast.ImportFrom)}
    own = {name for name in modules - {"dpcli.ops.cpu.jit"} if name.startswith("dpcli.")}
    return {PACKAGE.parent.joinpath(*name.split(".")).with_suffix(".py") for name in own}


def test_the_digest_covers_what_kernels_take_from_other_files():
    """The others named here are called by Python around the kernels."""
    plain = {PACKAGE / "errors.py", PACKAGE / "runtime/clips/images.py", PACKAGE / "segment/rigid_motions.py"}
    files = kernel_files()
    assert len(files) > 15 and set().union(*map(names_from, files)) - plain == {*jit._SHARED} - {Path(jit.__file__)}


def _decorated(tree: ast.Module) -> dict[str, tuple[str, ast.FunctionDef]]:
    found = [one for one in ast.walk(tree) if isinstance(one, ast.FunctionDef)]
    return {one.name: (mark.id, one) for one in found for mark in one.decorator_list if isinstance(mark, ast.Name)}


def test_no_kernel_that_reorders_is_called_by_another_one():
    """Such a helper has two compiled forms, and which one runs depends on whether this process compiled it: `inlined_piece`."""
    kernels, called = {}, []
    for text in kernel_files().values():
        kernels |= _decorated(ast.parse(text))
    reordering = {name for name, (mark, _) in kernels.items() if mark in ("piece_kernel", "parallel_kernel")}
    compiled = ("kernel", "piece_kernel", "parallel_kernel", "arithmetic_kernel", "inlined", "inlined_piece")
    for name, (mark, function) in kernels.items():
        inside = [one.func for one in ast.walk(function) if isinstance(one, ast.Call)]
        names = {one.id for one in inside if isinstance(one, ast.Name)} if mark in compiled else set()
        called += [f"{name} calls {one}" for one in sorted(names & reordering)]
    assert len(reordering) > 10 and not called, called
