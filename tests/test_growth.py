"""Work that grows with the number of samples, classes or names: twice as many take about twice the steps, not four times."""

from __future__ import annotations

import os
import sys
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.evaluate.classification.calibration import calibrate
from dpcli.evaluate.classification.metrics import classification_weighted
from dpcli.evaluate.results import measure_by_class
from dpcli.prepare.array_files.choosing import find_beside
from dpcli.prepare.array_files.containers import ByName
from dpcli.prepare.label_map import LabelMap
from dpcli.prepare.series import choose_series
from dpcli.runtime.clips.images import one_series
from dpcli.runtime.whole_file import whole_file, write_whole
from dpcli.store import summary

_MOST = 2.7  # times the steps for twice as many; 4 where each is compared with all
_FEW = 100


class Steps:
    """Counts steps of the interpreter, and comparisons of `Text`, which searches in C make without such steps."""

    def __init__(self) -> None:
        self.count = 0

    def trace(self, frame: FrameType, event: str, _: Any) -> Callable[..., Any]:
        """Counts one step; the interpreter calls it for each."""
        frame.f_trace_opcodes = True
        self.count += event == "opcode"
        return self.trace

    def of(self, work: Callable[[], object]) -> int:
        """Returns how many steps some work takes."""
        self.count, before = 0, sys.gettrace()
        sys.settrace(self.trace)
        try:
            work()
        finally:
            sys.settrace(before)
        return self.count


class Text(str):
    """A text whose comparisons are steps of the interpreter."""

    __hash__ = str.__hash__

    def __eq__(self, other: object) -> bool:
        return str.__eq__(self, other)


def _measure(count: int) -> Callable[[], object]:
    return lambda: measure_by_class(range(count), range(count), sum)


def _count_classes(count: int) -> Callable[[], object]:
    names = [f"class {k}" for k in range(count)]
    return lambda: summary._who(names, np.arange(count), ["train"] * count)


def _refuse_series(count: int) -> Callable[[], object]:
    names = [f"cup{k}_{frame}{suffix}" for k in range(count) for frame in range(2) for suffix in (".ply", ".pcd")]

    def work() -> None:
        with pytest.raises(DataError, match=f"holds {count} series"):
            choose_series(Path("cups"), names, suffixes=(".ply", ".pcd"))

    return work


def _look_beside(count: int) -> Callable[[], object]:
    arrays = ByName({f"walk_{k}": np.zeros((2, 5, 3)) for k in range(count)})
    return lambda: [find_beside(arrays, name, "TNC") for name in arrays]


def _map_labels(count: int) -> Callable[[], object]:
    sources = [(Path("one.h5"), [Text(f"class {k}") for k in range(count)])]
    return lambda: LabelMap(labels={"class 0": "none"}).resolve(sources)


def _choose_images(count: int) -> Callable[[], object]:
    images = [Path(f"walk_{k}.png") for k in range(count)]
    return lambda: one_series(Path("walk"), [*images, Path("lone.png")], quiet=True)


CASES = [_measure, _count_classes, _refuse_series, _look_beside, _map_labels, _choose_images]


@pytest.mark.parametrize("case", CASES)
def test_twice_as_many_take_twice_the_steps(case: Callable[[int], Callable[[], object]]) -> None:
    """Samples, classes, series in a folder, sequences in a file: each is looked at once, not once for each of the others."""
    case(2)()  # imports and compiled patterns
    few, many = (Steps().of(case(count)) for count in (_FEW, 2 * _FEW))
    assert many < _MOST * few


def test_a_frame_written_into_a_folder_looks_through_no_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What killed processes left is looked for beside the folder, once; each of a thousand frames looked through the others."""
    looked = []
    scandir = os.scandir
    monkeypatch.setattr(os, "scandir", lambda place: looked.append(place) or scandir(place))
    with whole_file(tmp_path / "frames") as folder:
        folder.mkdir()
        for k in range(3):
            write_whole(folder / f"{k}.ply", b"")
        assert looked == [tmp_path]


def _peak(work: Callable[[], object]) -> int:
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_the_memory_of_chance_does_not_grow_with_samples_times_draws() -> None:
    """A thousand draws of answers for each of 4000 samples are never in memory together (they took 34 MB)."""
    scores = np.full((4000, 2), 0.5)
    assert _peak(lambda: calibrate(scores, np.zeros(4000, np.int64))) < 4 << 20


def test_the_memory_of_a_resample_does_not_grow_with_samples_times_classes() -> None:
    """Sums by class need no column of each class for each sample (they took 170 MB)."""
    scores = np.zeros((2000, 3000), np.float32)
    labels = np.arange(2000)

    def work() -> None:
        classification_weighted(scores, labels)(np.ones((1, 2000)))

    assert _peak(work) < 24 << 20
