"""The cache of compiled kernels: used again, and not after an edit of code that other files' kernels are made of."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from dpcli.ops.cpu import jit

KERNEL = """
import sys
import dpcli.ops.cpu.jit as jit
jit.SHARED_CODE = sys.argv[1]
from own import twice
print(twice(3.0), len(twice.stats.cache_hits), len(twice.stats.cache_misses))
"""


def run(folder: Path, shared: str) -> str:
    """What a fresh process that compiles or loads a kernel prints, where `shared` stands for the shared code's digest."""
    root = Path(jit.__file__).parents[3]
    paths = os.pathsep.join([str(folder), str(root)])
    done = subprocess.run(
        [sys.executable, "-c", KERNEL, shared], env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_an_edit_of_the_shared_code_makes_cached_kernels_stale(tmp_path):
    text = "from dpcli.ops.cpu.jit import kernel\n\n\n@kernel\ndef twice(x):\n    return 2 * x\n"
    (tmp_path / "own.py").write_text(text)
    assert run(tmp_path, "before") == "6.0 0 1"
    assert run(tmp_path, "before") == "6.0 1 0"
    assert run(tmp_path, "after") == "6.0 0 1"


def test_the_digest_covers_the_lanes():
    assert {path.name for path in jit._SHARED} == {"jit.py", "simd.py", "cpu_simd.py"}
    assert all(path.is_file() for path in jit._SHARED) and len(jit.SHARED_CODE) == 64
