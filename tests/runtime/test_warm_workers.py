"""Worker processes stay single-threaded and say no more than was asked for, and what is done to numba at its import leaves it whole."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numba
import numpy as np

import dpcli.ops.cpu.jit  # noqa: F401  (it skips the look)

PROGRAM = """
import json, os
from dpcli.runtime.pool import ordered_map
from dpcli.runtime.progress import log

def told(_):
    return os.environ.get("OMP_NUM_THREADS"), log.level

if __name__ == "__main__":
    before, log.level = os.environ.get("OMP_NUM_THREADS"), 0
    print(json.dumps([[found for _, found in ordered_map(told, range(4), 2)], before]))
"""


def test_workers_are_single_threaded_whatever_the_command_is_and_as_quiet(tmp_path):
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    environment = {**os.environ, "PYTHONPATH": os.getcwd(), "OMP_NUM_THREADS": "3"}
    out = subprocess.run(
        [sys.executable, program], env=environment, capture_output=True, text=True, timeout=120, check=True
    )
    assert json.loads(out.stdout) == [[["1", 0]] * 4, "3"]


def test_numba_still_multiplies_matrices():
    """Skipping its look for BLAS at import may not break what needs it."""
    product = numba.njit(lambda a, b: np.dot(a, b))
    a = np.arange(6, dtype=np.float64).reshape(2, 3)
    assert np.array_equal(product(a, a.T.copy()), a @ a.T)
