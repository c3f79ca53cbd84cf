"""Heaps of texts at which libhdf5 never ends: found before it reads them, in every command; good files pass at once."""

from __future__ import annotations

import errno
import mmap
import os
import struct
import subprocess
import sys
import time
from pathlib import Path
from unittest.mock import Mock

import h5py
import numpy as np
import pytest
import torch

from dpcli.errors import DataError
from dpcli.npy_files import map_npy
from dpcli.prepare.scans.modelnet40 import read_labels
from dpcli.runtime.weights import load_weights, save_weights
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter, ScoresWriter
from dpcli.store.heap_check import check_heaps, trust_heaps
from tests.support.prepare_helpers import ROOT


def clouds(path: Path) -> Path:
    with CloudsWriter(path, class_names=["a", "b"]) as writer:
        for n in range(5):
            writer.write(CloudSequence.from_frames(f"sample {n}", [np.ones((9, 3), np.float32)] * 2, label=n % 2))
    return path


def heaps(data: bytes) -> list[int]:
    found, at = [], data.find(b"GCOL")
    while at >= 0:
        found.append(at)
        at = data.find(b"GCOL", at + 1)
    return found


def zeroed(path: Path, heap: int, keep: int) -> None:
    """Overwrites a heap with zeros behind its first `keep` objects, as a lost block of a disk does."""
    data = bytearray(path.read_bytes())
    start, at = heaps(data)[heap], 16
    size = struct.unpack_from("<Q", data, start + 8)[0]
    for _ in range(keep):
        at += 16 + -(-struct.unpack_from("<Q", data, start + at + 8)[0] // 8) * 8
    data[start + at : start + size] = bytes(size - at)
    path.write_bytes(data)


def test_a_zeroed_heap_is_a_damaged_file_to_every_command(tmp_path):
    """In a process of its own, which can be ended where libhdf5 doesn't come back."""
    commands = (
        "info F0",
        "evaluate segmentation F1 --truth F1",
        "segment predict F2 -o o.h5",
        "evaluate report F3 -o r.html",
        "prepare merge F4 -o m.h5",
    )
    for keep in range(len(commands)):
        zeroed(clouds(tmp_path / f"F{keep}"), 0, keep)
    code = "import sys; from tests.support.commands import exit_code; print(*(exit_code(*w.split()) for w in sys.argv[1:]))"
    done = subprocess.run(
        [sys.executable, "-c", code, *commands],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.stdout.split() == ["3"] * len(commands), done.stderr
    for keep in range(len(commands)):
        assert f"F{keep}: the HDF5 file is damaged (its heap of texts" in done.stderr


def test_a_heap_larger_than_the_file_is_refused_before_room_is_made_for_it(tmp_path):
    path = clouds(tmp_path / "c.h5")
    data = bytearray(path.read_bytes())
    struct.pack_into("<Q", data, heaps(data)[-1] + 8, 1 << 30)
    path.write_bytes(data)
    with pytest.raises(DataError, match="claims 1073741824 bytes, a file of"):
        CloudsReader(path)


@pytest.mark.parametrize("chunks", [None, (2,)])
def test_a_text_longer_than_the_file_is_refused_before_room_is_made_for_it(chunks, tmp_path):
    path = clouds(tmp_path / "c.h5")
    with h5py.File(path, "a") as file:
        names = file["class_names"][:]
        del file["class_names"]
        item = file.create_dataset("class_names", data=names, dtype=h5py.string_dtype(), chunks=chunks)
        file.flush()
        place = item.id.get_offset() if chunks is None else item.id.get_chunk_info(0).byte_offset
    CloudsReader(path).close()
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, place, 1 << 30)
    path.write_bytes(data)
    with pytest.raises(DataError, match="a text of /class_names claims 1073741824 bytes"):
        CloudsReader(path)


def test_every_heap_is_looked_at(tmp_path):
    path = clouds(tmp_path / "c.h5")
    whole = path.read_bytes()
    for number in range(len(heaps(whole))):
        path.write_bytes(whole)
        zeroed(path, number, 1)
        with pytest.raises(DataError, match="its heap of texts"):
            CloudsReader(path)
    path.write_bytes(whole)
    assert len(CloudsReader(path).names) == 5


def test_lengths_of_other_widths_are_refused(tmp_path):
    path = clouds(tmp_path / "c.h5")
    data = bytearray(path.read_bytes())
    data[13 if data[8] < 2 else 9] = 4
    path.write_bytes(data)
    with pytest.raises(DataError, match="damaged"):
        check_heaps(path)


def test_other_files_of_hdf5_are_looked_at_too(tmp_path):
    """Those that prepare reads, and one that begins behind a block of text, as MATLAB's do."""
    for name, block in (("ply_data_train0.h5", 0), ("a.mat", 512)):
        path = tmp_path / name
        with h5py.File(path, "w", userblock_size=block) as file:
            file.create_dataset("data", data=np.ones((2, 3)))
            file.create_dataset("names", data=np.array(["a", "b"], object), dtype=h5py.string_dtype())
        check_heaps(path)
        zeroed(path, 0, 0)
        with pytest.raises(DataError, match="its heap of texts"):
            check_heaps(path)
    with pytest.raises(DataError, match="its heap of texts"):
        read_labels(tmp_path / "ply_data_train0.h5")


def test_the_letters_of_a_heap_in_data_are_data(tmp_path):
    values = np.frombuffer(b"GCOL" * 3000 + b"GCOL\x02\0\0\0" * 50, np.uint8)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["values"] = values
    check_heaps(tmp_path / "a.h5")


def test_what_is_no_hdf5_passes_to_who_opens_it(tmp_path):
    for content in (b"x", b"GCOL\x01\0\0\0" + bytes(5000)):
        (tmp_path / "a.h5").write_bytes(content)
        check_heaps(tmp_path / "a.h5")


def test_a_good_file_pays_milliseconds(tmp_path):
    """64 MB of points; the bound is generous, for busy machines."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["points"] = np.random.default_rng(0).random((2 << 20, 4))
    check_heaps(tmp_path / "a.h5")
    started = time.process_time()
    check_heaps(tmp_path / "a.h5")
    assert time.process_time() - started < 0.3


def test_scores_with_many_names_pass(tmp_path):
    with ScoresWriter(tmp_path / "s.h5", class_names=["a", "b"]) as writer:
        for n in range(3000):
            writer.write(f"video number {n}", np.eye(2)[n % 2], label=0)
    check_heaps(tmp_path / "s.h5")


def test_what_this_process_made_is_searched_again_once_it_changed(tmp_path):
    path = clouds(tmp_path / "a.h5")
    zeroed(path, 0, 0)
    trust_heaps(path)
    check_heaps(path)
    with path.open("ab") as file:
        file.write(b"\0")
    with pytest.raises(DataError, match="its heap of texts"):
        check_heaps(path)


def test_a_file_system_that_shares_no_maps_is_no_reason_to_read_nothing(tmp_path, monkeypatch):
    """As FUSE with direct_io and 9P without a cache, which know private maps alone; the library of weights has its own maps."""
    array, weights, plain = np.arange(12, dtype=np.float32).reshape(4, 3), {"a": torch.eye(3)}, mmap.mmap
    np.save(tmp_path / "a.npy", array)
    save_weights(tmp_path / "w.safetensors", weights, {"format": "any", "names": "\u00fc"})
    made = clouds(tmp_path / "c.h5")

    def private(number: int, size: int, flags: int = mmap.MAP_SHARED, **options: int) -> mmap.mmap:
        if options.get("access") != mmap.ACCESS_COPY and flags & mmap.MAP_SHARED:
            raise OSError(errno.ENODEV, "No such device")
        return plain(number, size, **options if "access" in options else {"flags": flags, **options})

    monkeypatch.setattr(mmap, "mmap", private)
    monkeypatch.setattr("safetensors.safe_open", Mock(side_effect=OSError("No such device (os error 19)")))
    check_heaps(made)
    assert np.array_equal(map_npy(tmp_path / "a.npy"), array)
    tensors, header = load_weights(tmp_path / "w.safetensors", "any", "dpc")
    assert tensors["a"].equal(weights["a"]) and header["names"] == "\u00fc"
