"""Clouds others have made, and ModelNet40: the same result as from the raw data, lists, hostile and damaged files."""

from __future__ import annotations

import pickle
import shlex
import sys
import zipfile

import h5py
import numpy as np
import pytest

from dpcli.errors import DataError, UsageError
from dpcli.prepare.actions import ntu60, shrec17, shrec17_lists
from dpcli.prepare.actions.msraction3d import MSRAction3D
from dpcli.prepare.actions.ntu60 import NTU60
from dpcli.prepare.actions.preprocessed import open_preprocessed
from dpcli.prepare.actions.pts_label import PtsLabel
from dpcli.prepare.pipeline import convert
from dpcli.prepare.scans import modelnet40
from dpcli.prepare.scans.modelnet40 import CLASS_NAMES, ModelNet40
from dpcli.store import CloudsReader
from tests.support.commands import told as dpc
from tests.support.depth_png_helpers import ntu_files, person, write_files, write_lists
from tests.support.prepare_helpers import ROOT, make_depth, write_msr

if sys.version_info >= (3, 11):
    import tomllib
else:
    tomllib = pytest.importorskip("tomli")

RNG = np.random.default_rng(0)
NTU, MSR = "S001C002P003R001A060", "a01_s07_e02"


def peer_clouds(depth: np.ndarray, width: int, height: int) -> np.ndarray:
    """What MeteorNet's and PSTNet's scripts save: an object array of float clouds, one per frame, focal length 280."""
    frames = np.empty(len(depth), object)
    for t, frame in enumerate(depth):
        rows, columns = np.nonzero(frame)
        z = frame[rows, columns]
        frames[t] = np.stack([(columns - width / 2) / 280 * z, (rows - height / 2) / 280 * z, z], axis=1)
    return frames


def only(reader):
    (item,) = [item for item in reader.items() if not item.problem]
    return reader.read(item, RNG).sequence


def test_meteornets_msr_is_what_the_raw_files_give(tmp_path):
    write_msr(tmp_path / "raw", [MSR], frames=4, height=240, width=320)
    depth = make_depth(0, 4, 240, 320).astype(np.float64)
    (tmp_path / "npz").mkdir()
    np.savez_compressed(tmp_path / "npz" / f"{MSR}_sdepth.npz", point_clouds=peer_clouds(depth, 320, 240))
    raw, reader = MSRAction3D(tmp_path / "raw"), open_preprocessed(tmp_path / "npz")
    a, b = only(raw), only(reader)
    np.testing.assert_allclose(b.points, a.points, rtol=1e-6, atol=1e-7)
    assert (b.name, b.split, b.label, b.subject) == (a.name, a.split, a.label, a.subject) == (MSR, "test", 0, 7)
    np.testing.assert_array_equal(a.frame_offsets, b.frame_offsets)
    assert (reader.length_unit, list(reader.class_names)) == (raw.length_unit, list(raw.class_names))


@pytest.mark.parametrize("protocol", ["xsub", "xview"])
def test_pstnets_ntu_is_what_the_raw_files_give(tmp_path, protocol):
    depth = person(0, 3)
    write_files(tmp_path / "raw", ntu_files(NTU, depth))
    stored = peer_clouds((depth / 65535).astype(np.float32), 512, 424)  # Matplotlib reads 16 bits as 0 to 1
    (tmp_path / "npz").mkdir()
    np.savez_compressed(tmp_path / "npz" / f"{NTU}.npz", data=stored)
    raw = NTU60((tmp_path / "raw",), protocol)
    reader = open_preprocessed(tmp_path / "npz", protocol=protocol)
    a, b = only(raw), only(reader)
    np.testing.assert_allclose(b.points, a.points, rtol=3e-6, atol=1e-6)
    assert (b.name, b.split, b.label, b.subject, b.camera) == (a.name, a.split, a.label, a.subject, a.camera)
    assert reader.length_unit == raw.length_unit == "655.35 mm"
    assert open_preprocessed(tmp_path / "npz", scale=1 / 65535).length_unit == "1 mm"


def test_frames_of_equal_size_are_read_as_well(tmp_path):
    """np.array of clouds with equal numbers of points is no array of arrays any more."""
    clouds = RNG.normal(size=(3, 20, 3))
    same = {"numbers": clouds, "objects": np.array(list(clouds), dtype=object)}
    for k, array in enumerate(same.values(), start=1):
        np.savez(tmp_path / f"a01_s01_e0{k}_sdepth.npz", point_clouds=array)
    reader = open_preprocessed(tmp_path)
    for item in reader.items():
        points = reader.read(item, RNG).sequence.points
        np.testing.assert_allclose(points.reshape(3, 20, 3) * 300, clouds, rtol=1e-5, atol=1e-4)


def test_names_in_capitals_are_read_as_well(tmp_path):
    with (tmp_path / "A01_S02_E03_SDEPTH.NPZ").open("wb") as file:
        np.savez(file, point_clouds=np.ones((2, 4, 3)))
    (item,) = open_preprocessed(tmp_path).items()
    assert (item.name, item.label, item.subject) == ("a01_s02_e03", 0, 2) and not item.problem


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
def test_pickles_of_every_protocol(tmp_path, protocol):
    frames = peer_clouds(make_depth(0, 3).astype(np.float64), 8, 6)
    header = np.lib.format.header_data_from_array_1_0(frames)
    with zipfile.ZipFile(tmp_path / f"{MSR}.npz", "w") as archive, archive.open("point_clouds.npy", "w") as file:
        np.lib.format.write_array_header_1_0(file, header)
        pickle.dump(frames, file, protocol=protocol)
    assert only(open_preprocessed(tmp_path)).num_frames == 3


class Evil:
    def __reduce__(self):
        return print, ("a pickle was executed",)


def objects(*values) -> np.ndarray:
    array = np.empty(len(values), object)
    array[:] = values
    return array


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (objects(Evil()), "is a pickle that is not of plain arrays: it asks for builtins.print; it was not loaded"),
        (objects(np.zeros((4, 2))), r"frame 0 of point_clouds is float64 \(4, 2\); expected numbers \(points, 3\)"),
        (objects(np.ones((4, 3)), "text"), "frame 1 of point_clouds is str; expected numbers"),
        (objects(np.full((4, 3), np.nan)), "frame 0 of point_clouds holds NaN or infinity"),
        (np.zeros((4, 3)), r"point_clouds is float64 \(4, 3\); expected frames"),
        (objects(np.zeros((0, 3))), r"none of its frames \(1\) has"),
        (np.zeros((0, 4, 3)), "holds no frames"),
    ],
)
def test_arrays_that_are_no_videos(tmp_path, array, message, capsys):
    np.savez(tmp_path / f"{MSR}.npz", point_clouds=array)
    with pytest.raises(DataError, match=message):
        only(open_preprocessed(tmp_path))
    assert "executed" not in capsys.readouterr().out


def test_damaged_files_and_strange_names(tmp_path):
    np.savez_compressed(tmp_path / f"{MSR}.npz", point_clouds=peer_clouds(make_depth(0).astype(float), 8, 6))
    whole = (tmp_path / f"{MSR}.npz").read_bytes()
    broken = bytearray(whole)
    broken[len(whole) // 2] ^= 0xFF
    files = {
        "a02_s01_e01.npz": whole[: len(whole) // 2],
        "a03_s01_e01.npz": b"",
        "a04_s01_e01.npz": bytes(broken),
        "a21_s01_e01.npz": whole,
        "walk.npz": whole,
        f"again/{MSR}_sdepth.npz": whole,
    }
    write_files(tmp_path, files)
    np.savez(tmp_path / "a05_s01_e01.npz", clouds=np.zeros(3))
    (tmp_path / "a06_s01_e01.npz").symlink_to(__file__)
    report = convert(open_preprocessed(tmp_path), tmp_path / "out.h5")
    reasons = dict(report.skipped)
    assert report.written == 1 and len(reasons) == 8
    assert "not a readable .npz file, perhaps truncated" in reasons["a02_s01_e01"]
    assert "not a readable .npz file" in reasons["a03_s01_e01"]
    assert "cannot be read (" in reasons["a04_s01_e01"]
    assert "no array 'point_clouds' in it; found: clouds" in reasons["a05_s01_e01"]
    assert "leads out of the data" in reasons["a06_s01_e01"]
    assert "action 21 is out of range" in reasons["a21_s01_e01"]
    assert "its action is unknown" in reasons["walk.npz"]
    assert any("is there twice" in reason for reason in reasons.values())


def pts(seed: int, frames: int = 4, points: int = 16) -> np.ndarray:
    """PointLSTM's array (T,N,8): row, column, depth, t, X, Y, Z, t, as integers."""
    rng = np.random.default_rng(seed)
    array = rng.integers(1, 400, (frames, points, 8))
    array[..., 3] = array[..., 7] = np.arange(frames)[:, None]
    return array


def write_pts(root, *folders: str) -> None:
    for seed, folder in enumerate(folders):
        (root / folder).mkdir(parents=True)
        np.save(root / folder / "pts_label.npy", pts(seed))


A, B = "gesture_2/finger_1/subject_2/essai_1", "gesture_14/finger_2/subject_28/essai_3"


def test_pts_label_with_the_lists(tmp_path):
    write_pts(tmp_path / "Processed_SHREC2017", A, B)
    lists = write_lists(tmp_path / "lists", ["2 1 2 1 2 3 50"], ["14 2 28 3 14 28 60", "1 1 1 1 1 1 40", "x"])
    reader = open_preprocessed(tmp_path / "Processed_SHREC2017", lists=lists)
    report = convert(reader, tmp_path / "out.h5")
    with CloudsReader(tmp_path / "out.h5") as file:
        assert file.names == [A, B] and file.labels.tolist() == [2, 27]
        np.testing.assert_array_equal(file.read(0).points, pts(0)[..., :3].reshape(-1, 3))
        assert file.class_names[2] == "tap, one finger"
        assert [file.read(k).split for k in range(2)] == ["train", "test"]
    reasons = " | ".join(reason for _, reason in report.skipped)
    assert "names gesture_1/finger_1/subject_1/essai_1, which has no pts_label.npy" in reasons
    assert "test_gestures.txt:3: expected 7 whole numbers" in reasons


@pytest.mark.parametrize(("labels", "expected"), [(28, [2, 27]), (14, [1, 13])])
def test_pts_label_without_lists(tmp_path, labels, expected):
    write_pts(tmp_path, A, B)
    reader = PtsLabel(tmp_path, labels)
    assert [item.label for item in reader.items()] == expected and len(set(reader.class_names)) == labels
    assert {item.split for item in reader.items()} == {""}
    assert "2 without a split" in reader.summary(reader.items())[1]


def test_pts_label_of_nvgesture(tmp_path):
    write_pts(tmp_path, "class_03/subject7_r1", "class_26/subject7_r1")
    good, bad = PtsLabel(tmp_path).items()
    assert (good.label, good.subject) == (2, 7) and "class 26 is out of range; expected 1 to 25" in bad.problem
    assert "nearer = larger" in PtsLabel(tmp_path).length_unit and len(PtsLabel(tmp_path).class_names) == 25
    write_pts(tmp_path, "more/class_03/subject7_r1")
    (twice,) = (item for item in PtsLabel(tmp_path).items() if "more" in item.name)
    assert good.name == "class_03/subject7_r1" and f"{good.name} is there twice; {good.path} is read" in twice.problem


@pytest.mark.parametrize("folder", ["", "gesture_data/"])  # the name of a folder above says nothing
def test_pts_label_of_nvgesture_has_its_own_classes_or_is_named(tmp_path, folder):
    write_pts(tmp_path, f"{folder}class_20/subject1_r0")
    reader = PtsLabel(tmp_path)
    assert reader.class_names[reader.items()[0].label] == "gesture 20" and "gray level" in reader.length_unit
    write_pts(tmp_path, "gesture_2/finger_1/subject_1/essai_1")
    reader = PtsLabel(tmp_path)
    strange, own = reader.items()
    assert "of NvGesture, among SHREC'17" in strange.problem and not own.problem
    assert reader.class_names[own.label] == "tap, one finger"


def test_files_of_several_forms_are_not_chosen_from(tmp_path):
    write_pts(tmp_path, "z/class_20/subject1_r0")
    (tmp_path / "a01_s01_e01_sdepth.npz").touch()
    with pytest.raises(DataError, match=r"several forms \(pts_label, msraction3d\); --form says which"):
        open_preprocessed(tmp_path)
    assert isinstance(open_preprocessed(tmp_path, "pts_label"), PtsLabel)


def test_points_that_were_filled_in_are_dropped(tmp_path):
    write_pts(tmp_path, A)
    array = pts(0)
    array[1, :, 2] = 0  # an empty frame: zeros, to which the region's corner was added
    array[2, :5, 2] = 0
    np.save(tmp_path / A / "pts_label.npy", array)
    sample = PtsLabel(tmp_path).read(PtsLabel(tmp_path).items()[0], RNG)
    assert sample.notes == {"frames without points dropped": 1, "points of depth 0 dropped": 5}
    np.testing.assert_array_equal(np.diff(sample.sequence.frame_offsets), [16, 11, 16])
    np.testing.assert_array_equal(sample.sequence.frame(1), array[2, 5:, :3])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "pts_label.npy: not a readable .npy array"),
        (np.zeros((3, 4)), r"array of shape \(3, 4\), float64; expected numbers \(frames, points, 8\)"),
        (np.zeros((3, 4, 2)), "expected numbers"),
        (objects(Evil()), "not a readable .npy array"),
        (np.full((2, 2, 8), np.inf), "holds NaN or infinity"),
        (np.zeros((2, 2, 8)), r"none of its frames \(2\)"),
    ],
)
def test_pts_label_files_that_are_none(tmp_path, content, message):
    path = tmp_path / A / "pts_label.npy"
    path.parent.mkdir(parents=True)
    path.write_bytes(content) if isinstance(content, bytes) else np.save(path, content)
    with pytest.raises(DataError, match=message):
        only(PtsLabel(tmp_path))


def test_options_that_do_not_fit(tmp_path):
    write_pts(tmp_path / "p", A)
    (tmp_path / "n").mkdir()
    np.savez(tmp_path / "n" / f"{MSR}.npz", point_clouds=np.ones((1, 4, 3)))
    for call, message in (
        (lambda: open_preprocessed(tmp_path / "p", scale=2.0), "--scale: pts_label.npy holds pixels"),
        (lambda: open_preprocessed(tmp_path / "n", lists=tmp_path), "--lists: the names of msraction3d's files give"),
        (lambda: open_preprocessed(tmp_path, form="kitti"), "--form kitti: expected one of auto"),
        (lambda: open_preprocessed(tmp_path / "n", protocol="x"), "--protocol x: expected xsub or xview"),
        (lambda: open_preprocessed(tmp_path / "n", scale=-1.0), "--scale -1: expected stored units"),
        (lambda: PtsLabel(tmp_path, 5), "--classes 5: expected 14 or 28"),
    ):
        with pytest.raises(UsageError, match=message):
            call()
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="no pts_label.npy, aAA_sSS_eEE_sdepth.npz or"):
        open_preprocessed(tmp_path / "empty")


def write_shapes(root, files: dict[str, list[int]], lists: bool = True):
    """modelnet40_ply_hdf5_2048 in small: data f32 (N,P,3), label u8 (N,1), normal and faceId besides."""
    root.mkdir(parents=True, exist_ok=True)
    for seed, (name, labels) in enumerate(files.items()):
        rng = np.random.default_rng(seed)
        with h5py.File(root / name, "w") as file:
            data = rng.normal(size=(len(labels), 32, 3)).astype(np.float32)
            file.create_dataset("data", data=data, compression="gzip")
            file.create_dataset("label", data=np.array(labels, np.uint8)[:, None], compression="gzip")
            file["normal"], file["faceId"] = data, np.zeros((len(labels), 32), np.int32)
    for split in ("train", "test") if lists else ():
        names = "".join(f"data/modelnet40_ply_hdf5_2048/{n}\n" for n in files if split in n)
        (root / f"{split}_files.txt").write_text(names)
    (root / "shape_names.txt").write_text("\n".join(CLASS_NAMES) + "\n")
    return root


SHAPES = {"ply_data_train0.h5": [3, 0, 39], "ply_data_train1.h5": [7], "ply_data_test0.h5": [5, 5]}


@pytest.mark.parametrize("lists", [True, False])
def test_modelnet40_shapes_are_sequences_of_one_frame(tmp_path, lists):
    root = write_shapes(tmp_path / "m", SHAPES, lists)
    convert(ModelNet40(root), tmp_path / "out.h5")
    with CloudsReader(tmp_path / "out.h5") as reader, h5py.File(root / "ply_data_train0.h5") as raw:
        assert reader.names == ["train0/0000", "train0/0001", "train0/0002", "train1/0000", "test0/0000", "test0/0001"]
        assert reader.labels.tolist() == [3, 0, 39, 7, 5, 5]
        assert [reader.read(k).split for k in (0, 3, 4)] == ["train", "train", "test"]
        np.testing.assert_array_equal(reader.read(2).points, raw["data"][2])
        assert reader.frame_counts.tolist() == [1] * 6 and reader.class_names == list(CLASS_NAMES)


def test_modelnet40_files_that_disagree(tmp_path):
    root = write_shapes(tmp_path / "m", {**SHAPES, "ply_data_test1.h5": [1], "ply_data_train2.h5": [40]})
    (root / "ply_data_train3.h5").write_bytes((root / "ply_data_train0.h5").read_bytes()[:500])
    (root / "ply_data_train4.h5").write_bytes((root / "ply_data_train0.h5").read_bytes())
    with h5py.File(root / "ply_data_train5.h5", "w") as file:
        file["label"] = np.zeros((1, 1), np.uint8)
        file["data"] = h5py.ExternalLink(str(root / "ply_data_train0.h5"), "data")
    with h5py.File(root / "ply_data_train1.h5", "r+") as file:
        file["data"][0, 0] = np.nan
    names = [f"ply_data_train{k}.h5" for k in (0, 1, 2, 3, 5, 9)]
    (root / "train_files.txt").write_text("\n".join(names))
    report = convert(ModelNet40(root), tmp_path / "out.h5")
    reasons = " | ".join(reason for _, reason in report.skipped)
    assert report.written == 6 and len(report.skipped) == 6, reasons
    for words in (
        "label 40 of shape 0 is out of range; expected 0 to 39",
        "train3.h5: damaged, or of another format",
        "train4.h5: in neither list file",
        "ply_data_train9.h5: listed in train_files.txt, but not there",
        "no data set 'data' of its own",
        "shape 0 holds NaN",
    ):
        assert words in reasons, words


def test_modelnet40_shapes_and_files_that_are_not_read_are_told(tmp_path):
    root = write_shapes(tmp_path / "m", {**SHAPES, "ply_data_train_2.h5": [1], "ply_data_test1.H5": [1]}, lists=False)
    with h5py.File(root / "ply_data_train0.h5", "r+") as file:
        del file["label"]
        file["label"] = np.array([[3]], np.uint8)  # of three shapes
    reader = ModelNet40(root)
    assert reader.summary(reader.items())[2].endswith(": ply_data_test1.H5, ply_data_train_2.h5")
    report = convert(reader, tmp_path / "out.h5")
    assert report.written == 4 and report.notes == {"shapes behind the last label left out": 2}


def test_modelnet40_folders_that_are_none(tmp_path):
    with pytest.raises(DataError, match="no ply_data_train0.h5"):
        ModelNet40(tmp_path).items()
    (tmp_path / "shape_names.txt").write_text("chair table")
    with pytest.raises(DataError, match="2 names, 2 of them different; expected 40"):
        _ = ModelNet40(tmp_path).class_names


def test_the_commands(tmp_path):
    write_pts(tmp_path / "p", A, B)
    write_shapes(tmp_path / "m", SHAPES)
    for words, expected in (
        (("preprocessed", tmp_path / "p", "--classes", 14), "2 sequences, 8 frames, 128 points, 0 skipped"),
        (("modelnet40", tmp_path / "m"), "6 sequences, 6 frames, 192 points, 0 skipped"),
    ):
        result = dpc("prepare", *words, "-o", tmp_path / f"{words[0]}.h5", "--jobs", 1)
        assert result.returncode == 0 and expected in result.stdout, result.stderr


def recipe(name: str) -> dict:
    return tomllib.loads((ROOT / "data_recipes" / f"{name}.toml").read_text())


@pytest.mark.parametrize("name", ["shrec17", "ntu60", "modelnet40", "preprocessed"])
def test_recipes_name_commands_that_exist(name):
    found = recipe(name)
    assert found["name"] == name and found["get"]["license"] and found["layout"]["tree"] and found["raw"]
    program, *words = shlex.split(found["prepare"]["command"])
    assert program == "dpc" and words[:2] == ["prepare", name]
    assert dpc(*words[:2], "--help").returncode == 0


def test_recipes_agree_with_the_readers():
    shrec, ntu, shapes = recipe("shrec17"), recipe("ntu60"), recipe("modelnet40")
    assert {k: shrec["split"][k] for k in ("train", "test")} == shrec17_lists.PUBLISHED
    assert shrec["prepare"]["unit"] == shrec17.Shrec17(ROOT).length_unit
    assert (shrec["checks"]["width"], shrec["checks"]["height"]) == (shrec17.WIDTH, shrec17.HEIGHT)
    assert {k: ntu["split"][k] for k in ntu60.PUBLISHED} == ntu60.PUBLISHED
    assert tuple(ntu["split"]["train_subjects"]) == ntu60.TRAIN_SUBJECTS
    assert ntu["prepare"]["unit"] == NTU60((ROOT,)).length_unit
    assert ntu["checks"]["videos"] == ntu["expect"]["sequences"] == ntu60.VIDEOS
    assert {k: shapes["split"][k] for k in ("train", "test")} == modelnet40.PUBLISHED
    assert shapes["expect"]["sequences"] == sum(modelnet40.PUBLISHED.values())


@pytest.mark.parametrize(
    ("name", "key", "stored", "scale", "unit"),
    [
        (MSR, "point_clouds", 1 / 300, 1.0, "raw depth unit"),  # divided already
        (NTU, "data", 1.0, 655.35, "655.35 stored units"),  # millimeters
        (NTU, "data", 1e-3, 0.65535, "0.65535 stored units"),  # meters
    ],
)
def test_clouds_in_other_units_are_told_with_the_scale_that_fits(tmp_path, name, key, stored, scale, unit):
    form, usual, far = ("msraction3d", 1.0, 600) if name == MSR else ("ntu60", 1 / 65535, 3000)
    frame = np.array([[100.0, 20, far], [120, 30, far + 40]])
    clouds = {}
    for place, factor in (("usual", usual), ("other", stored)):
        (tmp_path / place).mkdir()
        np.savez(tmp_path / place / f"{name}.npz", **{key: np.stack([frame * factor, frame * factor])})
        reader = open_preprocessed(tmp_path / place)
        sample = reader.read(reader.items()[0], RNG)
        clouds[place] = sample.sequence.points
        told = " ".join(sample.notes)
        assert (f"give --scale {scale:g}" in told) == (place == "other"), told
    reader = open_preprocessed(tmp_path / "other", scale=scale)
    sample = reader.read(reader.items()[0], RNG)
    np.testing.assert_allclose(sample.sequence.points, clouds["usual"], rtol=1e-5)
    assert not sample.notes and reader.length_unit == unit
