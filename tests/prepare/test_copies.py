"""Data sets as archives and editors leave them: hidden twins of files, byte order marks, folders of macOS. Nothing changes."""

from __future__ import annotations

import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest

from dpcli.prepare.actions.ntu60 import NTU60
from dpcli.prepare.actions.shrec17 import Shrec17
from dpcli.prepare.scans.kitti_det import KittiDetection
from dpcli.prepare.scans.modelnet40 import CLASS_NAMES, ModelNet40
from dpcli.prepare.scans.semantickitti import SemanticKitti
from dpcli.prepare.views.given_views import find_views
from tests.support.depth_png_helpers import hand_depth, ntu_files, person, write_files, write_gesture, write_lists
from tests.support.kitti_helpers import P2, velodyne_to_camera, write_calibration, write_png, write_scan

RNG = np.random.default_rng(0)
AHEAD = np.array([[10.0, 0.1 * k, 0] for k in range(8)])  # of the scanner, meters
TEXTS = (".txt", ".lst", ".json")
NTU = "S001C002P003R001A060"


def shrec17(root: Path) -> Shrec17:
    write_gesture(root, "gesture_1/finger_1/subject_2/essai_1", hand_depth(0, 2))
    return Shrec17(write_lists(root, ["1 1 2 1 1 1 2"]))


def ntu60(root: Path) -> NTU60:
    return NTU60((write_files(root, ntu_files(NTU, person(0, 2))),))


def kitti_det(root: Path) -> KittiDetection:
    folder, to_camera = root / "training", velodyne_to_camera()
    write_scan(folder / "velodyne" / "000000.bin", AHEAD)
    write_calibration(folder / "calib" / "000000.txt", P2=P2, R0_rect=np.eye(3), Tr_velo_to_cam=to_camera[:3])
    write_png(folder / "image_2" / "000000.png", np.zeros((375, 1242, 3), np.uint8))
    x, y, z = AHEAD[3] @ to_camera[:3, :3].T + to_camera[:3, 3]
    (folder / "label_2").mkdir()
    (folder / "label_2" / "000000.txt").write_text(f"Car 0 0 0 0 0 0 0 1.5 0.3 0.3 {x} {y + 0.7} {z} 0\n")
    return KittiDetection(root)


def semantickitti(root: Path) -> SemanticKitti:
    folder = root / "sequences" / "00"
    for name in ("000000", "000001"):
        write_scan(folder / "velodyne" / f"{name}.bin", AHEAD)
        (folder / "labels").mkdir(exist_ok=True)
        (folder / "labels" / f"{name}.label").write_bytes(np.full(len(AHEAD), 10 + (1 << 16), "<u4").tobytes())
    write_calibration(folder / "calib.txt", P2=P2, Tr=velodyne_to_camera()[:3])
    (folder / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 2)
    return SemanticKitti(root, frames=2, align=True)


def modelnet40(root: Path) -> ModelNet40:
    root.mkdir()
    with h5py.File(root / "ply_data_train0.h5", "w") as file:
        file["data"], file["label"] = np.zeros((2, 4, 3), np.float32), np.array([[0], [39]], np.uint8)
    (root / "train_files.txt").write_text("ply_data_train0.h5\n")
    (root / "shape_names.txt").write_text("\n".join(CLASS_NAMES) + "\n")
    return ModelNet40(root)


READERS = (shrec17, ntu60, kitti_det, semantickitti, modelnet40)


def hide_twins(root: Path) -> None:
    """What macOS puts beside every file on a disk of another system."""
    for path in [path for path in root.rglob("*") if path.is_file()]:
        path.with_name(f"._{path.name}").write_bytes(b"\0\5\x16\7\0\2\0\0")


def pack_twins(root: Path) -> None:
    """What unpacked archives of macOS hold beside the data."""
    for path in [path for path in root.rglob("*") if path.is_file()]:
        twin = root / "__MACOSX" / path.relative_to(root).with_name(f"._{path.name}")
        twin.parent.mkdir(parents=True, exist_ok=True)
        twin.write_bytes(b"\0\5\x16\7\0\2\0\0")


def mark_texts(root: Path) -> None:
    """What some editors write in front of every text."""
    for path in [path for path in root.rglob("*") if path.suffix in TEXTS]:
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())


def everything(reader, root: Path) -> list:
    read = [(item, reader.read(item, RNG)) for item in reader.items()]
    arrays = [(sample.sequence.points.tolist(), np.asarray(sample.sequence.part).tolist()) for _, sample in read]
    told = [(item.name, item.split, item.label, sample.notes) for item, sample in read]
    return [
        told,
        arrays,
        list(reader.class_names),
        [line.replace(str(root), "") for line in reader.summary(reader.items())],
    ]


@pytest.mark.parametrize("change", [hide_twins, pack_twins, mark_texts])
@pytest.mark.parametrize("make", READERS)
def test_nothing_is_read_otherwise_or_told(make, change, tmp_path):
    expected = everything(make(tmp_path / "plain"), tmp_path / "plain")
    reader = make(tmp_path / "copy")
    change(tmp_path / "copy")
    assert everything(reader, tmp_path / "copy") == expected


def test_an_archive_of_macos_is_read_without_its_twins(tmp_path):
    files = ntu_files(NTU, person(0, 2))
    with zipfile.ZipFile(tmp_path / "ntu.zip", "w") as archive:
        for name, content in files.items():
            folder, _, own = name.rpartition("/")
            archive.writestr(f"__MACOSX/{folder}/._{own}", b"\0\5\x16\7")
            archive.writestr(name, content)
    assert everything(NTU60((tmp_path / "ntu.zip",)), tmp_path) == everything(ntu60(tmp_path / "plain"), tmp_path)


def test_folders_of_macos_are_no_views(tmp_path):
    for view in range(6):
        for frame in range(3):
            write_png(tmp_path / f"view{view}" / f"{frame}.png", np.zeros((4, 4), np.uint8))
    expected = find_views(tmp_path, None, [0, 1, 2], 3)
    pack_twins(tmp_path)
    assert find_views(tmp_path, None, [0, 1, 2], 3) == expected and len(expected) == 6


def test_an_archive_of_windows_has_other_slashes(tmp_path):
    with zipfile.ZipFile(tmp_path / "ntu.zip", "w") as archive:
        archive.writestr("nturgb+d_depth_masked\\", b"")
        for name, content in ntu_files(NTU, person(0, 2)).items():
            archive.writestr(name.replace("/", "\\"), content)
    assert everything(NTU60((tmp_path / "ntu.zip",)), tmp_path) == everything(ntu60(tmp_path / "plain"), tmp_path)
