"""Where rows lie in the file, as `WholeChunks` says: HDF5 is asked only if the end of the file looks otherwise."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from dpcli.store.writing.whole_chunks import WholeChunks


def chunk_places(data: h5py.Dataset) -> list[int]:
    return [data.id.get_chunk_info(number).byte_offset for number in range(data.id.get_num_chunks())]


@pytest.mark.parametrize("disturbed", ["", "by any", "by chunks alike"])
@pytest.mark.parametrize("values", ["random", "zeros"])
def test_rows_are_where_it_says(tmp_path: Path, monkeypatch, disturbed: str, values: str) -> None:
    """disturbed: other data sets are written between, so that the file ends elsewhere. zeros: all chunks look alike."""
    rng, rows, given = np.random.default_rng(0), 512, []
    asked = 0
    with h5py.File(tmp_path / "a.h5", "w") as file:
        data = file.create_dataset("points", (0, 3), np.float32, maxshape=(None, 3), chunks=(rows, 3))
        chunks, places = WholeChunks(data), []
        told = WholeChunks._is_at

        def counted(self, offset, chunk):
            nonlocal asked
            found = told(self, offset, chunk)
            asked += not found
            return found

        monkeypatch.setattr(WholeChunks, "_is_at", counted)
        for number in range(40):
            part = rng.normal(size=(int(rng.integers(1, 3 * rows)), 3)).astype(np.float32) * (values == "random")
            given.append(part)
            placed = chunks.append(part)
            places.append(placed[1] if placed else [])
            if disturbed:
                # float64: as long as a chunk
                size = int(rng.integers(1, 4000)) if disturbed == "by any" else rows * 3 // 2
                file.create_dataset(f"other{number}", data=rng.normal(size=size))
                file.flush()
        chunks.finish()
        whole = np.concatenate(given)
        table = chunk_places(data)
    row, known = 0, 0
    for part, pieces in zip(given, places):
        said = [offset + at for offset, length in pieces for at in range(0, length, 12)]
        assert said == [table[r // rows] + r % rows * 12 for r in range(row, row + len(said))]
        row, known = row + len(part), known + len(said)
    assert known > len(whole) / 2
    if not disturbed:
        assert asked <= 2, "HDF5 goes through all chunks when it is asked"
    with h5py.File(tmp_path / "a.h5") as file:
        np.testing.assert_array_equal(file["points"][:], whole)


def test_the_look_at_both_ends_tells_a_shifted_chunk(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        data = file.create_dataset("points", (0, 3), np.float32, maxshape=(None, 3), chunks=(512, 3))
        chunks = WholeChunks(data)
        chunk = np.random.default_rng(1).normal(size=(512, 3)).astype(np.float32)
        _, ((offset, length),) = chunks.append(chunk)
        assert length == chunk.nbytes and chunks._is_at(offset, chunk)
        assert not any(chunks._is_at(offset + shift, chunk) for shift in (-4096, -12, 12, 600, 4096, -(10**9)))
