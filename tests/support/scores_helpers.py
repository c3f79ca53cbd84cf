"""Scores files for tests of comparisons."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpcli.store import ScoresWriter

CLASSES = ("wave", "push", "pull")


def write_scores(path: Path, wrong: set[int], count: int = 60, start: int = 0, seed: int = 0, **options) -> Path:
    """Samples v0, v1, ... of label number % 3; those in `wrong` are scored as the next class."""
    training = {"command": "dpc classify train x", "seed": seed}
    history = [{"command": "dpc classify predict y", "seed": 99, "config": {"model": training}}]  # as predict writes it
    with ScoresWriter(path, **{"class_names": CLASSES, "provenance": history, "seed": seed, **options}) as writer:
        for i in range(start, start + count):
            writer.write(f"v{i}", np.eye(3)[(i + (i in wrong)) % 3], label=i % 3, split="test")
    return path
