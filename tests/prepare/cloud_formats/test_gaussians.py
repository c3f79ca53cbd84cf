"""Gaussians in files of players: what writers by hand, and this project's own exports, hold is read back."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import plyfile
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dpcli.errors import DataError
from dpcli.prepare.cloud_formats.gaussians import read_splat, read_spz
from dpcli.prepare.cloud_formats.ply import read_ply
from dpcli.store import CloudsReader
from dpcli.store.gaussians import write_scene
from tests.support.commands import exit_code
from tests.support.scenes import toy_scene

C0 = 0.5 / np.sqrt(np.pi)


def scene(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(-8, 8, (count, 3)), rng.integers(0, 256, (count, 3))


def spz(points: np.ndarray, dc: np.ndarray, version: int, bits: int = 12, degree: int = 0) -> bytes:
    """The file of centers (N,3) and bytes of color (N,3), the rest of each Gaussian noise."""
    count, rng = len(points), np.random.default_rng(0)
    if version == 1:
        centers = points.astype("<f2").tobytes()
    else:
        whole = np.round(points * 2**bits).astype(int).reshape(-1)
        centers = b"".join(int(value).to_bytes(3, "little", signed=True) for value in whole)
    head = struct.pack("<IIIBBBB", 0x5053474E, version, count, degree, bits, 0, 0)
    noise = [rng.bytes(count * size) for size in (1, 3 + (4 if version == 3 else 3), 3 * ((degree + 1) ** 2 - 1))]
    return gzip.compress(head + centers + noise[0] + dc.astype("u1").tobytes() + noise[1] + noise[2])


@given(st.integers(0, 20), st.integers(0, 9), st.sampled_from([1, 2, 3]), st.integers(8, 18), st.integers(0, 3))
def test_spz_of_every_version(count, seed, version, bits, degree):
    points, dc = scene(count, seed)
    with TemporaryDirectory() as folder:
        path = Path(folder, "a.spz")
        path.write_bytes(spz(points, dc, version, bits, degree))
        cloud = read_spz(path)
    np.testing.assert_allclose(cloud.points, points, atol=8e-3 if version == 1 else 2.0**-bits)
    shown = np.clip(0.5 + C0 * (dc / 255 - 0.5) / 0.15, 0, 1) * 255
    np.testing.assert_allclose(cloud.color, shown, atol=0.51)


def test_splat(tmp_path):
    points, color = scene(12, 1)
    rows = [struct.pack("<6f8B", *p, 0.1, 0.2, 0.3, *c, 200, 255, 128, 128, 128) for p, c in zip(points, color)]
    (tmp_path / "a.splat").write_bytes(b"".join(rows))
    cloud = read_splat(tmp_path / "a.splat")
    np.testing.assert_allclose(cloud.points, points, rtol=1e-6)
    assert np.array_equal(cloud.color, color) and cloud.unread


@pytest.mark.parametrize("tinted", [False, True])
@pytest.mark.parametrize("order", ["<", ">"])
def test_gaussians_that_supersplat_packed(tmp_path, tinted, order):
    rng, count = np.random.default_rng(5), 600
    axes = [*"xyz", *("rgb" if tinted else "")]
    ends = {
        axis: np.sort(rng.uniform(0, 1, (3, 2)) if axis in "rgb" else rng.uniform(-9, 9, (3, 2)), 1) for axis in axes
    }
    chunks = np.zeros(3, [(f"{end}_{axis}", "f4") for axis in axes for end in ("min", "max")])
    for axis, values in ends.items():
        chunks[f"min_{axis}"], chunks[f"max_{axis}"] = values.T
    share = [rng.integers(0, 1 << bits, count) for bits in (11, 10, 11)]
    shade = rng.integers(0, 256, (count, 4))
    rows = np.zeros(count, [(f"packed_{name}", "u4") for name in ("color", "position", "rotation", "scale")])
    rows["packed_position"] = share[0] << 21 | share[1] << 11 | share[2]
    rows["packed_color"] = shade @ (1 << np.array([24, 16, 8, 0]))
    parts = [plyfile.PlyElement.describe(array, name) for array, name in ((chunks, "chunk"), (rows, "vertex"))]
    plyfile.PlyData(parts, byte_order=order).write(str(tmp_path / "a.ply"))
    cloud, own = read_ply(tmp_path / "a.ply"), np.repeat([0, 1, 2], 256)[:count]

    def between(axis: str, part: np.ndarray) -> np.ndarray:
        low, high = np.float32(ends[axis]).T
        return low[own] + part * (high - low)[own]

    expected = [between(axis, part / largest) for axis, part, largest in zip("xyz", share, (2047, 1023, 2047))]
    np.testing.assert_allclose(cloud.points, np.stack(expected, 1), atol=1e-5)
    color = [between(axis, part) if tinted else part for axis, part in zip("rgb", shade[:, :3].T / 255)]
    np.testing.assert_allclose(cloud.color, 255 * np.stack(color, 1), atol=0.51)
    plyfile.PlyData([plyfile.PlyElement.describe(chunks[:2], "chunk"), parts[1]]).write(str(tmp_path / "b.ply"))
    with pytest.raises(DataError, match="2 chunks for 600 Gaussians"):
        read_ply(tmp_path / "b.ply")


@pytest.mark.parametrize(
    ("name", "data", "told"),
    [
        ("a.splat", bytes(33), "no whole number of Gaussians"),
        ("a.splat", b"\xff" * 64, "no .splat"),
        ("a.spz", b"NGSP" * 9, "not a readable .spz"),
        (
            "a.spz",
            struct.pack("<IIIBBBB", 0x5053474E, 4, 1, 0, 12, 0, 5) + bytes(99),
            "version 4 .* as version 3, or as .ply",
        ),
        ("a.spz", gzip.compress(b"NGSP"), "not a readable .spz"),
        ("a.spz", gzip.compress(struct.pack("<IIIBBBB", 0x5053474E, 4, 1, 0, 12, 0, 0)), "version 4"),
        ("a.spz", gzip.compress(struct.pack("<IIIBBBB", 0x5053474E, 2, 1 << 30, 0, 12, 0, 0)), "can't hold"),
        (
            "a.spz",
            gzip.compress(struct.pack("<IIIBBBB", 0x5053474E, 2, 9, 0, 12, 0, 0) + bytes(99)),
            "truncated: 99 of 171",
        ),
        ("a.spz", spz(*scene(40, 0), 2)[:-60], "truncated|not a readable"),
    ],
    ids=[
        "odd length",
        "not finite",
        "unpacked",
        "version in the open",
        "no head",
        "version",
        "count",
        "short",
        "cut",
    ],  # gzip holds the time
)
def test_damaged_gaussians_are_named(tmp_path, name, data, told):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(DataError, match=told):
        (read_splat if name.endswith("splat") else read_spz)(tmp_path / name)


@pytest.mark.parametrize("kind", ["ply-sequence", "splat-sequence", "spz", "compressed.ply"])
def test_exports_of_a_scene_come_back_as_clouds(tmp_path, kind):
    if kind in ("spz", "compressed.ply"):
        pytest.importorskip("gsply")
    scene = toy_scene(per_part=20, frames=3)
    write_scene(tmp_path / "s.h5", scene)
    for words in (
        f"generate4d export {tmp_path}/s.h5 --as {kind} -o {tmp_path}/f/ --axes keep",
        f"prepare clouds {tmp_path}/f -o {tmp_path}/c.h5 --item-seconds 0 --jobs 1",
    ):
        assert exit_code(*words.split()) == 0
    found = CloudsReader(tmp_path / "c.h5").read(0)
    for t in range(3):
        own = slice(*found.frame_offsets[t : t + 2])
        ours, theirs = (
            np.hstack([found.points[own], found.color[own]]),
            np.hstack([scene.frame_mean[t], 255 * shown(scene)]),
        )
        nearest = np.abs(ours[:, None] - theirs[None]) / [1e-3, 1e-3, 1e-3, 3, 3, 3]
        assert len(ours) == len(theirs) and nearest.max(-1).min(1).max() < 1  # as a set: spz may order them anew


def shown(scene) -> np.ndarray:
    return np.clip(0.5 + C0 * scene.sh[:, 0], 0, 1)
