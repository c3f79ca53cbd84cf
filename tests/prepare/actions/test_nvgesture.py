"""NvGesture: list grammar, clip ranges, the hand's foreground, both kinds of coordinates, bad lists and videos."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from dpcli.errors import DataError, UsageError
from dpcli.prepare.actions.nvgesture import ListEntry, NvGesture, foreground, parse_line
from tests.support.prepare_helpers import write_video

RNG = np.random.default_rng(0)
LINE = "path:./Video_data/{} depth:sk_depth:{}:{} color:sk_color:{}:{} duo_left:duo_left:188:281 label:{} "


def line(folder: str = "class_01/subject3_r0", start: int = 2, stop: int = 5, label: int = 1) -> str:
    return LINE.format(folder, start, stop, start, stop, label)


def hand_video(frames: int = 8) -> np.ndarray:
    """A bright rectangle that moves over a dark plane, and a small bright speck; u8 (T,60,80)."""
    video = np.full((frames, 60, 80), 40, np.uint8)
    for t in range(frames):
        video[t, 10:30, 5 + t : 25 + t] = 150 + t
        video[t, 50:53, 70:73] = 180
    return video


def make_raw(root: Path, train: list[str], test: list[str] = (), videos: list[str] = ("class_01/subject3_r0",)) -> Path:
    for folder in videos:
        write_video(root / "Video_data" / folder / "sk_depth.avi", hand_video())
    (root / "nvgesture_train_correct_cvpr2016_v2.lst").write_text("\n".join(train) + "\n")
    (root / "nvgesture_test_correct_cvpr2016_v2.lst").write_text("\n".join(test) + "\n")
    return root


SAFE = st.text(st.characters(categories=["L", "N"], include_characters="_-. "), min_size=1).map(str.strip).filter(bool)


@given(SAFE, st.integers(0, 999), st.integers(1, 500), st.integers(1, 25), st.booleans(), st.booleans())
def test_lines_are_read_back(folder, start, length, label, blank, other_streams):
    middle = f"color:sk_color:{start}:{start + length} " if other_streams else ""
    text = f"path:./Video_data/{folder} depth:sk_depth:{start}:{start + length} {middle}label:{label}" + " " * blank
    assert parse_line(text) == ListEntry(f"./Video_data/{folder}", "sk_depth", start, start + length, label)


@given(st.text(max_size=60))
def test_other_text_is_refused_with_a_reason(text):
    with pytest.raises(ValueError, match="expected 'path:"):
        parse_line(text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (line(label=26), "label 26 is out of range"),
        (line(label=0), "label 0 is out of range"),
        (line(start=5, stop=5), "clip 5:5 is empty"),
    ],
)
def test_impossible_values_are_refused(text, message):
    with pytest.raises(ValueError, match=message):
        parse_line(text)


def test_the_start_is_inclusive_and_the_end_exclusive(tmp_path):
    reader = NvGesture(make_raw(tmp_path, [line()]), foreground="none")
    sequence = reader.read(reader.items()[0], RNG).sequence
    video = hand_video()[2:5]
    assert sequence.num_frames == 3
    for t, frame in enumerate(video):
        rows, columns = np.nonzero(frame)
        expected = np.stack([rows, columns, frame[rows, columns]], axis=1)
        np.testing.assert_array_equal(sequence.frame(t), expected)
    np.testing.assert_allclose(sequence.time, [0, 1 / 30, 2 / 30])


def plain_otsu(frame: np.ndarray) -> int:
    """The threshold of largest variance between the classes, by trying all."""
    best, chosen = -1.0, 0
    for level in range(255):
        low, high = frame[frame <= level], frame[frame > level]
        if len(low) and len(high):
            between = len(low) * len(high) * (low.mean() - high.mean()) ** 2
            if between > best * (1 + 1e-12):
                best, chosen = between, level
    return chosen


@given(st.integers(0, 2**32 - 1))
def test_foreground_against_its_description(seed):
    rng = np.random.default_rng(seed)
    scene = ndimage.gaussian_filter(rng.normal(size=(24, 32)), 2.5)
    frame = np.clip(110 + 400 * scene + rng.normal(0, 5, scene.shape), 0, 255).astype(np.uint8)
    labels, count = ndimage.label(frame > plain_otsu(frame))  # 4-connected by default
    sizes = np.bincount(labels.ravel())[1:]
    if (sizes == sizes.max()).sum() > 1:
        return  # which of two equal components is taken is nobody's business
    largest = labels == 1 + sizes.argmax()
    np.testing.assert_array_equal(foreground(frame, 0).astype(bool), largest)
    for passes in (1, 3):
        eroded = ndimage.binary_erosion(largest, np.ones((3, 3)), passes, border_value=1)
        np.testing.assert_array_equal(foreground(frame, passes).astype(bool), eroded)


@pytest.mark.parametrize("row", [0, 1, 9, 17, 18])
@pytest.mark.parametrize("column", [0, 1, 25, 26])
def test_the_rim_comes_off_inside_the_image_but_not_at_its_border(row, column):
    frame = np.zeros((24, 32), np.uint8)
    frame[row : row + 6, column : column + 6] = 200
    expected = ndimage.binary_erosion(frame > 0, np.ones((3, 3)), 2, border_value=1)
    np.testing.assert_array_equal(foreground(frame, 2).astype(bool), expected)
    assert foreground(np.zeros_like(frame)).sum() == 0


def test_the_default_keeps_the_eroded_hand_without_the_speck(tmp_path):
    reader = NvGesture(make_raw(tmp_path, [line()]))
    sequence = reader.read(reader.items()[0], RNG).sequence
    row, column, depth = sequence.frame(0).T
    assert (row.min(), row.max(), column.min(), column.max()) == (11, 28, 8, 25)  # frame 2, one pixel off each side
    assert set(depth) == {152}


def test_camera_coordinates_project_back_onto_the_pixels(tmp_path):
    root = make_raw(tmp_path, [line()])
    image, camera = NvGesture(root), NvGesture(root, coordinates="camera")
    item = image.items()[0]
    row, column, gray = image.read(item, RNG).sequence.points.T
    x, y, z = camera.read(item, RNG).sequence.points.T
    np.testing.assert_allclose(z, 255 - gray)
    # the data set's focal lengths and center, of pixels four times as wide and high, counted from the middle of the first
    np.testing.assert_allclose((x / z * 224.502 + 160.5) / 4 - 0.5, column, atol=1e-3)
    np.testing.assert_allclose((y / z * 230.494 + 120.5) / 4 - 0.5, row, atol=1e-3)


def test_of_several_lists_it_is_told_which_is_read(tmp_path):
    root = make_raw(tmp_path, [line()], [line(start=3)])
    assert len(NvGesture(root).summary([])) == 2
    last = root / "nvgesture_train_correct_cvpr2016_v2_few.lst"
    last.write_text(line(start=4))
    reader = NvGesture(root)
    assert [item.name for item in reader.items()] == ["class_01/subject3_r0@3", "class_01/subject3_r0@4"]
    assert reader.summary([])[2:] == [
        f"of several lists {last.name} is read, not nvgesture_train_correct_cvpr2016_v2.lst"
    ]


def test_names_splits_subjects_and_labels(tmp_path):
    videos = ["class_01/subject3_r0", "class_25/subject17_r2"]
    root = make_raw(tmp_path, [line(), line(start=1)], [line("class_25/subject17_r2", label=25)], videos)
    found = [(i.name, i.split, i.subject, i.label) for i in NvGesture(root).items()]
    assert found == [
        ("class_01/subject3_r0@1", "train", 3, 0),
        ("class_01/subject3_r0@2", "train", 3, 0),
        ("class_25/subject17_r2@2", "test", 17, 24),
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (line("class_09/subject1_r0", label=9), r"_v2.lst:2: names .*subject1_r0/sk_depth.avi, which does not exist"),
        (line(label=26, start=3), r"_v2.lst:2: label 26 is out of range"),
        ("garbage", r"_v2.lst:2: expected 'path:"),
        (line(), r"_v2.lst:2: class_01/subject3_r0@2 is listed twice"),
        (line("../../secret", start=3), r"_v2.lst:2: .*secret.* is outside the folder"),
    ],
)
def test_a_bad_line_is_one_bad_item_that_names_list_and_line(tmp_path, text, message):
    items = NvGesture(make_raw(tmp_path, [line(), text])).items()
    problems = [item.problem for item in items if item.problem]
    assert len(items) == 2 and len(problems) == 1

    assert re.search(message, problems[0])


def test_clips_beyond_the_end_of_the_video(tmp_path):
    root = make_raw(tmp_path, [line(start=6, stop=11), line(start=8, stop=12)])
    reader = NvGesture(root)
    partly, beyond = reader.items()
    sample = reader.read(partly, RNG)
    assert sample.sequence.num_frames == 2
    assert sample.notes == {"frames listed beyond the end of a video": 3}
    with pytest.raises(DataError, match="ends before frame 8; the list asks for frames 8 to 11"):
        reader.read(beyond, RNG)


@pytest.mark.parametrize("content", [b"", b"not a video at all"])
def test_videos_that_are_none(tmp_path, content):
    reader = NvGesture(make_raw(tmp_path, [line()]))
    item = reader.items()[0]
    item.path.write_bytes(content)
    with pytest.raises(DataError, match=r"sk_depth.avi: not a readable video"):
        reader.read(item, RNG)


def test_folders_that_are_none(tmp_path):
    with pytest.raises(DataError, match="no list file; expected nvgesture_train_correct"):
        NvGesture(tmp_path).items()
    with pytest.raises(DataError, match="list files are empty"):
        NvGesture(make_raw(tmp_path, [], videos=[])).items()
    with pytest.raises(UsageError, match="--coordinates polar: expected image or camera"):
        NvGesture(tmp_path, coordinates="polar")


def test_real_videos(shared_data):
    reader = NvGesture(shared_data / "nvgesture")
    items = reader.items()
    assert len(items) == 40 and sum(item.split == "train" for item in items) == 25
    assert {item.label for item in items} == set(range(25))
    sample = reader.read(items[0], RNG)
    assert sample.sequence.num_frames == 80
    assert sample.sequence.points.min() >= 0 and sample.sequence.points.max() < 320


@pytest.mark.parametrize(
    ("shape", "fps", "told"),
    [((240, 320), 30.0, ""), ((120, 160), 30.0, "not 320x240"), ((240, 320), 15.0, "isn't at 30 frames a second")],
)
def test_videos_that_were_encoded_again_are_told(tmp_path, shape, fps, told):
    reader = NvGesture(make_raw(tmp_path, [line()]))
    item = reader.items()[0]
    video = np.zeros((8, *shape), np.uint8)
    video[:, 20:60, 20:80] = 150
    write_video(item.path, video, fps=fps)
    sample = reader.read(item, RNG)
    assert [told in note for note in sample.notes] == [True] * bool(told)
    np.testing.assert_allclose(sample.sequence.time, np.arange(3) / fps)
