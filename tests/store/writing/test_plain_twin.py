"""The fast ways of large arrays and their plain twins: one switch, the same bytes, and each goes on where the other stopped."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dpcli.errors import Stopped
from dpcli.runtime.pool import ordered_map
from dpcli.runtime.shared_memory import POSSIBLE, Parcel, packed
from dpcli.store import CloudSequence, CloudsWriter
from dpcli.store.writing.whole_chunks import PlainChunks, WholeChunks

WAYS = ["", "plain"]


def sequences() -> list[CloudSequence]:
    """Clips that end inside chunks, of one chunk less a point, and of many chunks."""
    rng, made = np.random.default_rng(0), []
    for number, count in enumerate([5000, 16383, 1, 40_000, 100_000, 16384, 777]):
        frames = [rng.normal(size=(count, 3)).astype(np.float32) for _ in range(2)]
        made.append(CloudSequence.from_frames(f"s{number}", frames, time=np.arange(2.0)))
    return made


def write(path: Path, stop_after: int | None = None) -> None:
    with CloudsWriter(path, fields=["time"], provenance={"config": {}}, resume=True) as writer:
        for sequence in sequences()[len(writer) :]:
            writer.write(sequence)
            if len(writer) == stop_after:
                raise Stopped("enough")


def test_both_ways_leave_the_same_bytes(tmp_path, monkeypatch):
    for way in WAYS:
        monkeypatch.setenv("DPC_TRANSPORT", way)
        write(tmp_path / f"{way}.h5")
    assert (tmp_path / ".h5").read_bytes() == (tmp_path / "plain.h5").read_bytes()


@pytest.mark.parametrize("first, then", [("", "plain"), ("plain", ""), ("plain", "plain")])
def test_each_way_goes_on_where_the_other_stopped(first, then, tmp_path, monkeypatch):
    write(tmp_path / "whole.h5")
    monkeypatch.setenv("DPC_TRANSPORT", first)
    with pytest.raises(Stopped):
        write(tmp_path / "a.h5", stop_after=5)
    journal = (tmp_path / ".a.h5.part").stat().st_size
    points = sum(sequence.points.nbytes for sequence in sequences()[:5])
    assert journal > points if first == "plain" else journal < points / 3  # the fast one points to what is written
    monkeypatch.setenv("DPC_TRANSPORT", then)
    write(tmp_path / "a.h5")
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "whole.h5").read_bytes()


def test_the_switch_chooses_the_chunks(tmp_path, monkeypatch):
    for way, kind in (("", WholeChunks), ("plain", PlainChunks)):
        monkeypatch.setenv("DPC_TRANSPORT", way)
        with CloudsWriter(tmp_path / f"{way}.h5") as writer:
            assert type(writer._chunks) is kind
            writer.write(sequences()[2])


def large(number: int) -> np.ndarray:
    return np.full(200_000, number, np.float64)


@pytest.mark.parametrize("way", WAYS)
def test_workers_hand_over_the_same_arrays_either_way(way, monkeypatch):
    monkeypatch.setenv("DPC_TRANSPORT", way)
    found = list(ordered_map(large, range(5), jobs=2))
    assert [number for number, _ in found] == list(range(5))
    for number, array in found:
        np.testing.assert_array_equal(array, large(number))


@pytest.mark.skipif(not POSSIBLE, reason="no memory files on this system")
def test_arrays_of_that_size_do_take_the_shared_memory():
    assert isinstance(packed(large, 1), Parcel)
