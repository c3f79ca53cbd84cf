"""Worker processes start warm: what all need is imported once, by their server, and nothing more."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numba
import numpy as np

import dpcli.ops.cpu.jit  # noqa: F401  (it skips the look)

PROGRAM = """
import json, os, sys
from dpcli.runtime.pool import ordered_map
from dpcli.runtime.worker_server import start_early

def imported(module):
    return [module in sys.modules, os.environ.get("OMP_NUM_THREADS")]

if __name__ == "__main__":
    start_early(sys.argv[1:])
    before = os.environ.get("OMP_NUM_THREADS")
    rows = [found for _, found in ordered_map(imported, ["dpcli.ops.cpu.farthest_point_sampling", "scipy.linalg", "torch", "cv2"], 2)]
    print(json.dumps([rows, before]))
"""


def worker_modules(tmp_path, *early: str) -> tuple[list[bool], list, str | None]:
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    environment = {**os.environ, "PYTHONPATH": os.getcwd(), "OMP_NUM_THREADS": "3"}
    out = subprocess.run(
        [sys.executable, program, *early], env=environment, capture_output=True, text=True, timeout=120, check=True
    )
    rows, before = json.loads(out.stdout)
    return [row[0] for row in rows], [row[1] for row in rows], before


def test_the_server_imports_what_workers_need_and_they_stay_single_threaded(tmp_path):
    found, threads, before = worker_modules(tmp_path, "dpcli.prepare.warm_fps", "dpcli.prepare.warm_video")
    assert found == [True, False, False, True]  # sampling and OpenCV; neither scipy's linear algebra nor torch
    assert threads == ["1"] * 4 and before == "3"


def test_a_module_that_fails_to_import_is_left_to_the_workers(tmp_path):
    assert worker_modules(tmp_path, "dpcli.nonesuch")[0] == [False] * 4


def test_numba_still_multiplies_matrices():
    """Skipping its look for BLAS at import may not break what needs it."""
    product = numba.njit(lambda a, b: np.dot(a, b))
    a = np.arange(6, dtype=np.float64).reshape(2, 3)
    assert np.array_equal(product(a, a.T.copy()), a @ a.T)
