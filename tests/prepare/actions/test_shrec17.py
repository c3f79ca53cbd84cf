"""SHREC'17: lists, regions, the hand's pixels against other implementations, both coordinates, damaged inputs."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from dpcli.errors import DataError, UsageError
from dpcli.prepare.actions.shrec17 import INTRINSICS, Shrec17, keep_only_hand, read_regions
from dpcli.prepare.actions.shrec17_lists import GESTURES, Entry, parse_line
from dpcli.prepare.pipeline import convert
from dpcli.store import CloudsReader
from tests.support.commands import told as dpc
from tests.support.depth_png_helpers import REGION, hand_depth, png_bytes, write_gesture, write_lists

RNG = np.random.default_rng(0)
A, B = "gesture_1/finger_1/subject_2/essai_1", "gesture_14/finger_2/subject_28/essai_3"


def make_raw(root, frames: int = 3, dtype: type = np.uint16):
    """Two gestures, one in each list."""
    write_gesture(root, A, hand_depth(0, frames, dtype))
    write_gesture(root, B, hand_depth(1, frames, dtype))
    return write_lists(root, [f"1 1 2 1 1 1 {frames}"], [f"14 2 28 3 14 28 {frames}"])


def peers_hand(depth: np.ndarray) -> np.ndarray:
    """The published steps by SciPy: median (its edge mirrored as OpenCV's is), closing, largest component."""
    blurred = ndimage.median_filter(depth, 3, mode="nearest")
    padded = np.pad(blurred > 0, 7)
    square = np.ones((7, 7), bool)
    closed = ndimage.binary_dilation(padded, square)
    closed = ndimage.binary_erosion(closed[7:-7, 7:-7], square, border_value=1)
    labels, count = ndimage.label(closed)
    if not count:
        return np.zeros_like(depth)
    sizes = np.bincount(labels.ravel())[1:]
    return np.where(labels == 1 + sizes.argmax(), blurred, 0)


@given(st.integers(0, 2**32 - 1), st.sampled_from([np.uint8, np.uint16]), st.floats(0.0, 2.0))
def test_the_hand_against_another_implementation(seed, dtype, threshold):
    rng = np.random.default_rng(seed)
    field = ndimage.gaussian_filter(rng.normal(size=(40, 50)), 2.0)
    values = rng.integers(1, 255, field.shape)
    depth = np.where(field > threshold * field.std(), values, 0).astype(dtype)
    mask = ndimage.median_filter(depth, 3, mode="nearest") > 0
    closed = ndimage.binary_closing(np.pad(mask, 7), np.ones((7, 7), bool))
    sizes = np.sort(np.bincount(ndimage.label(closed)[0].ravel())[1:])
    if len(sizes) > 1 and sizes[-1] - sizes[-2] < 30:
        return  # nearly equal components: which is larger may turn on the rim, where closing has two conventions
    np.testing.assert_array_equal(keep_only_hand(depth), peers_hand(depth))


def test_steps_can_be_left_out():
    depth = hand_depth(0, 1)[0][90:170, 190:260]
    assert (keep_only_hand(depth, 0, 0) > 0).sum() == (depth > 0).sum() - 16  # the speck is the other component
    assert ((keep_only_hand(depth, 0, 0) == depth) | (depth == 120)).all()


@pytest.mark.parametrize("close", range(1, 9))
def test_a_closing_fills_and_takes_nothing_away(close):
    """Also one by a square of an even side, which has no middle."""
    mask = ndimage.binary_opening(RNG.random((40, 50)) < 0.9, np.ones((4, 4), bool))
    mask[:10], mask[-10:], mask[:, :10], mask[:, -10:] = False, False, False, False
    closed = ndimage.binary_closing(mask, np.ones((close, close), bool))
    labels, _ = ndimage.label(closed)
    expected = (labels == np.bincount(labels[labels > 0]).argmax()) & mask
    assert np.array_equal(keep_only_hand(np.uint16(mask) * 500, 0, close) > 0, expected)


def test_image_coordinates_are_pixels_of_the_whole_frame(tmp_path):
    reader = Shrec17(make_raw(tmp_path))
    sequence = reader.read(reader.items()[0], RNG).sequence
    x, y, width, height = REGION
    for t, depth in enumerate(hand_depth(0)):
        expected = np.zeros_like(depth)
        expected[y : y + height, x : x + width] = peers_hand(depth[y : y + height, x : x + width])
        rows, columns = np.nonzero(expected)
        np.testing.assert_array_equal(sequence.frame(t), np.stack([rows, columns, expected[rows, columns]], axis=1))
        assert rows.max() < 130 and columns.min() >= 200 + t  # no speck
    np.testing.assert_allclose(sequence.time, np.arange(3) * 0.0333333, atol=1e-9)


def test_camera_coordinates_project_back_onto_the_pixels(tmp_path):
    root = make_raw(tmp_path)
    image, camera = Shrec17(root), Shrec17(root, coordinates="camera")
    item = image.items()[1]
    row, column, depth = image.read(item, RNG).sequence.points.T
    x, y, z = camera.read(item, RNG).sequence.points.T
    np.testing.assert_array_equal(z, depth)
    np.testing.assert_allclose(x / z * INTRINSICS.fx + INTRINSICS.cx, column, atol=1e-3)
    np.testing.assert_allclose(y / z * INTRINSICS.fy + INTRINSICS.cy, row, atol=1e-3)


def test_without_the_region_the_whole_frame_is_looked_at(tmp_path):
    root = make_raw(tmp_path)
    for path in root.rglob("general_informations.txt"):
        path.unlink()
    assert "hand's region (--no-bbox does without)" in reasons(Shrec17(root), 2)
    everything = Shrec17(root, bbox=False, foreground="none", median=0)
    sample = everything.read(everything.items()[0], RNG)
    assert len(sample.sequence.points) == np.count_nonzero(hand_depth(0))
    assert sample.notes == {"sequences without usable timestamps (30 frames/s assumed)": 1}
    np.testing.assert_allclose(sample.sequence.time, np.arange(3) / 30)
    largest = Shrec17(root, bbox=False)
    sequence = largest.read(largest.items()[0], RNG).sequence
    np.testing.assert_array_equal(len(sequence.points), sum(np.count_nonzero(peers_hand(d)) for d in hand_depth(0)))


def test_eight_bit_frames(tmp_path):
    reader = Shrec17(make_raw(tmp_path, dtype=np.uint8))
    assert reader.read(reader.items()[0], RNG).sequence.points[:, 2].max() < 256


@pytest.mark.parametrize(("labels", "expected"), [(28, (0, 27)), (14, (0, 13))])
def test_labels_splits_people_and_names(tmp_path, labels, expected):
    reader = Shrec17(make_raw(tmp_path), labels)
    found = [(i.name, i.split, i.subject, i.label) for i in reader.items()]
    assert found == [(A, "train", 2, expected[0]), (B, "test", 28, expected[1])]
    names = reader.class_names
    assert len(names) == labels and names[0].startswith("grab") and names[-1].startswith("shake")
    assert len(set(GESTURES)) == 14


def test_class_names_follow_the_lists_whatever_order_their_labels_have(tmp_path):
    root = write_lists(tmp_path, ["2 1 1 1 2 2 9", "2 2 1 1 2 16 9"])
    assert Shrec17(root, 28).class_names[1] == "tap, one finger"
    assert Shrec17(root, 28).class_names[15] == "tap, whole hand"
    assert Shrec17(root, 14).class_names[:2] == ["class 1", "tap"]


NUMBERS = st.tuples(*(st.integers(1, top) for top in (14, 2, 28, 10, 14, 28, 200)))


@given(NUMBERS, st.sampled_from([" ", "\t", "   "]), st.booleans())
def test_lines_are_read_back(numbers, blank, trailing):
    assert parse_line(blank.join(map(str, numbers)) + blank * trailing) == Entry(*numbers)


@given(st.text(max_size=40))
def test_other_text_is_refused_with_a_reason(text):
    with pytest.raises(ValueError, match="expected 7 whole numbers"):
        parse_line(text)


def reasons(reader: Shrec17, count: int) -> str:
    """What the log says of the samples that cannot be read, of which there are so many."""
    found = []
    for item in reader.items():
        try:
            if item.problem:
                raise DataError(item.problem)
            reader.read(item, RNG)
        except DataError as error:
            found.append(str(error))
    assert len(found) == count, found
    return " | ".join(found)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("15 1 2 1 1 1 3", r"train_gestures.txt:2: gesture 15 is out of range; expected 1 to 14; found '15 1 2"),
        ("1 1 2 2 1 29 3", r":2: label28 29 is out of range; expected 1 to 28"),
        ("1 1 2 2 0 1 3", r":2: label14 0 is out of range"),
        ("1 1 2 2 1 1 0", r":2: frames 0 is out of range; expected 1 to more"),
        ("1 1 2", r":2: expected 7 whole numbers"),
        ("1 1 2 1 1 1 3", rf":2: {A} is listed already, in train_gestures.txt:1"),
        ("1 1 5 1 1 1 3", r"train_gestures.txt:2 names gesture_1/finger_1/subject_5/essai_1, which does not exist"),
        ("2 1 2 1 2 1 3", r":2: label28 1 stands for tap, one finger here and for grab, one finger in train_gest"),
    ],
)
def test_lists_that_disagree_with_files_or_themselves(tmp_path, line, message):
    root = make_raw(tmp_path)
    (root / "train_gestures.txt").write_text(f"1 1 2 1 1 1 3\n{line}\n")
    assert re.search(message, reasons(Shrec17(root), 1))


def test_folders_in_neither_list_are_named_in_log_and_file(tmp_path):
    root = make_raw(tmp_path / "räw data")
    write_gesture(root, "gesture_3/finger_1/subject_1/essai_1", hand_depth(3))
    report = convert(Shrec17(root), tmp_path / "out.h5")
    assert report.written == 2 and "in neither list file, so its split is unknown" in report.skipped[0][1]
    with CloudsReader(tmp_path / "out.h5") as reader:
        assert reader.skipped == report.skipped and reader.names == [A, B]


def test_frames_that_disagree_with_the_list(tmp_path):
    root = make_raw(tmp_path, frames=4)
    write_lists(root, ["1 1 2 1 1 1 3"], ["14 2 28 3 14 28 6"])
    reader = Shrec17(root)
    sample = reader.read(reader.items()[0], RNG)
    assert sample.sequence.num_frames == 3 and sample.notes == {"frames beyond the count in the list left out": 1}
    assert "2 of the 6 frames that the list promises are missing, the first: 4_depth.png" in reasons(reader, 1)


@pytest.mark.parametrize("frames", [3, 2])  # that the list says, of three there
def test_regions_beyond_the_frames_are_counted(tmp_path, frames):
    root = make_raw(tmp_path)
    write_lists(root, [f"1 1 2 1 1 1 {frames}"], ["14 2 28 3 14 28 3"])
    with (root / A / "general_informations.txt").open("a") as file:
        file.write("9e9 190 90 70 80\n9.1e9 190 90 70 80\n")
    notes = Shrec17(root).read(Shrec17(root).items()[0], RNG).notes
    assert notes.pop("regions beyond the frames of a sequence left out; do they belong together?") == 2
    assert sum(notes.values()) == 3 - frames


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "1_depth.png: the file is empty"),
        (png_bytes(np.ones((240, 320), np.uint16)), "1_depth.png: 320x240 pixels; expected 640x480"),
        (png_bytes(hand_depth(0)[0])[:900], "1_depth.png: a truncated PNG"),
        (png_bytes(np.ones((480, 640, 3), np.uint8)), "8-bit RGB PNG; expected 8 or 16-bit gray depth"),
    ],
)
def test_bad_frames(tmp_path, content, message):
    root = make_raw(tmp_path)
    (root / A / "1_depth.png").write_bytes(content)
    assert message in reasons(Shrec17(root), 1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0 190 90 70 80\n", "general_informations.txt: regions of 1 frame; expected 3 lines"),
        ("0 190 90 70 80\n1 190 90 70\n", r"general_informations.txt:2: '1 190 90 70'; expected 5 numbers"),
        ("0 190 90 70 nan\n", "general_informations.txt:1: '0 190 90 70 nan'; expected 5 numbers"),
        ("0 700 90 70 80\n1 700 90 70 80\n2 9 9 0 0", "none of its frames (3) has a valid depth pixel"),
    ],
)
def test_bad_regions(tmp_path, text, message):
    root = make_raw(tmp_path)
    (root / A / "general_informations.txt").write_text(text)
    assert message in reasons(Shrec17(root), 1)


def test_regions_over_the_edge_are_cut_and_counted(tmp_path):
    root = make_raw(tmp_path)
    regions = [(-20, -10, 260, 141), REGION, (230, 90, 9000, 9000)]
    write_gesture(root, A, hand_depth(0), regions)
    reader = Shrec17(root, foreground="none", median=0)
    sample = reader.read(reader.items()[0], RNG)
    assert sample.notes == {"hand regions cut at the edge of the image": 2}
    counts = [np.count_nonzero(hand_depth(0)[0][0:131, 0:240]), 0, np.count_nonzero(hand_depth(0)[2][90:, 230:])]
    assert np.diff(sample.sequence.frame_offsets)[[0, 2]].tolist() == [counts[0], counts[2]]
    by_one_pixel = ((-1, 90, 70, 80), (190, -1, 70, 181), (600, 90, 41, 80), (190, 90, 70, 391))
    for over in by_one_pixel:
        write_gesture(root, A, hand_depth(0), [over, REGION, REGION])
        assert reader.read(reader.items()[0], RNG).notes["hand regions cut at the edge of the image"] == 1


def test_regions_are_read_as_written(tmp_path):
    write_gesture(tmp_path, A, hand_depth(0), [(1, 2, 3, 4), (5, 6, 7, 8), (9, 10, 11, 12)])
    ticks, regions = read_regions(tmp_path / A / "general_informations.txt")
    assert regions.tolist() == [[1, 2, 3, 4], [5, 6, 7, 8], [9, 10, 11, 12]]
    np.testing.assert_array_equal(ticks, 6.4e10 + 333_333 * np.arange(3))


def test_links_out_of_the_data(tmp_path):
    root = make_raw(tmp_path / "raw")
    outside = write_gesture(tmp_path / "outside", "x", hand_depth(0))
    (root / A / "2_depth.png").unlink()
    (root / A / "2_depth.png").symlink_to(outside / "2_depth.png")
    (root / B).rename(tmp_path / "elsewhere")
    (root / B).symlink_to(tmp_path / "elsewhere")
    words = reasons(Shrec17(root), 2)
    assert words.count("a link that leads out of the data") == 2


def test_folders_that_are_none(tmp_path):
    with pytest.raises(DataError, match="train_gestures.txt: not found; expected train_gestures.txt, test"):
        Shrec17(tmp_path).items()
    with pytest.raises(DataError, match="both list files are empty"):
        Shrec17(write_lists(tmp_path / "e", [])).items()
    (write_lists(tmp_path / "half", ["1 1 2 1 1 1 3"]) / "test_gestures.txt").unlink()
    with pytest.raises(DataError, match="test_gestures.txt: not found"):
        Shrec17(tmp_path / "half").items()
    with pytest.raises(UsageError, match="--classes 20: expected 14 or 28"):
        Shrec17(tmp_path, 20)
    with pytest.raises(UsageError, match="--median 4: expected 0 or 3 or 5"):
        Shrec17(tmp_path, median=4)


def test_the_command(tmp_path):
    make_raw(tmp_path / "raw" / "HandGestureDataset_SHREC2017")  # as the archive unpacks
    result = dpc(
        "prepare",
        "shrec17",
        tmp_path / "raw",
        "-o",
        tmp_path / "o.h5",
        "--classes",
        "14",
        "--points",
        "256",
        "--jobs",
        "1",
    )
    assert result.returncode == 0, result.stderr
    assert "2 sequences, 6 frames, 1536 points, 0 skipped" in result.stdout
    assert "train: 1 of the 1960 published gestures found" in result.stderr
    with CloudsReader(tmp_path / "o.h5") as reader:
        assert len(reader.class_names) == 14 and reader.labels.tolist() == [0, 13]
