"""PLY files of parts, as other programs read them."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from dpcli.draw.palette import part_colors
from dpcli.draw.ply import write_ply, write_ply_frames
from dpcli.errors import UsageError
from dpcli.ops.open3d_import import load_open3d
from dpcli.runtime.whole_file import DiskFull
from dpcli.store import CloudSequence


def test_ply_is_what_open3d_reads(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    frames = [rng.uniform(-1, 1, (90 + 10 * t, 3)) for t in range(5)]
    sequence = CloudSequence.from_frames("toy", frames, part=[(frame[:, 0] > 0).astype(int) for frame in frames])
    paths = write_ply_frames(tmp_path / "toy", sequence)
    assert [path.name for path in paths] == [f"{t:04d}.ply" for t in range(5)]
    open3d = load_open3d()
    for t, path in enumerate(paths):
        cloud = open3d.t.io.read_point_cloud(str(path)).point
        span = slice(*sequence.frame_offsets[t : t + 2])
        np.testing.assert_array_equal(cloud.positions.numpy(), sequence.points[span])
        np.testing.assert_array_equal(cloud.colors.numpy(), part_colors(sequence.part[span]))
        np.testing.assert_array_equal(cloud["part"].numpy()[:, 0], sequence.part[span])


def test_ply_keeps_unknown_and_large_parts(tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", np.eye(3, dtype=np.float32), np.array([-1, 0, 300]))
    raw = (tmp_path / "a.ply").read_bytes()
    header, _, body = raw.partition(b"end_header\n")
    assert header.startswith(b"ply\nformat binary_little_endian 1.0\nelement vertex 3\n") and len(body) == 3 * 19
    assert np.frombuffer(body[-4:], "<i4")[0] == 300 and np.frombuffer(body[15:19], "<i4")[0] == -1
    assert list(body[12:15]) == part_colors(np.array([-1]))[0].tolist()


def test_frames_of_an_earlier_run_go_and_a_folder_is_whole_or_as_it_was(tmp_path: Path, monkeypatch) -> None:
    frames = [np.ones((3, 3), np.float32) * t for t in range(4)]
    long, short = (
        CloudSequence.from_frames("toy", frames[:count], part=[np.zeros(3, int)] * count) for count in (4, 2)
    )
    write_ply_frames(tmp_path / "toy", long)
    before = {path.name: path.read_bytes() for path in (tmp_path / "toy").iterdir()}

    def full(path: Path, data: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch, pytest.raises(DiskFull):
        patch.setattr(Path, "write_bytes", full)
        write_ply_frames(tmp_path / "toy", short)
    assert {path.name: path.read_bytes() for path in (tmp_path / "toy").iterdir()} == before
    write_ply_frames(tmp_path / "toy", short)
    assert sorted(os.listdir(tmp_path / "toy")) == ["0000.ply", "0001.ply"] and os.listdir(tmp_path) == ["toy"]


def test_a_folder_of_frames_never_takes_the_place_of_other_things(tmp_path: Path) -> None:
    sequence = CloudSequence.from_frames("toy", [np.ones((3, 3), np.float32)], part=[np.zeros(3, int)])
    (tmp_path / "toy").mkdir()
    (tmp_path / "toy" / "mine.txt").touch()
    (tmp_path / "file").touch()
    for name, said in (("toy", "holds other things, too, such as mine.txt"), ("file", "is a file, expected a folder")):
        with pytest.raises(UsageError, match=said):
            write_ply_frames(tmp_path / name, sequence)
    assert sorted(os.listdir(tmp_path)) == ["file", "toy"]
