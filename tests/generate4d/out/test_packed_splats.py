"""Packed files of players, decoded here as their formats say: SuperSplat's .compressed.ply, Niantic's .spz."""

from __future__ import annotations

import errno
import gzip
import os
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.generate4d.commands.export import export_scene
from dpcli.generate4d.out.export import export_file
from dpcli.generate4d.out.packed_splats import write_compressed_ply, write_spz
from dpcli.generate4d.out.splat_files import Splats
from dpcli.runtime.whole_file import DiskFull
from dpcli.store.gaussians import GaussianScene, write_scene
from tests.support.scenes import toy_scene

HALF = np.sqrt(0.5)
ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def scene() -> GaussianScene:
    """Gaussians of any orientation, size, opacity and color; 700 of them, so that the last chunk of 256 is not full."""
    rng, scene = np.random.default_rng(3), toy_scene(per_part=350, frames=3)
    turns = rng.normal(size=scene.frame_quaternion.shape)
    return replace(
        scene,
        frame_quaternion=np.float32(turns / np.linalg.norm(turns, axis=-1, keepdims=True)),
        log_scale=np.float32(rng.uniform(-6, -2, scene.log_scale.shape)),
        opacity_logit=np.float32(rng.uniform(-3, 4, scene.num_gaussians)),
        sh=np.float32(rng.uniform(-1.5, 1.5, scene.sh.shape)),
    )


def _without_sign(quaternions: np.ndarray) -> np.ndarray:
    """Quaternions (N,4) of which the largest number is positive."""
    largest = np.take_along_axis(quaternions, np.abs(quaternions).argmax(1)[:, None], 1)
    return quaternions * np.sign(largest)


def _read_spz(path: Path) -> dict[str, np.ndarray]:
    data = gzip.decompress(path.read_bytes())
    magic, version, count, degree, bits, flags, _ = struct.unpack_from("<4sIIBBBB", data)
    assert (magic, version, degree, flags) == (b"NGSP", 3, 0, 0)
    sections, at = {}, 16
    for name, width in (("mean", 9), ("opacity", 1), ("color", 3), ("scale", 3), ("turn", 4)):
        sections[name] = np.frombuffer(data, np.uint8, width * count, at).reshape(count, width)
        at += width * count
    assert at == len(data)
    bytes3 = sections["mean"].reshape(count, 3, 3).astype(np.int64)
    whole = bytes3[..., 0] | bytes3[..., 1] << 8 | bytes3[..., 2] << 16
    return {
        "mean": np.where(whole >= 1 << 23, whole - (1 << 24), whole) / 2.0**bits,
        "opacity": sections["opacity"][:, 0] / 255,
        "sh": (sections["color"] / 255 - 0.5) / 0.15,
        "log_scale": sections["scale"] / 16 - 10,
        "quaternion": _smallest_three(sections["turn"].copy().view("<u4")[:, 0]),
    }


def _smallest_three(packed: np.ndarray) -> np.ndarray:
    """Quaternions w x y z of .spz: 2 bits say which of x y z w is left out, 9 bits and a sign each for the others."""
    largest, rest = packed >> 30, packed.astype(np.int64)
    out = np.zeros((len(packed), 4))
    for axis in (3, 2, 1, 0):
        here = largest != axis
        value = HALF * (rest & 511) / 511 * np.where(rest >> 9 & 1, -1, 1)
        out[here, axis] = value[here]
        rest = np.where(here, rest >> 10, rest)
    left = np.sqrt(np.maximum(1 - (out**2).sum(1), 0))
    out[np.arange(len(out)), largest] = left
    return out[:, [3, 0, 1, 2]]


def _read_compressed(path: Path) -> dict[str, np.ndarray]:
    from plyfile import PlyData

    file = PlyData.read(str(path))
    chunk, vertex = file["chunk"].data, file["vertex"].data
    of = np.arange(len(vertex)) // 256

    def ranged(packed: np.ndarray, kind: str) -> np.ndarray:
        parts = [packed >> 21 & 2047, packed >> 11 & 1023, packed & 2047]
        columns = []
        for axis, part, top in zip("xyz", parts, (2047, 1023, 2047)):
            low, high = chunk[f"min_{kind}{axis}"][of], chunk[f"max_{kind}{axis}"][of]
            columns.append(low + (high - low) * part / top)
        return np.stack(columns, 1)

    turn = vertex["packed_rotation"].astype(np.int64)
    others = np.stack([turn >> 20 & 1023, turn >> 10 & 1023, turn & 1023], 1) / 1023 * 2 - 1
    quaternion = np.zeros((len(turn), 4))
    for largest in range(4):
        here = turn >> 30 == largest
        rest = [k for k in range(4) if k != largest]
        quaternion[np.ix_(here, rest)] = others[here] * HALF
        quaternion[here, largest] = np.sqrt(np.maximum(1 - (others[here] ** 2).sum(1) / 2, 0))
    color = vertex["packed_color"].astype(np.int64)
    return {
        "mean": ranged(vertex["packed_position"].astype(np.int64), ""),
        "log_scale": ranged(vertex["packed_scale"].astype(np.int64), "scale_"),
        "quaternion": quaternion,
        "opacity": (color & 255) / 255,
    }


def _sorted(read: dict[str, np.ndarray], means: np.ndarray) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """What was read in the order of `means`: writers may order Gaussians as they like. And how far each mean is off."""
    from scipy.spatial import cKDTree

    far, at = cKDTree(read["mean"]).query(means)
    assert len(set(at)) == len(means)
    return {key: values[at] for key, values in read.items()}, far


def test_an_spz_holds_the_gaussians(scene, tmp_path):
    export_file(scene, tmp_path / "a.spz", "spz", time=0.4)
    splats = Splats.of(scene, 0.4, "keep")
    read = _read_spz(tmp_path / "a.spz")
    np.testing.assert_allclose(read["mean"], splats.mean, atol=1e-5)
    np.testing.assert_allclose(read["log_scale"], splats.log_scale, atol=1 / 31)
    np.testing.assert_allclose(read["sh"], splats.sh[:, 0], atol=1 / 255 / 0.15)
    np.testing.assert_allclose(read["opacity"], 1 / (1 + np.exp(-splats.opacity_logit)), atol=1 / 255)
    np.testing.assert_allclose(_without_sign(read["quaternion"]), _without_sign(splats.quaternion), atol=3e-3)


def test_a_compressed_ply_holds_the_gaussians(scene, tmp_path):
    export_file(scene, tmp_path / "a.compressed.ply", "compressed.ply", time=0.4)
    splats = Splats.of(scene, 0.4)
    read, far = _sorted(_read_compressed(tmp_path / "a.compressed.ply"), splats.mean)
    assert far.max() < 2e-3
    np.testing.assert_allclose(read["log_scale"], splats.log_scale, atol=5e-3)
    np.testing.assert_allclose(read["opacity"], 1 / (1 + np.exp(-splats.opacity_logit)), atol=1 / 255)
    np.testing.assert_allclose(_without_sign(read["quaternion"]), _without_sign(splats.quaternion), atol=3e-3)


def test_a_compressed_ply_is_written_without_torch(scene, tmp_path):
    """gsply's own plywrite imports torch and its compiler, which took nine seconds of an export's twenty-two."""
    write_scene(tmp_path / "s.h5", scene)
    options = "form='compressed.ply', time=None, axes='player', min_opacity=None, points=None, seed=0, force=False"
    lines = (
        "import sys; from dpcli.generate4d.commands.export import export_scene",
        f"export_scene('s.h5', 'a.compressed.ply', {options}); print('torch' in sys.modules)",
    )
    command = [sys.executable, "-c", "\n".join(lines)]
    run = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": str(ROOT)}
    )
    assert (run.stdout, run.returncode) == ("False\n", 0), run.stderr


@pytest.mark.parametrize("place", [500, -3e3, 1e5, 4e5])
def test_far_coordinates_are_not_wrapped(scene, tmp_path, place):
    far = replace(Splats.of(scene), mean=Splats.of(scene).mean + np.float32([place, 0, 0]))
    write_spz(tmp_path / "a.spz", far)
    np.testing.assert_allclose(_read_spz(tmp_path / "a.spz")["mean"], far.mean, atol=max(1 / 4096, abs(place) / 1e5))
    with pytest.raises(DataError, match=r"b.spz: .spz holds no coordinate of 1e\+07; write --as"):
        write_spz(tmp_path / "b.spz", replace(far, mean=np.full_like(far.mean, 1e7)))


@pytest.mark.parametrize("unit", [1e-4, 1e-2, 1.0, 1e3, 1e4])
def test_sizes_of_any_unit_are_kept_or_refused(unit, scene, tmp_path):
    splats = Splats.of(scene)
    other = replace(splats, mean=splats.mean * np.float32(unit), log_scale=splats.log_scale + np.float32(np.log(unit)))
    if unit in (1e-4, 1e4):
        with pytest.raises(
            DataError, match=r"a.spz: .spz holds sizes of 4.5e-05 to 384, but the Gaussians have .*; write --as"
        ):
            write_spz(tmp_path / "a.spz", other)
        return
    write_spz(tmp_path / "a.spz", other)
    read, longest = _read_spz(tmp_path / "a.spz"), other.log_scale.max(1)
    np.testing.assert_allclose(read["log_scale"].max(1), np.maximum(longest, -10), atol=1 / 31)  # few are smaller
    np.testing.assert_allclose(read["mean"], other.mean, atol=max(1e-5, 1e-4 * unit))


@pytest.mark.parametrize(("write", "suffix"), [(write_spz, "spz"), (write_compressed_ply, "compressed.ply")])
def test_equal_scenes_give_equal_bytes_and_a_missing_library_is_named(write, suffix, scene, tmp_path, monkeypatch):
    for name in "ab":
        write(tmp_path / f"{name}.{suffix}", Splats.of(scene))
    assert (tmp_path / f"a.{suffix}").read_bytes() == (tmp_path / f"b.{suffix}").read_bytes()
    monkeypatch.setitem(sys.modules, "gsply", None)
    with pytest.raises(DataError, match=r"dpc-toolkit\[splats\]"):
        write(tmp_path / f"c.{suffix}", Splats.of(scene))


@pytest.mark.parametrize(("write", "suffix"), [(write_spz, "spz"), (write_compressed_ply, "compressed.ply")])
def test_a_full_disk_is_told_by_the_name_of_the_file(write, suffix, scene, tmp_path, monkeypatch):
    def full(path: Path, data: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(DiskFull, match=f"a.{suffix}: no space left"):
        write(tmp_path / f"a.{suffix}", Splats.of(scene))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("form", ["spz", "compressed.ply"])
def test_the_command_writes_one_file_or_a_folder(form, scene, tmp_path):
    write_scene(tmp_path / "s.h5", scene, source="toy")
    words = {"form": form, "time": None, "axes": "player", "min_opacity": 0.2, "points": None, "seed": 0}
    export_scene(str(tmp_path / "s.h5"), str(tmp_path / f"one.{form}"), force=False, **words)
    export_scene(str(tmp_path / "s.h5"), str(tmp_path / "many"), force=False, **words)
    assert (tmp_path / f"one.{form}").stat().st_size > 5000
    assert sorted(path.name for path in (tmp_path / "many").iterdir()) == [f"frame000{i}.{form}" for i in (1, 2, 3)]
