"""PLY files of parts, as other programs read them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpcli.draw.palette import part_colors
from dpcli.draw.ply import write_ply, write_ply_frames
from dpcli.ops.open3d_import import load_open3d
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
