"""`prepare artemis` on a small folder written value by value in the official format."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dpcli.errors import DataError, UsageError
from dpcli.ops.cameras import orbit_of
from dpcli.prepare.bounding_sphere import bounding_sphere
from dpcli.prepare.views.artemis import ArtemisOptions, artemis_clip, nearest_azimuths
from dpcli.prepare.views.artemis_files import Skin, outer_shell, read_intrinsics, read_poses
from dpcli.prepare.views.orbit_world import into_orbit, sphere_of_silhouettes, up_direction
from dpcli.store import ViewsReader

CAMERAS, FRAMES, WIDTH, HEIGHT = 8, 5, 96, 64
SHIFT = np.array([3.0, -2.0, 5.0])  # where the capture's world has its animal
UP = np.array([0.2, 0.9, -0.3]) / np.linalg.norm([0.2, 0.9, -0.3])  # and its up


def turn(axis: np.ndarray, angle: float) -> np.ndarray:
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def frame_of(up: np.ndarray) -> np.ndarray:
    """Columns: two axes across `up`, and `up`."""
    first = np.cross(up, [1.0, 0, 0])
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(up, first), up])


def camera_poses(count: int = CAMERAS) -> np.ndarray:
    """camera-to-world (V,4,4), a ring around the animal a little above it; OpenCV axes."""
    poses, axes = [], frame_of(UP)
    for number in range(count):
        angle = 2 * np.pi * number / count + 0.3
        place = SHIFT + axes @ np.array([30 * np.cos(angle), 30 * np.sin(angle), 6])
        forward = (SHIFT - place) / np.linalg.norm(SHIFT - place)
        right = np.cross(forward, UP) / np.linalg.norm(np.cross(forward, UP))
        pose = np.eye(4)
        pose[:3] = np.column_stack([right, np.cross(forward, right), forward, place])
        poses.append(pose)
    return np.stack(poses)


def inf_rows(poses: np.ndarray) -> str:
    """A row of 12 per pose: the 3rd, 1st, 2nd and 4th column of [R T], written number by number."""
    lines = []
    for pose in poses:
        lines.append(" ".join(f"{pose[row, column]:.9f}" for column in (2, 0, 1, 3) for row in range(3)))
    return "\n".join(lines) + "\n"


def intrinsic_text(cameras: np.ndarray) -> str:
    blocks = []
    for number, camera in enumerate(cameras):
        blocks.append(f"{number}\n" + "\n".join(" ".join(f"{v:.9f}" for v in row) for row in camera) + "\n\n")
    return "".join(blocks)


def scene() -> dict[str, np.ndarray]:
    """Two boxes of voxels, body and leg, on two bones; the leg swings."""
    grid = np.stack(np.meshgrid(*[np.arange(6.0)] * 3, indexing="ij"), -1).reshape(-1, 3)
    axes = frame_of(UP)
    voxels = np.concatenate([grid - 2.5, grid - 2.5 + [0, 6.0, 0]])
    weights = np.array([[1.0, 0.0]] * 216 + [[0.2, 0.8]] * 216)
    rest = np.tile(np.eye(4), (2, 1, 1))
    rest[0, :3, :3], rest[1, :3, :3] = axes, turn(np.array([1.0, 2, 3]), 0.7) @ axes
    rest[:, :3, 3] = SHIFT + np.array([[0, 0, 0], [0.5, 3.0, 0.2]])
    bones = np.stack([rest] * FRAMES)
    for frame in range(FRAMES):
        bones[frame, 1, :3, :3] = turn(axes[:, 0], 0.15 * frame) @ rest[1, :3, :3]
    cameras = np.stack([np.array([[70.0 + v, 0, 47 + v / 2], [0, 71.0 + v, 33], [0, 0, 1]]) for v in range(CAMERAS)])
    points = voxels @ axes.T + SHIFT
    return {
        "points": points,
        "indices": np.tile([0, 1], (432, 1)),
        "weights": weights,
        "rest": rest,
        "bones": bones,
        "poses": camera_poses(),
        "cameras": cameras,
    }


def skinned(data: dict[str, np.ndarray], frame: int) -> np.ndarray:
    """Every voxel at a frame, bone by bone: the definition, without einsum."""
    placed = []
    for point, weights in zip(data["points"], data["weights"]):
        total = np.zeros(3)
        for bone, weight in enumerate(weights):
            local = np.linalg.inv(data["rest"][bone]) @ np.append(point, 1)
            total += weight * (data["bones"][frame, bone] @ local)[:3]
        placed.append(total)
    return np.array(placed)


def project(camera: np.ndarray, world_to_camera: np.ndarray, points: np.ndarray) -> np.ndarray:
    seen = (points @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]) @ camera.T
    return seen[:, :2] / seen[:, 2:]


def write_animal(folder: Path) -> dict[str, np.ndarray]:
    import torch

    data = scene()
    (folder / "volumes").mkdir(parents=True)
    (folder / "bones" / "walk").mkdir(parents=True)
    (folder / "CamPose.inf").write_text(inf_rows(data["poses"]))
    (folder / "Intrinsic.inf").write_text(intrinsic_text(data["cameras"]))
    (folder / "sequences").write_text(f"walk {FRAMES}\nrun 100\n")
    (folder / "bones" / "Bones_0000.inf").write_text(inf_rows(data["rest"]))
    np.save(folder / "bones" / "bone_parents.npy", np.array([-1, 0]))
    torch.save(torch.tensor(data["points"], dtype=torch.float32), folder / "volumes" / "coords_init.pth")
    torch.save(torch.tensor(data["indices"]), folder / "volumes" / "volume_indices.pth")
    torch.save(torch.tensor(data["weights"], dtype=torch.float32), folder / "volumes" / "volume_weights.pth")
    for frame in range(FRAMES):
        (folder / "bones" / "walk" / f"Bones_{frame:04d}.inf").write_text(inf_rows(data["bones"][frame]))
        pictures = folder / "img" / "walk" / str(frame)
        pictures.mkdir(parents=True)
        points = skinned(data, frame)
        for view in range(CAMERAS):
            pixel = project(data["cameras"][view], np.linalg.inv(data["poses"][view]), points)
            alpha = np.zeros((HEIGHT, WIDTH), np.uint8)
            for u, v in np.floor(pixel).astype(int):
                alpha[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2] = 255
            color = np.full((HEIGHT, WIDTH, 3), 40 + 20 * view, np.uint8)
            Image.fromarray(color).save(pictures / f"img_{view:04d}.jpg", quality=95)
            Image.fromarray(alpha).save(pictures / f"img_{view:04d}_alpha.png")
    return data


@pytest.fixture(scope="module")
def animal(tmp_path_factory) -> tuple[Path, dict[str, np.ndarray]]:
    folder = tmp_path_factory.mktemp("dfa") / "panda"
    return folder, write_animal(folder)


@pytest.fixture
def own(tmp_path, animal) -> Path:
    """A copy that a test may damage."""
    import shutil

    return Path(shutil.copytree(animal[0], tmp_path / "panda"))


WALK = ArtemisOptions(motion="walk", size=48, tracks=10_000)


def test_tracks_stay_on_the_same_pixels(animal):
    folder, data = animal
    clip = artemis_clip(folder, WALK)
    header = clip.header
    shell = outer_shell(data["points"])
    assert clip.track.shape == (FRAMES, len(shell), 3)
    for number, view in enumerate(views_of(header, data)):
        for frame in range(FRAMES):
            before = project(data["cameras"][view], np.linalg.inv(data["poses"][view]), skinned(data, frame)[shell])
            after = project(header.intrinsics[number], header.world_to_camera[number], clip.track[frame].astype(float))
            # crop and resize are one scale and one shift for the whole clip: recovered from two points, checked on all
            far = np.abs(before - before[0]).sum(axis=1).argmax()
            scale = np.linalg.norm(after[far] - after[0]) / np.linalg.norm(before[far] - before[0])
            if frame == 0:
                first = (scale, after[0] - scale * before[0])
            np.testing.assert_allclose(after, first[0] * before + first[1], atol=2e-3)


def views_of(header, data) -> list[int]:
    """Which camera of the folder each view is: by its focal length over the crop's scale, which is its own."""
    ratio = header.intrinsics[:, 0, 0] / header.intrinsics[:, 1, 1]
    own = data["cameras"][:, 0, 0] / data["cameras"][:, 1, 1]
    return [int(np.abs(own - value).argmin()) for value in ratio]


def test_the_world_is_ours(animal):
    folder, data = animal
    clip = artemis_clip(folder, WALK)
    assert np.linalg.norm(clip.track, axis=-1).max() == pytest.approx(0.75, abs=1e-5)
    orbits = np.rad2deg([orbit_of(pose)[:2] for pose in clip.header.world_to_camera])
    assert orbits[0, 0] == pytest.approx(0, abs=1e-6)
    assert (orbits[:, 1] > 0).all()  # the ring stands above the animal
    for pose in clip.header.world_to_camera:  # and upright: the picture's up has no part along the horizon
        assert abs(pose[0, 1]) < 1e-6 and pose[1, 1] < 0


def test_pictures_show_the_object_where_its_tracks_are(animal):
    folder, _ = animal
    clip = artemis_clip(folder, WALK)
    boxes = {}
    for view, frame, rgba in clip.pictures():
        assert rgba.shape == (48, 48, 4)
        pixel = np.floor(
            project(clip.header.intrinsics[view], clip.header.world_to_camera[view], clip.track[frame].astype(float))
        ).astype(int)
        assert (rgba[pixel[:, 1], pixel[:, 0], 3] > 127).mean() > 0.99
        rows, columns = np.nonzero(rgba[..., 3] > 26)
        boxes.setdefault(view, []).append((columns.min(), rows.min(), columns.max() + 1, rows.max() + 1))
    for found in boxes.values():  # the union over the clip fills 80 % of the side
        low, high = np.array(found)[:, :2].min(0), np.array(found)[:, 2:].max(0)
        assert (high - low).max() == pytest.approx(0.8 * 48, abs=2)


def test_parts_are_the_heaviest_bones(animal):
    folder, data = animal
    clip = artemis_clip(folder, WALK)
    shell = outer_shell(data["points"])
    np.testing.assert_array_equal(clip.part, data["weights"][shell].argmax(1))
    few = artemis_clip(folder, ArtemisOptions(motion="walk", size=48, tracks=50, seed=1))
    assert few.track.shape == (FRAMES, 50, 3) and set(few.part.tolist()) == {0, 1}
    again = artemis_clip(folder, ArtemisOptions(motion="walk", size=48, tracks=50, seed=1))
    np.testing.assert_array_equal(few.track, again.track)
    none = artemis_clip(folder, ArtemisOptions(motion="walk", size=48, tracks=0))
    assert none.track is None and none.part is None


def test_without_voxels_the_silhouettes_give_the_size(animal, own):
    import shutil

    shutil.rmtree(own / "volumes")
    with_tracks, without = artemis_clip(animal[0], WALK), artemis_clip(own, WALK)
    assert without.track is None
    # cameras of both worlds agree about where the object is and how large, within what silhouettes can say
    radius = [np.array([orbit_of(pose)[2] for pose in clip.header.world_to_camera]) for clip in (with_tracks, without)]
    np.testing.assert_allclose(radius[0], radius[1], rtol=0.25)


def test_cameras_are_chosen_and_named(animal, capsys):
    folder, data = animal
    clip = artemis_clip(folder, WALK)
    assert clip.header.role == ["reference"] + ["test"] * 4
    azimuths = np.rad2deg([orbit_of(pose)[0] for pose in clip.header.world_to_camera[1:]])
    off = (azimuths - [15, -75, 105, 195] + 180) % 360 - 180
    assert np.abs(off).max() < 35  # eight cameras about 45 degrees apart; for 15 the one at 0 is the reference itself
    assert "reference camera 0" in capsys.readouterr().err
    clip = artemis_clip(folder, ArtemisOptions(motion="walk", size=48, reference=3, cameras=(5, 1), train_cameras=(2,)))
    assert clip.header.role == ["reference", "test", "test", "train"] and views_of(clip.header, data) == [3, 5, 1, 2]
    for options in ({"reference": 9}, {"cameras": (0,)}, {"cameras": (1, 1)}, {"cameras": (1,), "train_cameras": (1,)}):
        with pytest.raises(UsageError):
            artemis_clip(folder, ArtemisOptions(motion="walk", size=48, **options))


def test_nearest_azimuths_takes_no_camera_twice():
    assert nearest_azimuths({1: 14.0, 2: 16.0, 3: -80.0, 4: 100.0, 5: -160.0}) == [1, 3, 4, 5]
    assert nearest_azimuths({7: 20.0}) == [7]
    assert nearest_azimuths({0: 10.0, 1: 12.0}, (11.0, 11.0)) == [0, 1]


def test_an_incomplete_copy_is_noticed(own, capsys):
    artemis_clip(own, WALK)
    assert "is the copy whole?" not in capsys.readouterr().err
    (own / "sequences").write_text(f"walk {FRAMES + 4}\n")
    artemis_clip(own, WALK)
    assert f"{FRAMES} of the {FRAMES + 4} frames" in capsys.readouterr().err


def test_frames_are_spread_and_timed(animal):
    clip = artemis_clip(animal[0], ArtemisOptions(motion="walk", size=48, frames=3, fps=10))
    np.testing.assert_allclose(clip.header.time, [0, 0.2, 0.4])
    assert sum(1 for _ in clip.pictures()) == 5 * 3


def test_the_order_of_columns_matters(tmp_path, animal):
    path = tmp_path / "CamPose.inf"
    path.write_text(inf_rows(animal[1]["poses"]))
    np.testing.assert_allclose(read_poses(path), animal[1]["poses"], atol=1e-8)
    rows = [" ".join(f"{pose[r, c]:.9f}" for c in (1, 0, 2, 3) for r in range(3)) for pose in animal[1]["poses"]]
    path.write_text("\n".join(rows))
    with pytest.raises(DataError, match="column order 3, 1, 2, 4"):
        read_poses(path)


def test_intrinsics_are_read_by_their_number(tmp_path, animal):
    path = tmp_path / "Intrinsic.inf"
    blocks = intrinsic_text(animal[1]["cameras"]).strip().split("\n\n")
    path.write_text("\n\n".join(reversed(blocks)))
    np.testing.assert_allclose(read_intrinsics(path), animal[1]["cameras"], atol=1e-8)


def test_skinning_moves_points_with_their_bones():
    data = scene()
    skin = Skin(data["points"], data["indices"], data["weights"])
    for frame in (0, 3):
        np.testing.assert_allclose(skin.at(data["bones"][frame], data["rest"]), skinned(data, frame), atol=1e-9)
    np.testing.assert_allclose(skin.at(data["rest"], data["rest"]), data["points"], atol=1e-9)


def test_outer_shell_is_what_has_a_free_side():
    grid = np.stack(np.meshgrid(*[np.arange(5)] * 3, indexing="ij"), -1).reshape(-1, 3)
    shell = outer_shell(grid * 0.02 + 0.3)
    np.testing.assert_array_equal(shell, np.flatnonzero(((grid == 0) | (grid == 4)).any(axis=1)))
    loose = np.random.default_rng(0).normal(size=(40, 3))
    np.testing.assert_array_equal(outer_shell(loose), np.arange(40))


def test_similarity_keeps_every_pixel_and_meets_its_description():
    rng = np.random.default_rng(0)
    poses = np.linalg.inv(camera_poses())
    points = rng.normal(size=(50, 3)) * 2 + SHIFT
    center, radius = bounding_sphere(points)
    assert np.linalg.norm(points - center, axis=1).max() == pytest.approx(radius)
    up = up_direction(poses)
    np.testing.assert_allclose(up, UP, atol=1e-6)
    world = into_orbit(up, poses[2], center, radius)
    np.testing.assert_allclose(world.rotation @ world.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(world.rotation) == pytest.approx(1)
    for pose in poses:
        np.testing.assert_allclose(
            project(np.eye(3), world.pose(pose), world.points(points)), project(np.eye(3), pose, points), atol=1e-10
        )
    assert orbit_of(world.pose(poses[2]))[0] == pytest.approx(0, abs=1e-9)
    # positive azimuth is toward the reference camera's right
    right = poses[2][0, :3]
    assert (world.rotation @ right)[0] > 0.99


def test_silhouettes_of_a_ball_give_its_sphere():
    poses = np.linalg.inv(camera_poses())
    camera = np.array([[700.0, 0, 480], [0, 700, 320], [0, 0, 1]])
    ball, radius = SHIFT + [0.5, -1.0, 0.7], 2.0
    boxes = []
    for pose in poses:
        x, y, z = pose[:3, :3] @ ball + pose[:3, 3]
        u, v, reach = 480 + 700 * x / z, 320 + 700 * y / z, 700 * radius / z
        boxes.append((u - reach, v - reach, u + reach, v + reach))
    center, found = sphere_of_silhouettes(np.stack([camera] * len(poses)), poses, boxes)
    np.testing.assert_allclose(center, ball, atol=1e-3)
    assert found == pytest.approx(radius, rel=1e-3)


def test_wrong_bones_are_noticed(own, capsys):
    artemis_clip(own, WALK)
    assert "seem to disagree" not in capsys.readouterr().err
    for frame in range(FRAMES):
        path = own / "bones" / "walk" / f"Bones_{frame:04d}.inf"
        bones = read_poses(path)
        bones[:, :3, 3] += 8 * UP
        path.write_text(inf_rows(bones))
    artemis_clip(own, WALK)
    assert "seem to disagree" in capsys.readouterr().err


def _evil(path: Path) -> None:
    class Evil:
        def __reduce__(self):
            return (open, (str(path) + ".touched", "w"))

    path.write_bytes(pickle.dumps(Evil(), protocol=2))


BAD = {
    "no cameras": (lambda a: (a / "CamPose.inf").unlink(), "CamPose.inf: missing"),
    "fewer cameras": (
        lambda a: (a / "CamPose.inf").write_text(inf_rows(camera_poses()[:3])),
        "3 cameras, Intrinsic.inf 8",
    ),
    "words": (lambda a: (a / "CamPose.inf").write_text("a b c"), "not numbers"),
    "short rows": (lambda a: (a / "CamPose.inf").write_text("1 2 3\n"), "rows of 12"),
    "intrinsics": (lambda a: (a / "Intrinsic.inf").write_text("0\n1 0 0\n"), "10 per camera"),
    "no alpha": (lambda a: (a / "img/walk/2/img_0000_alpha.png").unlink(), "lacks the alpha of camera 0"),
    "no image": (lambda a: (a / "img/walk/3/img_0000.jpg").unlink(), "frame 3 lacks camera 0"),
    "empty alpha": (
        lambda a: Image.fromarray(np.zeros((HEIGHT, WIDTH), np.uint8)).save(a / "img/walk/1/img_0000_alpha.png"),
        "the alpha is empty",
    ),
    "no bones": (lambda a: (a / "bones/walk/Bones_0002.inf").unlink(), "Bones_0002.inf: missing"),
    "one bone": (
        lambda a: (a / "bones/walk/Bones_0002.inf").write_text(inf_rows(scene()["rest"][:1])),
        "1 bones, the rest pose has 2",
    ),
    "pickle": (lambda a: _evil(a / "volumes/volume_weights.pth"), "plain tensors"),
    "no weights": (lambda a: (a / "volumes/volume_weights.pth").unlink(), "--tracks 0"),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_folders(own, kind):
    change, message = BAD[kind]
    change(own)
    with pytest.raises(DataError, match=message):
        artemis_clip(own, WALK)
    assert not list(own.rglob("*.touched"))


def test_skip_leaves_a_frame_out(own, capsys):
    (own / "img/walk/2/img_0000.jpg").unlink()
    clip = artemis_clip(own, ArtemisOptions(motion="walk", size=48, on_error="skip", fps=1))
    np.testing.assert_allclose(clip.header.time, [0, 1, 3, 4])
    assert clip.track.shape[0] == 4 and "frame 2 left out" in capsys.readouterr().err


def test_shapes_of_the_volumes(own):
    import torch

    torch.save(torch.tensor([[0, 5]] * 432), own / "volumes" / "volume_indices.pth")
    with pytest.raises(DataError, match="bone 5, but the bones files have 2"):
        artemis_clip(own, WALK)
    torch.save(torch.zeros(3, 2), own / "volumes" / "volume_weights.pth")
    with pytest.raises(DataError, match=r"expected \(N,3\), \(N,W\), \(N,W\)"):
        artemis_clip(own, WALK)


def test_the_command(tmp_path, animal, dpc_here):
    out = tmp_path / "a.h5"
    listed = dpc_here("prepare", "artemis", animal[0], "-o", out)
    assert listed.returncode == 2 and b"walk (5 frames)" in listed.stderr
    done = dpc_here("prepare", "artemis", animal[0], "--motion", "walk", "--size", 48, "--tracks", 64, "-o", out)
    assert done.returncode == 0, done.stderr
    with ViewsReader(out) as reader:
        assert (reader.num_views, reader.num_frames, reader.header.name) == (5, FRAMES, "panda-walk")
        assert reader.track.shape == (FRAMES, 64, 3) and reader.part.shape == (64,)
    assert dpc_here("prepare", "artemis", tmp_path, "--motion", "walk", "-o", tmp_path / "b.h5").returncode == 3
