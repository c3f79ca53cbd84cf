"""Arrays from a worker to its parent through shared memory: the same values, no copies left, a pipe where it fails."""

from __future__ import annotations

import gc
import os

import numpy as np
import pytest

from dpcli.runtime import shared_memory as handover
from dpcli.runtime.pool import ordered_map

pytestmark = pytest.mark.skipif(not handover.POSSIBLE, reason="no memory files on this system")
_LARGE = 100_000


def values(seed: int) -> dict[str, object]:
    rng = np.random.default_rng(seed)
    size = int(rng.integers(_LARGE, 2 * _LARGE))
    return {
        "points": rng.normal(size=(size, 3)).astype(np.float32),
        "bytes": rng.integers(0, 255, 7 * seed + 1, dtype=np.uint8),
        "empty": np.zeros((0, 3), np.int64),
        "strided": np.arange(40.0).reshape(5, 8)[:, ::2],
        "text": f"s{seed}",
    }


def values_and_process(seed: int) -> tuple[dict[str, object], int, int]:
    return values(seed), os.getpid(), len(os.listdir("/proc/self/fd"))


def assert_same(found: dict[str, object], seed: int) -> None:
    for key, expected in values(seed).items():
        np.testing.assert_array_equal(found[key], expected)
        assert getattr(found[key], "dtype", None) == getattr(expected, "dtype", None)


@pytest.fixture
def own_files(monkeypatch) -> handover._MemoryFiles:
    files = handover._MemoryFiles()
    monkeypatch.setattr(handover, "_files", files)
    yield files
    for file in files._files:
        file.close()


def test_what_is_packed_comes_back_and_can_be_written_to(own_files):
    parcel = handover.packed(values, 3)
    assert isinstance(parcel, handover.Parcel) and len(parcel.pickled) < 2000
    found = handover.unpacked(parcel)
    assert_same(found, 3)
    found["points"] += 1


def test_a_memory_file_is_used_again_only_when_no_array_of_it_is_left(own_files):
    first = handover.packed(values, 1)
    found = handover.unpacked(first)
    second = handover.packed(values, 2)
    assert second.path != first.path
    points = found["points"][5:]  # a view holds it as well
    del found
    assert handover.packed(values, 3).path not in (first.path, second.path)
    np.testing.assert_array_equal(points, values(1)["points"][5:])
    del points
    gc.collect()
    assert handover.packed(values, 4).path == first.path


def test_a_parcel_whose_memory_holds_another_result_is_refused(own_files):
    parcel = handover.packed(values, 1)
    other = handover.Parcel(parcel.path, b"?" * 63, parcel.pickled, parcel.lengths)
    with pytest.raises(OSError, match="another result"):
        handover.unpacked(other)


def test_small_results_and_too_many_kept_ones_go_through_the_pipe(own_files):
    assert handover.packed(abs, -3) == 3
    kept = [handover.packed(values, seed) for seed in range(handover._MOST + 2)]
    assert [isinstance(one, handover.Parcel) for one in kept] == [True] * handover._MOST + [False] * 2
    assert_same(kept[-1], handover._MOST + 1)


def test_without_memory_left_results_go_through_the_pipe(own_files, monkeypatch):
    def refuse(name: str) -> int:
        raise OSError("no more")

    monkeypatch.setattr(os, "memfd_create", refuse)
    assert_same(handover.packed(values, 2), 2)


def test_a_full_memory_is_noticed_before_it_is_touched(own_files, monkeypatch):
    def refuse(*where: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", refuse)
    assert_same(handover.packed(values, 2), 2)


def test_a_memory_file_grows_with_the_results(own_files):
    """One that is free again, too small for what comes next."""
    parcels = []
    for seed in (1, 2, 3, 4, 5, 6):
        parcels.append(handover.packed(values, seed))
        found = handover.unpacked(parcels[-1])
        assert_same(found, seed)
        del found
    assert len({parcel.path for parcel in parcels}) == 1 and len({parcel.lengths for parcel in parcels}) == 6


@pytest.mark.parametrize("refused", [False, True])
def test_workers_hand_over_in_order_and_use_little_memory(monkeypatch, refused):
    """refused: where the parent may not open what its workers have, it gets all the same."""
    if refused:
        monkeypatch.setattr(handover, "unpacked", lambda parcel: os.open("/proc/none/fd/1", os.O_RDWR))
    before = len(os.listdir("/proc/self/fd"))
    for seed, (found, _, open_files) in ordered_map(values_and_process, range(24), 2):
        assert_same(found, seed)
        assert open_files < 40
    del found
    gc.collect()
    assert len(os.listdir("/proc/self/fd")) <= before + 3
