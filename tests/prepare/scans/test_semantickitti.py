"""SemanticKITTI: scans and labels made byte by byte, the three groups of sequences, alignment by the poses."""

from __future__ import annotations

import shlex
import struct
import sys

import numpy as np
import pytest

from dpcli.errors import DataError, UsageError
from dpcli.prepare.pipeline import convert
from dpcli.prepare.scans.semantickitti import GROUPS, SemanticKitti, read_labels, read_poses
from dpcli.store import CloudsReader
from tests.support.commands import told as dpc
from tests.support.kitti_helpers import P2, velodyne_to_camera, write_calibration, write_scan
from tests.support.prepare_helpers import ROOT

CAR, TRUCK, BUS, ROAD, MOVING_CAR = 10, 18, 13, 40, 252


def label(kind, instance=0):
    return kind + (instance << 16)


LABELS = [
    label(CAR, 7),
    label(ROAD),
    label(CAR, 3),
    label(BUS, 3),
    label(MOVING_CAR, 3),
    label(TRUCK, 3),
    label(CAR, 7),
]


def write_scans(folder, scans, labels=None):
    """scans: name -> camera points (N,3); labels: name -> u32 values."""
    to_scanner = np.linalg.inv(velodyne_to_camera())
    for name, points in scans.items():
        write_scan(folder / "velodyne" / f"{name}.bin", points @ to_scanner[:3, :3].T + to_scanner[:3, 3])
        values = (labels or {}).get(name, [ROAD] * len(points))
        (folder / "labels").mkdir(exist_ok=True)
        (folder / "labels" / f"{name}.label").write_bytes(struct.pack(f"<{len(values)}I", *values))
    write_calibration(folder / "calib.txt", P0=P2, P2=P2, Tr=velodyne_to_camera()[:3])
    return folder


def visible(count, seed=0):
    """Camera points well inside the picture, 5 to 30 m away."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(5, 30, count)
    return np.stack([rng.uniform(-0.5, 0.5, count) * z, rng.uniform(-0.1, 0.2, count) * z, z], axis=1)


def sequences(raw):
    return raw / "dataset" / "sequences"


def test_objects_are_instances(tmp_path):
    points = np.concatenate([visible(7), [[0, 0, -5.0], [0, 0, 36.0], [29, 0, 20.0]]])  # behind, far, beside the view
    labels = [*LABELS, label(CAR, 9), label(CAR, 9), label(CAR, 9)]
    write_scans(sequences(tmp_path) / "00", {"000000": points}, {"000000": labels})
    reader = SemanticKitti(tmp_path)
    (item,) = reader.items()
    sequence = reader.read(item, None).sequence
    sequence.validate()
    assert (item.name, item.split) == ("00_000000", "train")
    np.testing.assert_allclose(sequence.points, points[:7] * [-1, -1, 1], atol=1e-4)
    # full labels in rising order: car 3, truck 3, moving car 3, car 7; the bus and the road are background
    assert sequence.part.tolist() == [4, 0, 1, 0, 3, 2, 4]
    other = SemanticKitti(tmp_path, objects=("bus",)).read(item, None).sequence
    assert other.part.tolist() == [0, 0, 0, 1, 0, 0, 0]
    camera = SemanticKitti(tmp_path, coordinates="camera").read(item, None).sequence
    np.testing.assert_allclose(camera.points, sequence.points * [-1, -1, 1])


@pytest.mark.parametrize("strange", [4, 9, 17, 19, 260, 65535])
def test_labels_renumbered_for_training_are_told(tmp_path, strange):
    """Their 10 and 18 are parking places and poles, and would be taken for cars and trucks."""
    labels = {"000000": [label(strange), *LABELS[1:]], "000001": LABELS}
    write_scans(sequences(tmp_path) / "00", {name: visible(7) for name in labels}, labels)
    reader = SemanticKitti(tmp_path)
    told = [" ".join(reader.read(item, None).notes) for item in reader.items()]
    assert ["classes that SemanticKITTI doesn't have" in one for one in told] == [True, False]


def test_labels_are_two_halves(tmp_path):
    (tmp_path / "a.label").write_bytes(bytes([0x0A, 0x00, 0x02, 0x01, 0xFC, 0x00, 0x00, 0x00]))  # little-endian
    semantic, full = read_labels(tmp_path / "a.label", 2)
    assert semantic.tolist() == [10, 252] and full.tolist() == [10 + 0x0102 * 65536, 252]
    with pytest.raises(DataError, match="8 bytes; expected 12, 4 for each of the scan's 3 points"):
        read_labels(tmp_path / "a.label", 3)


def test_groups_of_table_4_6(tmp_path):
    for name in ("00", "08", "10"):
        write_scans(sequences(tmp_path) / name, {"000000": visible(5), "000001": visible(5)})
    found = {group: [item.name for item in SemanticKitti(tmp_path, group).items()] for group in GROUPS}
    assert found["all"] == sorted(found["without-08"] + found["only-08"])
    assert found["only-08"] == ["08_000000", "08_000001"]
    assert {item.split for item in SemanticKitti(tmp_path, "only-08").items()} == {"validation"}
    assert len(GROUPS["all"]) == 11 and len(GROUPS["without-08"]) == 10
    lines = SemanticKitti(tmp_path).summary(SemanticKitti(tmp_path).items())
    assert "sequences not there: 01, 02, 03, 04, 05, 06, 07, 09" in lines


def test_labels_whose_scans_are_not_there_are_named(tmp_path):
    folder = write_scans(sequences(tmp_path) / "03", {f"00000{k}": visible(5) for k in range(4)})
    for number in (1, 3):
        (folder / "velodyne" / f"00000{number}.bin").unlink()
    reader = SemanticKitti(tmp_path)
    assert "2 label files without a scan: 03/000001, 03/000003; is the copy whole?" in reader.summary(reader.items())


@pytest.mark.parametrize("change", ["labels/000001.label", "velodyne/000001.bin", "calib.txt"])
def test_other_files_of_the_same_names_are_other_data(tmp_path, change):
    raw, out = tmp_path / "raw", tmp_path / "x.h5"
    path = write_scans(sequences(raw) / "00", {"000000": visible(5), "000001": visible(6)}) / change
    kept = path.read_bytes()
    path.write_bytes(kept + b"\n" if path.suffix == ".txt" else kept[:8])
    convert(SemanticKitti(raw), out)
    assert convert(SemanticKitti(raw), out).was_complete
    path.write_bytes(kept)
    with pytest.raises(UsageError, match="exists, made with"):
        convert(SemanticKitti(raw), out)


@pytest.mark.parametrize("turned", [False, True])
def test_scans_of_ones_own_without_a_camera_are_kept_whole(tmp_path, turned):
    points = np.concatenate([visible(5), [[0, 0, -5.0], [50, 0, 20.0]]])
    folder = write_scans(sequences(tmp_path) / "00", {"000000": points}, {"000000": LABELS})
    to_camera = velodyne_to_camera() if turned else np.eye(4)
    write_calibration(folder / "calib.txt", P2=np.eye(4)[:3], Tr=to_camera[:3])
    sample = SemanticKitti(tmp_path).read(SemanticKitti(tmp_path).items()[0], None)
    assert sum("scans kept whole" in note for note in sample.notes) == 1
    scan = np.fromfile(folder / "velodyne" / "000000.bin", "<f4").reshape(-1, 4)[:, :3]
    expected = points * [-1, -1, 1] if turned else scan[:, [1, 2, 0]]  # x left, y up, z forward
    np.testing.assert_allclose(sample.sequence.points, expected, atol=1e-4)


def test_command_windows_and_skipped(tmp_path):
    raw = tmp_path / "semantisches kitti"
    scans = {f"{n:06d}": visible(6, n) for n in range(7)}
    labels = {name: [label(CAR, 1 + n % 2)] * 3 + [ROAD] * 3 for n, name in enumerate(scans)}
    folder = write_scans(sequences(raw) / "08", scans, labels)
    (folder / "labels" / "000004.label").unlink()
    options = ("--group", "only-08", "--frames", 2, "--jobs", 1, "--item-seconds", 0)
    done = dpc("prepare", "semantickitti", raw, *options, "-o", tmp_path / "x.h5")
    assert done.returncode == 0, done.stderr
    assert "1 scan at the ends of sequences left out: fewer than --frames 2" in done.stderr
    with CloudsReader(tmp_path / "x.h5") as reader:
        assert reader.names == ["08_000000", "08_000002"] and reader.frame_counts.tolist() == [2, 2]
        assert reader.skipped[0][0] == "08_000004" and "000004.label: missing" in reader.skipped[0][1]
        assert reader.read(0).part.tolist() == [1, 1, 1, 0, 0, 0, 2, 2, 2, 0, 0, 0]  # numbered over both frames


def motion(angle, shift):
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    return np.block([[turn, np.reshape(shift, (3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]])


def test_alignment_puts_what_stands_still_in_one_place(tmp_path):
    """The same world points seen from two places of a drive coincide after alignment, and not without."""
    poses = [motion(0.3, (5, 0, 2)), motion(0.3, (1, 0, 1)), motion(0.35, (1.2, 0, 1.9))]
    world = visible(40) @ poses[1][:3, :3].T + poses[1][:3, 3]
    seen = [(world - pose[:3, 3]) @ pose[:3, :3] for pose in poses]
    folder = write_scans(sequences(tmp_path) / "03", {"000001": seen[1], "000002": seen[2]})
    (folder / "poses.txt").write_text("\n".join(" ".join(map(str, pose[:3].ravel())) for pose in poses) + "\n")
    reader = SemanticKitti(tmp_path, frames=2, align=True)
    (item,) = reader.items()
    sequence = reader.read(item, None).sequence
    first, second = sequence.frame(0), sequence.frame(1)
    assert len(first) == 40 and len(second) > 20
    distance = np.linalg.norm(second[:, None] - first, axis=2).min(1)
    assert distance.max() < 1e-4
    plain = SemanticKitti(tmp_path, frames=2).read(item, None).sequence
    assert np.linalg.norm(plain.frame(1)[:, None] - plain.frame(0), axis=2).min(1).max() > 0.05
    (folder / "poses.txt").write_text(" ".join(["1"] * 12) + "\n")
    with pytest.raises(DataError, match="1 line, none for scan 000002"):
        reader.read(item, None)


@pytest.mark.parametrize(
    "text, words",
    [
        (None, "not found; --align needs it"),
        ("a b", "not lines of 12 numbers"),
        ("1 2 3", "expected 12 finite numbers"),
        ("nan " * 12, "expected 12 finite numbers"),
        ("", "expected 12 finite numbers"),
    ],
)
def test_damaged_poses(text, words, tmp_path):
    if text is not None:
        (tmp_path / "poses.txt").write_text(text)
    with pytest.raises(DataError, match=words):
        read_poses(tmp_path / "poses.txt")


def test_gaps_and_missing_things(tmp_path):
    with pytest.raises(DataError, match="no sequences/00/velodyne/ in it"):
        SemanticKitti(tmp_path).items()
    with pytest.raises(DataError, match="no sequences/08/velodyne/ in it"):
        SemanticKitti(tmp_path, "only-08").items()
    folder = write_scans(sequences(tmp_path) / "00", {"000000": visible(5), "000002": visible(5)})
    (item,) = SemanticKitti(tmp_path, frames=2).items()
    assert "000000 to 000002 are not 2 successive scans" in item.problem
    with pytest.raises(DataError, match="no sequence holds 3 scans"):
        SemanticKitti(tmp_path, frames=3).items()
    reader = SemanticKitti(tmp_path)
    write_calibration(folder / "calib.txt", P2=P2)
    with pytest.raises(DataError, match="no line 'Tr:'; found P2"):
        reader.read(reader.items()[0], None)
    (folder / "calib.txt").unlink()
    with pytest.raises(DataError, match="calib.txt: missing"):
        reader.read(reader.items()[0], None)
    write_scans(folder, {"000000": -visible(5)})
    with pytest.raises(DataError, match="without a point in the camera's view"):
        reader.read(reader.items()[0], None)


def test_wrong_options(tmp_path):
    for options, words in (
        ({"group": "09"}, "expected all, without-08, only-08"),
        ({"objects": ("van",)}, "expected some of car"),
        ({"frames": 0}, "expected 1 or more"),
    ):
        with pytest.raises(UsageError, match=words):
            SemanticKitti(tmp_path, **options)


RECIPES = ("ogc-dr", "ogc-drsv", "kitti-sf", "kitti-det", "semantickitti")


@pytest.mark.parametrize("name", RECIPES)
def test_recipes_agree_with_the_readers(name):
    """Sections, a command that exists, and counts that are those of the code and of each other."""
    tomllib = pytest.importorskip("tomllib" if sys.version_info >= (3, 11) else "tomli")
    from typer.main import get_command

    from dpcli.cli.prepare.app import ROOM
    from dpcli.prepare.articulated import ogc, ogc_rooms
    from dpcli.prepare.scans import kitti_det, kitti_sf

    recipe = tomllib.loads((ROOT / "data_recipes" / f"{name}.toml").read_text())
    assert recipe["name"] == name and {"ask", "license"} <= recipe["get"].keys() and recipe["layout"]["tree"]
    program, *words = shlex.split(recipe["prepare"]["command"])
    assert [program, *words[:2]] == ["dpc", "prepare", name] and name in get_command(ROOM.application()).commands
    split, count = recipe["split"], recipe["expect"]["sequences"]
    if name.startswith("ogc"):
        assert count == ogc.ROOMS == sum(split[key] for key in ("train", "validation", "test"))
        assert [split[key] / count for key in ("train", "validation", "test")] == pytest.approx(ogc_rooms.FRACTIONS)
        assert recipe["checks"]["points"] == ogc_rooms.POINTS
    elif name == "kitti-sf":
        assert (count, split["train"]) == (kitti_sf.SCENES, kitti_sf.TRAIN_SCENES)
    elif name == "kitti-det":
        assert count == kitti_det.SCANS == split["train"] + split["validation"]
        assert [split["train"], split["validation"]] == [3712, 3769]  # of the lists that others use
    else:
        each = recipe["raw"][0]["each"]
        assert sum(each) == count == split["all"] and each[8] == split["only-08"] == count - split["without-08"]
        assert len(each) == len(GROUPS["all"])
