"""Exports of a scene: other programs read the files, the axes turn as they should, clouds flow into the segmenter."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dpcli.errors import DataError, DpcError, UsageError
from dpcli.generate4d.commands.export import export_scene
from dpcli.generate4d.out.export import as_sequence, export_sequence, keep_opaque
from dpcli.generate4d.out.splat_files import TO_PLAYER, Splats, camera_list, write_splat, write_splat_ply
from dpcli.ops.open3d_import import load_open3d
from dpcli.store import CloudsReader, PartsReader
from dpcli.store.gaussians import GaussianScene, write_scene
from tests.support.commands import piped
from tests.support.scenes import HINGE, SWING, toy_scene


@pytest.fixture(scope="module")
def scene() -> GaussianScene:
    return toy_scene(degree=3)


@pytest.fixture(scope="module")
def scene_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "toy.h5"
    write_scene(path, toy_scene(), source="toy", provenance={"command": "dpc generate4d fit toy.h5"})
    return path


def _matrices(quaternions: np.ndarray) -> np.ndarray:
    """Rotations (N,3,3) of quaternions w x y z, by SciPy."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(quaternions[:, [1, 2, 3, 0]]).as_matrix()


def _open3d(path: Path) -> dict[str, np.ndarray]:
    cloud = load_open3d().t.io.read_point_cloud(str(path))
    return {key: cloud.point[key].numpy() for key in cloud.point}


def test_open3d_reads_the_ply_as_gaussians(scene, tmp_path):
    splats = Splats.of(scene, 0.3)
    write_splat_ply(tmp_path / "a.ply", splats)
    read = _open3d(tmp_path / "a.ply")
    np.testing.assert_array_equal(read["positions"], splats.mean)
    np.testing.assert_array_equal(read["f_dc"], splats.sh[:, 0])
    np.testing.assert_array_equal(read["f_rest"], splats.sh[:, 1:])  # written channel by channel, back as terms of rgb
    np.testing.assert_array_equal(read["opacity"][:, 0], splats.opacity_logit)
    np.testing.assert_allclose(read["scale"], np.exp(splats.log_scale), rtol=1e-6)
    np.testing.assert_allclose(read["rot"], splats.quaternion, atol=1e-6)


def test_the_ply_header_is_what_players_expect(tmp_path):
    write_splat_ply(tmp_path / "a.ply", Splats.of(toy_scene(degree=1)))
    header = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")[0].decode("ascii").split("\n")
    assert header[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 300"]
    rest = [f"f_rest_{i}" for i in range(9)]
    names = [
        "x",
        "y",
        "z",
        "nx",
        "ny",
        "nz",
        "f_dc_0",
        "f_dc_1",
        "f_dc_2",
        *rest,
        "opacity",
        "scale_0",
        "scale_1",
        "scale_2",
        "rot_0",
        "rot_1",
        "rot_2",
        "rot_3",
    ]
    assert header[3:-1] == [f"property float {name}" for name in names]


def test_open3d_reads_the_splat(tmp_path):
    scene = toy_scene(per_part=20)
    scene = replace(scene, log_scale=scene.log_scale + np.linspace(0, 1, 40, dtype=np.float32)[:, None])
    write_splat(tmp_path / "a.splat", Splats.of(scene, 1.0, axes="keep"))
    assert (tmp_path / "a.splat").stat().st_size == 32 * 40
    read, order = _open3d(tmp_path / "a.splat"), np.arange(40)[::-1]  # the largest first
    means, quaternions = scene.at(1.0)
    np.testing.assert_array_equal(read["positions"], means[order])
    np.testing.assert_allclose(read["scale"], scene.scale[order], rtol=1e-5)
    turned = np.abs((read["rot"] * quaternions[order]).sum(1)) / np.linalg.norm(read["rot"], axis=1)
    assert turned.min() > 0.9999
    np.testing.assert_allclose(1 / (1 + np.exp(-read["opacity"][:, 0])), scene.opacity[order], atol=1 / 255)


_TERMS = (  # the real spherical harmonics of 3DGS up to factors, in its order, at directions x y z
    lambda x, y, z: 1 + 0 * x,
    lambda x, y, z: -y,
    lambda x, y, z: z,
    lambda x, y, z: -x,
    lambda x, y, z: x * y,
    lambda x, y, z: y * z,
    lambda x, y, z: 2 * z * z - x * x - y * y,
    lambda x, y, z: x * z,
    lambda x, y, z: x * x - y * y,
    lambda x, y, z: y * (3 * x * x - y * y),
    lambda x, y, z: x * y * z,
    lambda x, y, z: y * (4 * z * z - x * x - y * y),
    lambda x, y, z: z * (2 * z * z - 3 * x * x - 3 * y * y),
    lambda x, y, z: x * (4 * z * z - x * x - y * y),
    lambda x, y, z: z * (x * x - y * y),
    lambda x, y, z: x * (x * x - 3 * y * y),
)


def _seen(sh: np.ndarray, directions: np.ndarray) -> np.ndarray:
    return np.einsum("nkc,kd->ndc", sh, np.array([term(*directions.T) for term in _TERMS]))


def test_half_a_turn_for_players_turns_everything_together(scene):
    """Covariances, positions and the colors seen from a direction all turn by the same rotation."""
    kept, turned = Splats.of(scene, 0.7, "keep"), Splats.of(scene, 0.7)
    np.testing.assert_allclose(turned.mean, kept.mean @ TO_PLAYER.T, atol=1e-7)
    for one, two in ((_matrices(kept.quaternion), _matrices(turned.quaternion)),):
        np.testing.assert_allclose(two, TO_PLAYER @ one, atol=1e-6)
    directions = np.random.default_rng(0).normal(size=(40, 3))
    seen = _seen(kept.sh, directions)
    np.testing.assert_allclose(_seen(turned.sh, directions @ TO_PLAYER.T), seen, atol=1e-6)
    assert np.abs(_seen(kept.sh, directions @ TO_PLAYER.T) - seen).max() > 0.1  # so the test can fail


def test_cameras_see_the_exported_points_at_the_same_pixels(scene):
    for axes in ("player", "keep"):
        points = Splats.of(scene, 0.4, axes).mean
        for camera, lens, pose in zip(camera_list(scene, axes), scene.camera_intrinsics, scene.camera_world_to_camera):
            inside = (points - camera["position"]) @ np.array(camera["rotation"])  # camera to world, so its transpose
            own = scene.at(0.4)[0] @ pose[:3, :3].T + pose[:3, 3]
            np.testing.assert_allclose(inside, own, atol=1e-6)
            assert (camera["fx"], camera["cy"]) == (lens[0, 0], lens[1, 2])
    assert [camera["reference"] for camera in camera_list(scene)] == [True, False]


def test_a_sequence_has_the_names_and_files_that_players_take(scene, tmp_path):
    paths = export_sequence(scene, tmp_path / "clip", "ply")
    assert [path.name for path in paths] == [f"frame{t:04d}.ply" for t in range(1, 6)]
    assert sorted((tmp_path / "clip").iterdir()) == paths  # SuperSplat: any other file, and it is no sequence
    assert json.loads((tmp_path / "clip_metrics.json").read_text()) == {"psnr": 31.5}
    assert len(json.loads((tmp_path / "clip_cameras.json").read_text())) == 2
    last = _open3d(paths[-1])["positions"]
    np.testing.assert_array_equal(last, scene.frame_mean[-1] * [1, -1, -1])
    with pytest.raises(UsageError, match="--force"):
        export_sequence(scene, tmp_path / "clip", "splat")
    export_sequence(scene, tmp_path / "clip", "splat", force=True)
    assert not list((tmp_path / "clip").glob("*.ply"))
    (tmp_path / "clip" / "mine").mkdir()
    with pytest.raises(UsageError, match="other things, too, such as mine"):
        export_sequence(scene, tmp_path / "clip", "ply", force=True)
    assert list((tmp_path / "clip").glob("*.splat")) and (tmp_path / "clip" / "mine").is_dir()
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "clip",
        "clip_cameras.json",
        "clip_metrics.json",
    ]  # nothing half-made stays


def test_clouds_move_as_their_poses_say(scene):
    sequence = as_sequence(scene, "toy", axes="keep")
    sequence.validate()
    assert sequence.num_frames == 5 and sequence.pose.shape == (5, 2, 4, 4)
    for axes in ("keep", "player"):
        sequence = as_sequence(scene, "toy", axes=axes)
        for i, j in ((0, 4), (3, 1)):
            motion = sequence.pose[j] @ np.linalg.inv(sequence.pose[i])
            own = motion[sequence.part[:300]]
            moved = np.einsum("nij,nj->ni", own[:, :3, :3], sequence.frame(i)) + own[:, :3, 3]
            np.testing.assert_allclose(moved, sequence.frame(j), atol=1e-5)
    np.testing.assert_array_equal(sequence.track.reshape(5, 300)[3], np.arange(300))
    assert (sequence.color.reshape(5, 300, 3)[2, 0] == scene.color[0]).all()


def test_faint_gaussians_and_surplus_points_are_left_out(scene):
    logit = scene.opacity_logit.copy()
    logit[::3] = -3.0
    faint = replace(scene, opacity_logit=logit)
    sequence = as_sequence(faint, "toy")
    np.testing.assert_array_equal(sequence.track[:200], np.flatnonzero(np.arange(300) % 3))
    few = as_sequence(faint, "toy", points=50, rng=np.random.default_rng(1))
    assert len(few.frame(2)) == 50 and set(few.track) <= set(sequence.track)
    np.testing.assert_array_equal(few.frame(2), (faint.frame_mean[2] * [1, -1, -1])[few.track[:50]].astype(np.float32))
    with pytest.raises(DataError, match="the most opaque has 0.9"):
        as_sequence(faint, "toy", min_opacity=0.95)
    less = keep_opaque(faint, 0.3)
    less.validate()
    assert less.num_gaussians == 200 and len(less.control_point) == 6


def test_the_command_says_what_it_cannot_do(scene_file, tmp_path):
    usual = {"time": None, "axes": "player", "min_opacity": None, "points": None, "seed": 0, "force": False}
    for form, output, changes, says in (
        ("ply", tmp_path / "a.splat", {}, "ends in .ply"),
        ("ply", "-", {}, "only --as clouds"),
        ("ply", tmp_path / "clip", {"time": 0.5}, "--time is of one file"),
        ("splat-sequence", tmp_path / "clip", {"time": 0.5}, "name it with --as splat -o FILE.splat"),
        ("clouds", tmp_path / "a.h5", {"time": 0.5}, "--time is of one file: name it with --as ply -o FILE.ply"),
        ("cameras", tmp_path / "a.json", {"time": 0.0}, "--time is of one file"),
        ("ply", tmp_path / "a.ply", {"points": 9}, "--points is of --as clouds"),
        ("metrics", tmp_path / "a.h5", {"force": True}, "ends in .json"),
        ("cameras", tmp_path / "notes.txt", {}, "ends in .json"),
    ):
        with pytest.raises(UsageError, match=says):
            export_scene(str(scene_file), str(output), form=form, **{**usual, **changes})
    assert not list(tmp_path.iterdir())


def test_cameras_and_metrics_replace_nothing_unasked(scene_file, tmp_path, monkeypatch):
    usual = {"time": None, "axes": "player", "min_opacity": None, "points": None, "seed": 0}
    for form, name in (
        ("cameras", "notes.txt"),
        ("metrics", "scene.h5"),
        ("cameras", "mine.json"),
        ("metrics", "mine.json"),
    ):
        (tmp_path / name).write_bytes(b"mine")
        with pytest.raises(UsageError, match="--force replaces it" if name == "mine.json" else "ends in .json"):
            export_scene(str(scene_file), str(tmp_path / name), form=form, force=False, **usual)
        assert (tmp_path / name).read_bytes() == b"mine"
    written = Path.write_bytes

    def half(path: Path, content: bytes) -> int:
        written(path, content[:5])
        raise OSError(28, "No space left on device")

    (tmp_path / "mine.ply").write_bytes(b"mine")
    monkeypatch.setattr(Path, "write_bytes", half)
    for form, name in (("metrics", "mine.json"), ("ply", "mine.ply")):
        with pytest.raises(DpcError, match=f"{name}: no space left"):
            export_scene(str(scene_file), str(tmp_path / name), form=form, force=True, **usual)
        assert (tmp_path / name).read_bytes() == b"mine"
    monkeypatch.undo()
    export_scene(str(scene_file), str(tmp_path / "mine.json"), form="metrics", force=True, **usual)
    assert json.loads((tmp_path / "mine.json").read_text()) == {"psnr": 31.5}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.json", "mine.ply", "notes.txt", "scene.h5"]
    with pytest.raises(DataError, match="does not exist; create it first"):
        export_scene(str(scene_file), str(tmp_path / "no" / "a.json"), form="cameras", force=False, **usual)


def test_single_files_and_an_instant(scene_file, tmp_path):
    usual = {"form": "ply", "axes": "player", "min_opacity": None, "points": None, "seed": 0, "force": False}
    export_scene(str(scene_file), str(tmp_path / "a.ply"), time=1.0, **usual)
    blue = _open3d(tmp_path / "a.ply")["positions"][-1] * [1, -1, -1]
    start = toy_scene().mean[-1] - HINGE
    c, s = np.cos(SWING), np.sin(SWING)
    np.testing.assert_allclose(
        blue, HINGE + [c * start[0] - s * start[1], s * start[0] + c * start[1], start[2]], atol=1e-5
    )
    with pytest.raises(UsageError, match="--force"):
        export_scene(str(scene_file), str(tmp_path / "a.ply"), time=None, **usual)
    for time in (-1.0, 99.0):
        with pytest.raises(DataError, match=rf"holds 0 to [\d.]+ s, but --time is {time:g}"):
            export_scene(str(scene_file), str(tmp_path / "b.ply"), time=time, **usual)
    assert not (tmp_path / "b.ply").exists()
    usual |= {"form": "cameras", "min_opacity": 0.5}
    with pytest.raises(UsageError, match="--min-opacity is of Gaussians and clouds"):
        export_scene(str(scene_file), str(tmp_path / "c.json"), time=None, **usual)


def test_an_export_flows_into_the_segmenter(dpc_here, scene_file, tmp_path):
    clouds = piped("generate4d", "export", scene_file, "--as", "clouds", "--points", "200", "-o", "-")
    assert clouds.returncode == 0, clouds.stderr.decode()
    (tmp_path / "clouds.h5").write_bytes(clouds.stdout)
    parts, words = tmp_path / "parts.h5", "--method ward --parts 2 --flow nearest --set icp=0".split()
    said = dpc_here("segment", "predict", tmp_path / "clouds.h5", "-o", parts, *words)
    assert said.returncode == 0, said.stderr.decode()
    with CloudsReader(tmp_path / "clouds.h5") as reader, PartsReader(parts) as predicted:
        assert reader.names == predicted.names == ["toy"]
        assert reader.fields == ("time", "color", "part", "track", "pose")
        assert reader.provenance[0]["command"] == "dpc generate4d fit toy.h5"
        assert reader.provenance[1]["command"].startswith("dpc generate4d export")
        assert predicted.num_points == reader.num_points == 1000


@pytest.mark.parametrize("form", ["ply", "splat"])
def test_the_command_leaves_nothing_but_numbered_frames_in_the_folder(dpc_here, scene_file, tmp_path, form):
    """SuperSplat plays a folder where every name is NAME NUMBER.ply, and else loads all frames on top of each other."""
    done = dpc_here("generate4d", "export", scene_file, "--as", form, "-o", tmp_path / "frames")
    assert done.returncode == 0, done.stderr
    names = sorted(path.name for path in (tmp_path / "frames").iterdir())
    assert len(names) > 1 and all(re.fullmatch(rf"\D*\d+\.{form}", name) for name in names)
    assert {path.name for path in tmp_path.iterdir()} >= {"frames", "frames_cameras.json"}
