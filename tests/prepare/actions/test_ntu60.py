"""NTU RGB+D 60: folders and ZIPs alike, names, splits, intrinsics, 56,880 videos, damaged and strange inputs."""

from __future__ import annotations

import itertools
import struct
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dpcli.errors import DataError, UsageError
from dpcli.prepare.actions import ntu60
from dpcli.prepare.actions.ntu60 import NTU60, named_intrinsics
from dpcli.prepare.decode import zip_folders
from dpcli.prepare.decode.png import decode_depth_png
from dpcli.prepare.pipeline import Conversion, convert
from dpcli.store import CloudsReader
from tests.support.commands import told as dpc
from tests.support.depth_png_helpers import ntu_files, person, png_bytes, write_files

RNG = np.random.default_rng(0)
ONE, TWO = "S001C002P003R001A060", "S017C001P001R002A001"


def write_zip(path: Path, files: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED, **options) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w", method, **options) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


def expected_cloud(depth: np.ndarray, fx: float, fy: float, cx: float, cy: float, scale: float) -> np.ndarray:
    """Pixel by pixel, in float64, from the pinhole equations."""
    rows, columns = np.nonzero(depth)
    z = depth[rows, columns].astype(np.float64)
    return np.stack([(columns - cx) / fx * z, (rows - cy) / fy * z, z], axis=1) / scale


def only(reader: NTU60):
    (item,) = [item for item in reader.items() if not item.problem]
    return reader.read(item, RNG)


@pytest.mark.parametrize(
    ("options", "camera"),
    [
        ({}, (280, 280, 256, 212, 655.35)),
        ({"intrinsics": named_intrinsics("kinect2"), "scale": 1000.0}, (365.481, 365.481, 257.346, 210.347, 1000)),
    ],
)
def test_depth_goes_in_and_points_come_out(tmp_path, options, camera):
    depth = person(0, 3)
    sequence = only(NTU60((write_files(tmp_path, ntu_files(ONE, depth)),), **options)).sequence
    assert sequence.num_frames == 3
    for t in range(3):
        np.testing.assert_allclose(sequence.frame(t), expected_cloud(depth[t], *camera), rtol=2e-6, atol=1e-6)
    np.testing.assert_allclose(sequence.time, [0, 1 / 30, 2 / 30])


def test_labels_people_and_both_protocols(tmp_path):
    files = {**ntu_files(ONE, person(0, 1)), **ntu_files(TWO, person(1, 1))}
    root = write_files(tmp_path, files)
    found = [(i.name, i.label, i.subject, i.camera, i.split) for i in NTU60((root,)).items()]
    assert found == [(ONE, 59, 3, 2, "test"), (TWO, 0, 1, 1, "train")]
    assert [i.split for i in NTU60((root,), "xview").items()] == ["train", "test"]


def test_published_split_sizes_follow_from_the_rules():
    """Cameras have 18,960 videos each (56,880 / 3), so two of them train; subjects: 20 of 40."""
    assert ntu60.PUBLISHED["xview"] == {"train": 2 * 18960, "test": 18960}
    assert sum(ntu60.PUBLISHED["xsub"].values()) == ntu60.VIDEOS
    assert len(set(ntu60.TRAIN_SUBJECTS)) == 20 and len(set(ntu60.CLASS_NAMES)) == 60


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_a_zip_gives_what_its_folder_gives(tmp_path, method):
    files = {**ntu_files(ONE, person(0)), **ntu_files(TWO, person(1))}
    folder = write_files(tmp_path / "folder", files)
    archive = write_zip(tmp_path / "zips" / "nturgbd_depth_masked_s001.zip", files, method)
    for source in (archive, archive.parent):
        reports = [convert(NTU60((p,)), tmp_path / "out.h5", Conversion(force=True)) for p in (folder, source)]
        assert [report.written for report in reports] == [2, 2] and not reports[1].skipped
    with CloudsReader(tmp_path / "out.h5") as reader:
        assert reader.names == [ONE, TWO]
    one, two = NTU60((folder,)), NTU60((archive,))
    for a, b in zip(one.items(), two.items(), strict=True):
        np.testing.assert_array_equal(one.read(a, RNG).sequence.points, two.read(b, RNG).sequence.points)


def test_worker_processes_read_zips(tmp_path):
    archive = write_zip(tmp_path / "ü ß" / "s 001.zip", {**ntu_files(ONE, person(0)), **ntu_files(TWO, person(1))})
    convert(NTU60((archive,)), tmp_path / "one.h5")
    result = dpc("prepare", "ntu60", archive.parent, "-o", tmp_path / "two.h5", "--jobs", "2")
    assert result.returncode == 0, result.stderr
    with CloudsReader(tmp_path / "one.h5") as a, CloudsReader(tmp_path / "two.h5") as b:
        for k in range(2):
            np.testing.assert_array_equal(a.read(k).points, b.read(k).points)


NAMES = st.lists(
    st.lists(st.sampled_from(["a", "S001", "bß", "long name of a folder", "x" * 80]), min_size=1, max_size=4).map(
        "/".join
    ),
    min_size=1,
    max_size=12,
    unique=True,
)


@pytest.mark.filterwarnings("ignore:Duplicate name")
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(NAMES, st.booleans(), st.booleans(), st.binary(max_size=40).filter(lambda b: b"PK" not in b))
def test_the_index_agrees_with_zipfile(tmp_path, names, stored, folders_listed, in_front):
    """Entries in any order, folders with and without entries of their own, bytes in front of the archive, a comment."""
    path = tmp_path / "any.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED if stored else zipfile.ZIP_DEFLATED) as archive:
        archive.comment = in_front
        for k, name in enumerate(names):
            if folders_listed:
                archive.writestr(f"folder {k % 3}/", b"")
            archive.writestr(f"folder {k % 3}/{name}.png", name.encode() * k)
    path.write_bytes(in_front + path.read_bytes())
    found = zip_folders.list_folders(path)
    with zipfile.ZipFile(path) as archive:
        expected: dict[str, list] = {}
        for info in archive.infolist():
            if not info.is_dir():
                expected.setdefault(info.filename.rpartition("/")[0], []).append(
                    (info.filename.rpartition("/")[2], archive.read(info))
                )
    contents = {name: list(zip_folders.read_files(path, files)) for name, files in found.items()}
    assert contents == expected


def test_zip64_archives(tmp_path, monkeypatch):
    monkeypatch.setattr(zipfile, "ZIP64_LIMIT", 1000)
    monkeypatch.setattr(zipfile, "ZIP_FILECOUNT_LIMIT", 2)
    path = write_zip(tmp_path / "a.zip", ntu_files(ONE, person(0, 4)), zipfile.ZIP_STORED)
    assert b"PK\x06\x06" in path.read_bytes()
    assert only(NTU60((path,))).sequence.num_frames == 4


def listing(path: Path, videos: list[str], frames: int) -> Path:
    """A ZIP that is nothing but the directory of so many files."""
    entry = struct.Struct("<4s6H3I5H2I")
    fields = (b"PK\x01\x02", 20, 20, 0, 8, 0, 0, 0, 0, 0)
    with path.open("wb") as file:
        for video in videos:
            names = [f"nturgb+d_depth_masked/{video}/MDepth-{t + 1:08d}.png".encode() for t in range(frames)]
            file.write(b"".join(entry.pack(*fields, len(n), 0, 0, 0, 0, 0, 0) + n for n in names))
        size, count = file.tell(), min(len(videos) * frames, 0xFFFF)
        file.write(struct.pack("<4s4H2IH", b"PK\x05\x06", 0, 0, count, count, size, 0, 0))
    return path


def test_the_index_of_all_videos_takes_seconds(tmp_path):
    cut = itertools.product(range(1, 17), range(1, 4), range(1, 41), range(1, 3), range(1, 61))
    names = [f"S{s:03}C{c:03}P{p:03}R{r:03}A{a:03}" for s, c, p, r, a in cut][: ntu60.VIDEOS]
    path = listing(tmp_path / "all.zip", names, 2)
    start = time.process_time()
    items = NTU60((path,)).items()
    seconds = time.process_time() - start
    assert [item.name for item in items] == sorted(names)
    assert seconds < 15, seconds  # 1 to 2 s on an idle core


def test_zips_cut_short_and_damaged(tmp_path):
    files = {**ntu_files(ONE, person(0)), **ntu_files(TWO, person(1))}
    path = write_zip(tmp_path / "data" / "b.zip", files)
    whole = path.read_bytes()
    write_files(tmp_path / "data", ntu_files("S002C001P001R001A002", person(2)))
    reader = NTU60((tmp_path / "data",))
    assert len(reader.items()) == 3
    for cut in (0, 10, len(whole) // 2, len(whole) - 30):
        path.write_bytes(whole[:cut])
        report = convert(reader, tmp_path / "out.h5", Conversion(force=True))
        assert report.written == 1
        assert [(n, "b.zip" in r and "cut short" in r) for n, r in report.skipped] == [(str(path), True)]
    broken = bytearray(whole)
    broken[len(whole) // 4] ^= 0xFF
    path.write_bytes(broken)
    report = convert(reader, tmp_path / "out.h5", Conversion(force=True))
    assert report.written == 2 and len(report.skipped) == 1 and "copy the archive again" in report.skipped[0][1]


def test_directory_bytes_that_lie_are_refused(tmp_path):
    whole = bytearray(write_zip(tmp_path / "a.zip", ntu_files(ONE, person(0))).read_bytes())
    directory = whole.index(b"PK\x01\x02")
    second = whole.index(b"PK\x01\x02", directory + 4)
    for at, value, message in ((second, 0, "directory is damaged"), (directory + 28, 0xFF, "the archive is damaged")):
        broken = bytearray(whole)
        broken[at] = value
        (tmp_path / "a.zip").write_bytes(broken)
        with pytest.raises(DataError, match=message):
            only(NTU60((tmp_path / "a.zip",)))
    broken = bytearray(whole)
    broken[directory + 8] |= 1
    (tmp_path / "a.zip").write_bytes(broken)
    with pytest.raises(DataError, match="encrypted; unpack the archive"):
        only(NTU60((tmp_path / "a.zip",)))


def bad_frame(kind: str) -> bytes:
    good = png_bytes(person(0, 1)[0])
    flipped = bytearray(good)
    flipped[len(good) // 2] ^= 1
    return {
        "empty": b"",
        "text": b"<html>no more quota</html>",
        "truncated": good[: len(good) // 2],
        "end": good[:-5],
        "flipped": bytes(flipped),
        "size": png_bytes(np.ones((240, 320), np.uint16)),
        "8 bits": png_bytes(np.ones((424, 512), np.uint8)),
        "color": png_bytes(np.ones((424, 512, 3), np.uint16)),
        "nothing": png_bytes(np.zeros((424, 512), np.uint16)),
    }[kind]


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("empty", "MDepth-00000001.png: the file is empty"),
        ("text", r"MDepth-00000001.png: not a PNG \(starts with b'<html>no'"),
        ("truncated", "MDepth-00000001.png: a truncated PNG"),
        ("end", "MDepth-00000001.png: a truncated PNG"),
        ("flipped", "MDepth-00000001.png: a damaged PNG: wrong checksum"),
        ("size", "MDepth-00000001.png: 320x240 pixels; expected 512x424"),
        ("8 bits", "8-bit gray PNG; expected 16-bit gray depth"),
        ("color", "16-bit RGB PNG; expected 16-bit gray depth"),
        ("nothing", r"none of its frames \(1\) has a valid depth pixel"),
    ],
)
def test_bad_frames_in_folders_and_zips(tmp_path, kind, message):
    files = {f"x/{ONE}/MDepth-00000001.png": bad_frame(kind)}
    for source in (write_files(tmp_path / "f", files), write_zip(tmp_path / "a.zip", files)):
        with pytest.raises(DataError, match=message):
            only(NTU60((source,)))


def test_frames_missing_empty_and_misnamed(tmp_path):
    depth = person(0, 4)
    depth[2] = 0
    files = ntu_files(ONE, depth, first=3)
    del files[f"nturgb+d_depth_masked/{ONE}/MDepth-00000004.png"]
    sample = only(NTU60((write_files(tmp_path, files),)))
    assert sample.notes == {"frames without points dropped": 1, "frames missing in the numbering from 1": 3}
    np.testing.assert_allclose(sample.sequence.time, [0, 3 / 30])
    from_0 = only(NTU60((write_files(tmp_path / "from_0", ntu_files(ONE, person(0, 4), first=0)),)))
    assert from_0.notes == {}
    other = write_files(tmp_path / "full", {f"{TWO}/Depth-00000001.png": png_bytes(depth[0])})
    with pytest.raises(DataError, match=r"no MDepth-00000001.png ...; found Depth-00000001.png; the masked"):
        only(NTU60((other,)))


def test_unknown_names_doubles_and_numbers_out_of_range(tmp_path):
    frame = png_bytes(person(0, 1)[0])
    root = write_files(
        tmp_path / "räw data",
        {
            f"a/{ONE}/MDepth-00000001.png": frame,
            f"b/{ONE}/MDepth-00000001.png": frame,
            "a/S001C001P001R001/MDepth-00000001.png": frame,
            "a/S018C001P001R001A061/MDepth-00000001.png": frame,
            "a/S001C009P001R001A001/MDepth-00000001.png": frame,
        },
    )
    write_zip(root / "c.zip", {"walk/MDepth-00000001.png": frame, f"{TWO}/MDepth-00000001.png": frame})
    write_zip(root / "skeletons.zip", {"skeletons/S001C001P001R001A001.skeleton": b"1"})
    report = convert(NTU60((root,)), tmp_path / "out.h5")
    reasons = " | ".join(reason for _, reason in report.skipped)
    assert report.written == 2 and len(report.skipped) == 6
    for words in (
        "is there twice",
        "a/S001C001P001R001: holds MDepth-00000001.png, but is not called",
        "setup 18 in the name",
        "camera 9 in the name is out of range; NTU RGB+D 60 has 1 to 3",
        "walk: holds MDepth",
        "skeletons.zip: no folder",
    ):
        assert words in reasons, words
    with CloudsReader(tmp_path / "out.h5") as reader:
        assert reader.names == [ONE, TWO] and reader.skipped == report.skipped


def test_links_are_not_followed_out_of_the_data(tmp_path):
    outside = write_files(tmp_path / "outside", ntu_files(TWO, person(0)))
    root = write_files(tmp_path / "raw", ntu_files(ONE, person(1)))
    (root / "more").symlink_to(outside)
    (root / "inner").symlink_to(root / "nturgb+d_depth_masked")
    items = {item.name: item.problem for item in NTU60((root,)).items()}
    assert items.pop(ONE) == "" and len(items) == 2
    assert f"leads out of the data, to {outside}; name that as another input" in items[str(root / "more")]
    assert "is read at its target" in items[str(root / "inner")]
    frame = root / "nturgb+d_depth_masked" / ONE / "MDepth-00000003.png"
    frame.symlink_to(outside / "nturgb+d_depth_masked" / TWO / "MDepth-00000001.png")
    with pytest.raises(DataError, match="MDepth-00000003.png: a link that leads out of the data"):
        only(NTU60((root,)))
    (tmp_path / "alias").symlink_to(outside)  # the input itself may be a link
    assert only(NTU60((tmp_path / "alias",))).sequence.num_frames == 2


def test_inputs_and_options_that_are_none(tmp_path):
    for source, message in ((tmp_path / "no", "does not exist"), (tmp_path, "no masked depth videos")):
        with pytest.raises(DataError, match=message):
            NTU60((source,)).items()
    with pytest.raises(UsageError, match="--protocol cs: expected xsub or xview"):
        NTU60((tmp_path,), "cs")
    with pytest.raises(UsageError, match="--intrinsics v2: expected peers, kinect2 or a .json"):
        named_intrinsics("v2")
    with pytest.raises(UsageError, match="--scale 0: expected millimeters"):
        NTU60((tmp_path,), scale=0)


def test_the_decoder_gives_back_every_value():
    image = RNG.integers(0, 65536, (424, 512)).astype(np.uint16)
    np.testing.assert_array_equal(decode_depth_png(png_bytes(image), "x", (512, 424)), image)


def test_the_summary_counts_setups_and_splits(tmp_path):
    lines = NTU60((tmp_path,)).summary(
        [ntu60.video_item(ONE, tmp_path, "xsub"), ntu60.video_item("S001C001P001R001A099", tmp_path, "xsub")]
    )
    assert lines[0] == "1 of the 56880 published videos found, 1 unusable"
    assert lines[1:] == ["xsub: train 0/40320, test 1/16560", "by setup S001: 1"]
