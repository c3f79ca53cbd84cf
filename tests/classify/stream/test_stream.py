"""`dpc classify predict --stream`: equal to batch prediction, bounded, live, and polite about every bad stream."""

from __future__ import annotations

import io
import json
import os
import queue
import re
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dpcli.classify.commands.model_task import ModelTask
from dpcli.classify.commands.stream import StreamModel, _IrregularFrames, _Unlike
from dpcli.classify.confidence import Confidence
from dpcli.classify.data.clips import Clip, ClipSource, OneVideo, uniform_frames
from dpcli.classify.network.config import KinetConfig
from dpcli.classify.network.kinet import Kinet
from dpcli.classify.network.model_file import ModelInfo, save_model
from dpcli.classify.stream import frame_source as stream_input
from dpcli.classify.stream.frame_source import open_frames, read_arrays
from dpcli.classify.stream.read_ahead import ReadAhead
from dpcli.classify.stream.sliding_window import Prediction, StreamPredictor, window_size
from dpcli.classify.video_scores import batches, score_video
from dpcli.cli.app import main
from dpcli.cli.classify import predict as command
from dpcli.cli.classify.predict_stream import cloud_files
from dpcli.cli.classify.stream_lines import Lines
from dpcli.errors import DataError, Stopped, UsageError
from dpcli.runtime.signals import StopRequest
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter, ScoresReader

ROOT = Path(__file__).resolve().parents[3]
CONFIG = KinetConfig(
    num_classes=3,
    num_frames=4,
    points_per_frame=24,
    centroids=(16, 8),
    neighbors=9,
    normalize="center",
    widths=((8, 8), (8, 16), (16, 32)),
)
NAMES = ["left", "right", "still"]
CPU = torch.device("cpu")


def untrained(timing: str = "clips") -> tuple[Kinet, ModelInfo]:
    """Both heads' last layers are made large, so that probabilities differ a lot from clip to clip."""
    torch.manual_seed(0)
    model = Kinet(CONFIG).eval()
    with torch.no_grad():
        for layer in model.modules():
            if isinstance(layer, torch.nn.Linear) and layer.out_features == CONFIG.num_classes:
                layer.weight *= 100
    return model, ModelInfo(CONFIG, NAMES, timing)


def random_frames(count: int, seed: int = 0) -> list[np.ndarray]:
    """Frames of different sizes, some with fewer points than are drawn."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(5, 60, count)
    return [rng.normal(size=(size, 3)).astype(np.float32) for size in sizes]


def as_stream(frames: list[np.ndarray]) -> bytes:
    pipe = io.BytesIO()
    for frame in frames:
        np.save(pipe, frame)
    return pipe.getvalue()


def batch_source(frames: list[np.ndarray], folder: Path, timing: str = "clips") -> ClipSource:
    path = folder / f"{len(frames)}.h5"
    with CloudsWriter(path, class_names=NAMES) as writer:
        writer.write(CloudSequence.from_frames("v", frames))
    return ClipSource(CloudsReader(path), [0], CONFIG, timing=timing, seed=5)


@torch.inference_mode()
def static_scores(model: Kinet, source: ClipSource, clip: Clip) -> np.ndarray:
    ((_, points),) = batches(source, [clip], 1)
    return model(points)[0].softmax(-1)[0].numpy()


def streamed(frames: list[np.ndarray], timing: str = "clips", **options) -> list:
    predictor = StreamPredictor(*untrained(timing), **{"seed": 5, **options})
    made = [predictor.add(frame) for frame in frames] + [predictor.finish()]
    return [prediction for prediction in made if prediction is not None]


@pytest.fixture(scope="module")
def model_file(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("model") / "m.safetensors"
    save_model(path, *untrained())
    return path


@pytest.fixture(scope="module")
def uniform_file(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("uniform") / "m.safetensors"
    save_model(path, *untrained("uniform"))
    return path


@pytest.mark.parametrize("rule", ["center", "height", "unit", "image"])
def test_a_window_gives_the_points_that_the_whole_file_gives(tmp_path, rule):
    """No rule of normalization may need frames that have left the window."""
    frames, config, window = random_frames(9), CONFIG.changed(normalize=rule), OneVideo("stream", size=4)
    reader = batch_source(frames, tmp_path).reader
    for points in frames:
        window.append(points)
    clip = Clip(0, (5, 6, 7, 8))
    whole, last = (ClipSource(source, [0], config, seed=5).load(clip, 0, *clip.frames) for source in (reader, window))
    np.testing.assert_array_equal(last, whole)
    assert np.ptp(last) > 0.1


@pytest.mark.usefixtures("one_thread")
def test_every_prediction_equals_the_batch_one(tmp_path):
    frames = random_frames(11)
    source, (model, _) = batch_source(frames, tmp_path), untrained()
    ours = streamed(frames)
    assert [p.frame for p in ours] == list(range(3, 11))
    theirs = [static_scores(model, source, clip) for clip in source.clips(None)]
    for prediction, scores in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(prediction.scores[1], scores)
    video = score_video(model, source, 0, None, 8, CPU)
    np.testing.assert_allclose(ours[-1].mean, [video.fused, *video.streams.values()], atol=1e-5)
    assert video.clips == ours[-1].clips == 8
    assert np.ptp(theirs, axis=0).max() > 0.05, "clips must differ, or equality says nothing"
    assert abs(streamed(frames, seed=6)[-1].mean - ours[-1].mean).max() > 1e-3, "other points, other scores"


@pytest.mark.usefixtures("one_thread")
def test_a_hop_leaves_out_clips_and_changes_none():
    frames = random_frames(14)
    every, third = streamed(frames), streamed(frames, hop=3)
    assert [p.frame for p in third] == [3, 6, 9, 12]
    for prediction in third:
        np.testing.assert_array_equal(prediction.scores, every[prediction.frame - 3].scores)
    np.testing.assert_allclose(third[-1].mean, np.mean([p.scores for p in third], 0), atol=1e-6)


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("timing", ["clips", "uniform"])
def test_a_stream_shorter_than_the_window_ends_as_batch_does(tmp_path, timing):
    frames = random_frames(3)
    (only,) = streamed(frames, timing, window=4)
    video = score_video(untrained()[0], batch_source(frames, tmp_path, timing), 0, None, 8, CPU)
    assert only.frame == 2
    np.testing.assert_allclose(only.scores, [video.fused, *video.streams.values()], atol=1e-6)


@pytest.mark.usefixtures("one_thread")
def test_a_model_of_whole_videos_sees_the_window_as_its_video(tmp_path):
    frames = random_frames(12)
    source, (model, _) = batch_source(frames, tmp_path, "uniform"), untrained()
    first, *later = streamed(frames, "uniform", window=9)
    whole = batch_source(frames[:9], tmp_path, "uniform")
    np.testing.assert_array_equal(first.scores[1], static_scores(model, whole, whole.clips(None)[0]))
    for start, prediction in enumerate(later, 1):
        clip = Clip(0, tuple(start + t for t in uniform_frames(9, 4)))
        np.testing.assert_array_equal(prediction.scores[1], static_scores(model, source, clip))


@pytest.mark.usefixtures("one_thread")
def test_a_model_without_a_dynamic_stream_says_only_what_it_knows(tmp_path):
    frames, (model, info) = random_frames(6), untrained()
    info.notes["streams"] = ["static"]
    predictor = StreamPredictor(model, info, seed=5)
    *_, last = [predictor.add(frame) for frame in frames]
    video = score_video(model, batch_source(frames, tmp_path), 0, None, 8, CPU, ["static"])
    np.testing.assert_allclose(last.mean, [video.fused, video.streams["static"]], atol=1e-5)


def through_a_pipe(content: bytes, pieces: int = 7) -> list[np.ndarray]:
    reader, writer = os.pipe()

    def send() -> None:
        with suppress(BrokenPipeError), os.fdopen(writer, "wb", buffering=0) as pipe:
            for start in range(0, len(content), max(len(content) // pieces, 1)):
                pipe.write(content[start : start + max(len(content) // pieces, 1)])

    sender = threading.Thread(target=send)
    sender.start()
    try:
        return list(read_arrays(reader, "pipe"))
    finally:
        os.close(reader)
        sender.join()


@given(
    st.lists(
        st.tuples(
            st.integers(0, 40),
            st.sampled_from([3, 4, 6]),
            st.sampled_from("<f4 <f8 >f4 <f2 <i2 u1".split()),
            st.booleans(),
        ),
        max_size=4,
    ),
    st.integers(1, 9),
)
@settings(max_examples=25, deadline=None)
def test_any_numbers_in_any_layout_arrive(kinds, pieces):
    rng = np.random.default_rng(0)
    arrays = [(rng.random((count, columns)) * 100).astype(kind) for count, columns, kind, _ in kinds]
    arrays = [np.asfortranarray(array) if kind[3] else array for array, kind in zip(arrays, kinds)]
    got = through_a_pipe(as_stream(arrays), pieces)
    assert len(got) == len(arrays)
    for mine, theirs in zip(got, arrays):
        assert mine.dtype == np.float32 and mine.flags.c_contiguous
        np.testing.assert_array_equal(mine, theirs[:, :3].astype(np.float32))


def test_a_stream_cut_anywhere_gives_the_frames_before_and_says_which_one_is_cut(tmp_path):
    frames = [frame for frame in random_frames(4) if len(frame)]
    content, whole = as_stream(frames[:2]), len(as_stream(frames[:1]))
    for cut in (0, 3, 7, 9, 50, whole - 1, whole, whole + 1, whole + 130, len(content) - 1):
        (tmp_path / "cut").write_bytes(content[:cut])
        got, frame = [], int(cut >= whole)
        stream = open_frames(str(tmp_path / "cut"), 0.0, cloud_files())
        if cut in (0, whole):
            assert len(list(stream)) == frame
            continue
        with pytest.raises(DataError, match=f"frame {frame}: truncated"):
            for points in stream:
                got.append(points)
        assert len(got) == frame


def npy(array: np.ndarray, **options) -> bytes:
    file = io.BytesIO()
    np.save(file, array, **options)
    return file.getvalue()


GOOD = np.ones((5, 3), np.float32)
BAD = {
    "HDF5": (b"\x89HDF\r\n\x1a\n" + bytes(90), "leave out --stream"),
    "text": (b"0.1 0.2 0.3\n" * 9, "not a .npy array"),
    "one axis": (npy(np.ones(6, np.float32)), r"shape \(6,\)"),
    "a video": (npy(np.ones((2, 5, 3), np.float32)), "one frame's .*written one after another"),
    "two columns": (npy(np.ones((5, 2), np.float32)), r"shape \(5, 2\)"),
    "transposed": (npy(np.ones((3, 500), np.float32)), "send it transposed"),
    "objects": (npy(np.array([[None] * 3], object), allow_pickle=True), "object"),
    "complex": (npy(np.ones((5, 3), np.complex64)), "complex64"),
    "NaN": (npy(np.where(np.eye(5, 3), np.nan, GOOD)), "3 of 5 points NaN"),
    "too large for f32": (npy(np.full((5, 3), 1e300)), "5 of 5 points"),
    "a wild count": (npy(GOOD).replace(b"(5, 3)", b"(9999999999, 3)"), "at most"),
    "a damaged header": (npy(GOOD).replace(b"'descr'", b"'d\xffscr'"), "damaged"),
    "version 9": (npy(GOOD).replace(b"NUMPY\x01", b"NUMPY\x09"), "version 9.0"),
    "a negative count": (npy(GOOD).replace(b"(5, 3), ", b"(-5, 3),"), "at most"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_frame_is_named(name):
    content, message = BAD[name]
    for before in (0, 2):
        with pytest.raises(DataError, match=message) as told:
            through_a_pipe(npy(GOOD) * before + content)
        assert name == "HDF5" or f"frame {before}" in str(told.value)


@pytest.mark.parametrize("nothing", [np.array([]), np.array([[]]), np.zeros((0, 5)), np.zeros((0, 3), np.int16)])
def test_an_array_of_no_numbers_is_a_frame_without_points(nothing):
    """As `np.array(points)` of an empty list, which a radar's program sends while nobody moves."""
    found = through_a_pipe(npy(GOOD) + npy(nothing) + npy(GOOD))
    assert [frame.shape for frame in found] == [(5, 3), (0, 3), (5, 3)]


def test_columns_that_are_not_read_are_told_once(capsys):
    wide = np.random.default_rng(0).random((5, 4)).astype(np.float32)
    found = through_a_pipe(npy(wide) * 2)
    np.testing.assert_array_equal(found, [wide[:, :3]] * 2)
    said = capsys.readouterr().err
    assert said.count("arrays of 4 columns; the first 3 are read, as x, y, z") == 1 and "transposed" not in said
    through_a_pipe(npy(np.ones((3, 40), np.float32)) * 2)
    assert (
        capsys.readouterr().err.count("frame 0: 3 rows of 40 numbers; if the rows are x, y and z, send the array") == 1
    )


def test_a_growing_file_is_followed(tmp_path):
    frames = random_frames(6)
    content, path = as_stream(frames), tmp_path / "grows.npy"
    path.write_bytes(b"")
    stream = open_frames(str(path), 1.5, cloud_files())

    def grow() -> None:
        with open(path, "ab", buffering=0) as file:
            for start in range(0, len(content), 700):
                file.write(content[start : start + 700])
                time.sleep(0.02)

    writer = threading.Thread(target=grow)
    writer.start()
    got = list(stream)
    writer.join()
    assert len(got) == 6 and all(np.array_equal(mine, theirs) for mine, theirs in zip(got, frames))


@pytest.mark.parametrize("half", [0, 60, 200])
def test_a_file_that_its_writer_begins_anew_is_read_from_its_start(tmp_path, capsys, monkeypatch, half):
    """As a camera program that is started again and opens its file for writing; the reader waited behind its end."""
    path, frames = tmp_path / "s.npy", random_frames(4)
    path.write_bytes(as_stream(frames[:2]) + as_stream(frames[2:3])[:half])
    stream = open_frames(str(path), 0.3, cloud_files())
    got = [next(stream), next(stream)]
    monkeypatch.setattr(stream_input.time, "sleep", lambda _: path.write_bytes(as_stream(frames[3:])))
    got.append(next(stream))
    monkeypatch.undo()
    stream.close()
    assert all(np.array_equal(mine, theirs) for mine, theirs in zip(got, frames[:2] + frames[3:]))
    said = capsys.readouterr().err
    assert "began it anew" in said and ("cut off after" in said) == bool(half)


def test_a_folder_is_followed_in_order_of_names_and_half_a_file_is_waited_for(tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(stream_input, "_SETTLED", 0.4)  # the writer below may be slow on a busy machine
    for number in (2, 10, 9):
        np.save(tmp_path / f"f{number}.npy", np.full((2, 3), number, np.float32))
    (tmp_path / ".hidden.npy").write_bytes(b"")
    stream = open_frames(str(tmp_path), 2.0, cloud_files())
    assert [float(next(stream)[0, 0]) for _ in range(3)] == [2, 9, 10]
    text = "1 2 3\n" * 400

    def drop() -> None:
        (tmp_path / "f1.npy").write_bytes((tmp_path / "f2.npy").read_bytes())  # too late
        with open(tmp_path / "f11.xyz", "w") as file:
            for start in range(0, len(text), 300):
                file.write(text[start : start + 300])
                file.flush()
                time.sleep(0.03)

    writer = threading.Thread(target=drop)
    writer.start()
    (last,) = list(stream)
    writer.join()
    assert last.shape == (400, 3) and last.dtype == np.float32
    assert "left out" in capfd.readouterr().err


def test_files_that_a_recorder_removes_are_counted_and_the_stream_goes_on(tmp_path, capsys):
    """As a ring of the last files, whose reader was late."""
    for number in range(30):
        np.save(tmp_path / f"f{number:02}.npy", np.full((2, 3), number + 1, np.float32))
    stream = open_frames(str(tmp_path), 0.3, cloud_files())
    got = [float(next(stream)[0, 0]) for _ in range(3)]
    for number in (0, 1, *range(3, 15)):
        (tmp_path / f"f{number:02}.npy").unlink()
    assert got + [float(frame[0, 0]) for frame in stream] == [1, 2, 3, *range(16, 31)]
    err = " ".join(capsys.readouterr().err.split())
    assert err.count("warning") == 2 and "f03.npy was removed before it was read" in err and "(10 such files" in err


def test_a_look_into_a_folder_costs_what_is_new(tmp_path):
    """Not all files that have come so far, of which an hour brings tens of thousands."""
    files, ordered = cloud_files(), []

    def order(path: Path) -> list:
        ordered.append(path.name)
        return files.order(path)

    stream = open_frames(str(tmp_path), 0.5, replace(files, order=order))
    for number in range(40):
        np.save(tmp_path / f"f{number:02}.npy", np.full((2, 3), number + 1, np.float32))
    assert [float(frame[0, 0]) for frame in stream] == list(range(1, 41))
    assert len(ordered) < 2 * 40  # each file, and the last one until it had settled


def test_frames_wait_in_bounded_room_and_none_is_lost():
    taken = []

    def endless():
        for number in range(40):
            taken.append(number)
            yield np.full((1, 3), number, np.float32)
        raise DataError("frame 40 is bad")

    feed = ReadAhead(endless(), 5)
    deadline = time.monotonic() + 90
    while len(taken) < 6 and time.monotonic() < deadline:
        time.sleep(0.01)
    time.sleep(0.1)
    assert len(taken) == 6 and feed.waiting == 5  # one more is in the reader's hand
    got = []
    with pytest.raises(DataError, match="frame 40"):
        for points, _, _ in feed.frames(StopRequest()):
            got.append(int(points[0, 0]))
    assert got == list(range(40))


def run(*words: object) -> int:
    """The whole command in this process; the exit code."""
    with pytest.raises(SystemExit) as ended:
        main(["classify", "predict", *map(str, words)])
    return ended.value.code


def predict(data: str, model: str, output: str | None = None, **options: object) -> None:
    """The command as a function, for the errors that it raises."""
    unused = {"jobs": None, "shard": "", "dask": "", "segments": False, "shortest": None}
    unused |= {"stream": False, "follow": None, "json_output": False, "page": None, "hop": None, "window": None}
    command.predict(data=data, model=model, output=output, **{**unused, **options})


def rows(text: str) -> list[dict]:
    return [json.loads(line) for line in text.splitlines()]


@pytest.mark.usefixtures("one_thread")
def test_the_command_prints_a_line_per_hop_and_writes_what_batch_writes(model_file, tmp_path, capsys):
    frames = random_frames(9)
    source = batch_source(frames, tmp_path)
    (tmp_path / "walk.npy").write_bytes(as_stream(frames))
    options = (tmp_path / "walk.npy", "--stream", "--model", model_file, "-o", tmp_path / "s.h5", "--seed", 5)
    assert run(*options, "--json") == 0
    *lines, last = rows(capsys.readouterr().out)
    video = score_video(untrained()[0], source, 0, None, 8, CPU)
    scores = ScoresReader(tmp_path / "s.h5")
    np.testing.assert_allclose(scores.scores[0], video.fused, atol=1e-5)
    np.testing.assert_allclose(scores.streams["dynamic"][0], video.streams["dynamic"], atol=1e-5)
    assert scores.names == ["walk"] and scores.provenance[-1]["config"]["frames"] == 9
    assert [line["frame"] for line in lines] == [3, 4, 5, 6, 7, 8] and lines[-1]["clips"] == 6
    assert last["end"] == "end of stream" and list(last["scores"].values()) == pytest.approx(video.fused, abs=1e-5)
    assert last["class"] == lines[-1]["mean"]["class"] == NAMES[int(video.fused.argmax())]
    assert all(line["latency_ms"] > 0 for line in lines)
    with pytest.raises(UsageError, match="--force"):
        predict(str(tmp_path / "walk.npy"), str(model_file), str(tmp_path / "s.h5"), stream=True)
    predict(str(tmp_path / "walk.npy"), str(model_file), str(tmp_path / "s.h5"), stream=True, force=True, hop=5)
    text = capsys.readouterr().out.splitlines()
    assert (
        len(text) == 3 and text[0].startswith("frame 3: ") and text[-1].startswith("end of stream: 9 frames, 2 clips")
    )


@pytest.mark.usefixtures("one_thread")
def test_a_bad_frame_ends_the_stream_and_what_came_before_stays(model_file, tmp_path, capsys):
    (tmp_path / "bad.npy").write_bytes(as_stream(random_frames(6)) + npy(np.full((4, 3), np.nan)))
    options = (tmp_path / "bad.npy", "--stream", "--json", "--model", model_file, "-o", tmp_path / "s.h5")
    assert run(*options) == 3
    told = capsys.readouterr()
    assert [row.get("frame", row.get("end")) for row in rows(told.out)] == [3, 4, 5, "bad frame"]
    assert "frame 6: 4 of 4 points" in told.err and len(ScoresReader(tmp_path / "s.h5").names) == 1
    (tmp_path / "none.npy").write_bytes(b"")
    with pytest.raises(DataError, match="not one frame"):
        predict(str(tmp_path / "none.npy"), str(model_file), str(tmp_path / "t.h5"), stream=True)
    assert not (tmp_path / "t.h5").exists()


@pytest.mark.usefixtures("one_thread")
def test_sigterm_sums_up_while_the_pipe_is_silent(model_file, tmp_path, capsys, monkeypatch):
    os.mkfifo(tmp_path / "pipe")
    predicted, write = threading.Event(), Lines.write

    def note(lines: Lines, made: Prediction, *rest: object) -> None:
        write(lines, made, *rest)
        if made.frame == 5:
            predicted.set()

    monkeypatch.setattr(Lines, "write", note)

    def send() -> None:
        with open(tmp_path / "pipe", "wb") as pipe:
            pipe.write(as_stream(random_frames(6)))
            pipe.flush()
            predicted.wait(90)
            os.kill(os.getpid(), signal.SIGTERM)
            ended.wait(90)

    ended = threading.Event()
    sender = threading.Thread(target=send)
    sender.start()
    assert run(tmp_path / "pipe", "--stream", "--json", "--model", model_file) == Stopped.exit_code
    ended.set()
    sender.join()
    told = capsys.readouterr()
    assert rows(told.out)[-1]["end"] == "stopped by SIGTERM" and rows(told.out)[-1]["frames"] == 6
    assert "after 6 frames" in told.err


WRONG = {
    "--hop 0": {"hop": 0},
    "--follow -1": {"follow": -1.0},
    "--follow nan": {"follow": float("nan")},
    "leave the option out": {"window": 9},
    "--split does not go": {"split": "test"},
    "--clips-per-video does not go": {"clips_per_video": 3},
    "would mix": {"output": "-"},
    "--hop goes with --stream": {"stream": False, "output": "s.h5", "hop": 2},
    "--json goes with --stream": {"stream": False, "output": "s.h5", "json_output": True},
    "Missing option '-o'": {"stream": False},
    "--window 40": {"model": "uniform"},
    "takes 4 frames; expected at least 4": {"model": "uniform", "window": 3},
}


@pytest.mark.parametrize("message", WRONG)
def test_wrong_use_is_told(message, model_file, uniform_file, tmp_path):
    (tmp_path / "x.npy").write_bytes(npy(GOOD))
    options = {"stream": True, "device": "cpu", **WRONG[message]}
    model = uniform_file if options.pop("model", "") == "uniform" else model_file
    with pytest.raises(UsageError, match=re.escape(message)):
        predict(str(tmp_path / "x.npy"), str(model), **options)
    with pytest.raises(DataError, match="no such file"):
        predict(str(tmp_path / "absent"), str(model_file), stream=True)


def test_a_missing_window_is_told_with_how_long_the_videos_of_the_training_were():
    info = ModelInfo(CONFIG, ["a", "b"], "uniform", {"learned_from": {"frames": 17.0}})
    with pytest.raises(UsageError, match=r"--window 40 \(the longest video that it learned from had 17 frames\)$"):
        window_size(info, None)
    with pytest.raises(UsageError, match="--window 40$"):
        window_size(ModelInfo(CONFIG, ["a", "b"], "uniform"), None)


def start(model_file: Path, *words: object) -> subprocess.Popen:
    command = [
        sys.executable,
        "-m",
        "dpcli",
        "classify",
        "predict",
        "-",
        "--stream",
        "--json",
        "--model",
        model_file,
        *words,
    ]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(list(map(str, command)), env=environment, **pipes)


def resident(process: subprocess.Popen) -> float:
    """Memory of a running process in MB."""
    status = Path(f"/proc/{process.pid}/status")
    if not status.exists():
        pytest.skip("memory of another process is read from /proc")
    return int(next(line.split()[1] for line in status.read_text().splitlines() if line.startswith("VmRSS"))) / 1024


def test_lines_come_while_the_stream_runs_memory_stays_and_ctrl_c_sums_up(model_file, tmp_path):
    """2,000 frames of 2,000 points are 48 MB: whoever kept them would show it."""
    process = start(model_file, "--hop", 100, "-o", tmp_path / "s.h5")
    lines: queue.Queue = queue.Queue()
    threading.Thread(target=lambda: [lines.put(json.loads(line)) for line in process.stdout], daemon=True).start()
    frame = npy(np.random.default_rng(0).normal(size=(2000, 3)).astype(np.float32))
    memory = []
    for more, until in ((1004, 1004), (2000, 3004)):
        for _ in range(more):
            process.stdin.write(frame)
        process.stdin.flush()
        while (line := lines.get(timeout=60))["frame"] != until - 1:
            pass
        memory.append(resident(process))
    assert line["clips"] == 31 and line["latency_ms"] < 20000
    assert memory[1] - memory[0] < 15, memory
    process.send_signal(signal.SIGINT)
    assert process.wait(60) == 130
    last = lines.get(timeout=60)
    assert (last["end"], last["frames"], last["clips"]) == ("interrupted", 3004, 31)
    assert len(ScoresReader(tmp_path / "s.h5").names) == 1


@pytest.mark.usefixtures("one_thread")
def test_a_reader_that_leaves_ends_it_and_scores_and_page_so_far_are_kept(model_file, tmp_path, monkeypatch):
    (tmp_path / "x.npy").write_bytes(npy(GOOD) * 6)
    reader, writer = os.pipe()
    os.close(reader)
    with suppress(BrokenPipeError), os.fdopen(writer, "w") as closed:
        monkeypatch.setattr(sys, "stdout", closed)
        with pytest.raises(BrokenPipeError):
            page = tmp_path / "p.html"
            predict(str(tmp_path / "x.npy"), str(model_file), str(tmp_path / "s.h5"), stream=True, page=page)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["p.html", "s.h5", "x.npy"]
    assert "reader left" in page.read_text("utf-8")
    kept = ScoresReader(tmp_path / "s.h5")
    assert kept.names == ["x"] and 0 < kept.provenance[-1]["config"]["frames"] <= 6


def test_a_writer_that_stops_within_a_frame_and_comes_back_loses_that_frame_alone(tmp_path, capsys):
    """Wherever it stops: in the header, too, and within the bytes by which a frame is known."""
    frames = [np.full((n, 3), n, np.float32) for n in (50, 40, 3, 1)]
    first, cut, *rest = (as_stream([frame]) for frame in frames)
    path = tmp_path / "s.npy"
    for place in (*range(1, 13), 60, *range(120, 132), 300, len(cut) - 8, len(cut) - 5):
        path.write_bytes(first + cut[:place] + first + b"".join(rest))
        found = [len(frame) for frame in open_frames(str(path), 0.0, cloud_files())]
        assert found == [50, 50, 3, 1]
        said = " ".join(capsys.readouterr().err.split())
        assert f"frame 1, byte {len(first)}: cut off after {place} byte" in said
    path.write_bytes(first + cut[:200] + rest[0])  # what came back is smaller than what is missing
    assert [len(frame) for frame in open_frames(str(path), 0.0, cloud_files())] == [50, 3]


def test_coordinates_that_end_as_a_frame_begins_are_kept():
    frame = np.frombuffer(bytes(8) + b"\x93NUM", np.float32).reshape(1, 3)
    assert [one.tobytes() for one in through_a_pipe(as_stream([frame] * 2))] == [frame.tobytes()] * 2


def test_a_named_pipe_is_followed_while_its_writer_is_gone(tmp_path):
    """As a camera program that is started again; without --follow its end would be the stream's."""
    path, frames = tmp_path / "pipe", random_frames(4)
    os.mkfifo(path)
    stream = open_frames(str(path), 60.0, cloud_files())
    for some in (frames[:2], frames[2:]):
        sender = threading.Thread(target=path.write_bytes, args=(as_stream(some),))
        sender.start()
        assert all(np.array_equal(next(stream), frame) for frame in some)
        sender.join()
    stream.close()


def test_odd_frames_are_told_once_and_counted(model_file, tmp_path, capsys):
    none = np.zeros((0, 3), np.float32)
    frames = [*random_frames(6), none, np.ones((1, 3), np.float32), np.ones((2, 3), np.float32), none]
    (tmp_path / "s.npy").write_bytes(as_stream(frames))
    predict(str(tmp_path / "s.npy"), str(model_file), stream=True)
    said = capsys.readouterr()
    assert said.err.count("one without points") == 1 and said.err.count("repeated to fill a clip") == 1
    assert "2 without points, left out, 2 of fewer than 4 points" in said.err
    assert said.out.count("\n") == 6


def test_nothing_happens_below_the_threshold_and_scores_stay(model_file, tmp_path, capsys):
    (tmp_path / "s.npy").write_bytes(as_stream(random_frames(8)))
    lines = {}
    for below in ("0", "1"):
        predict(str(tmp_path / "s.npy"), str(model_file), stream=True, json_output=True, reject_below=below)
        lines[below] = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [one["nothing"] for one in lines["0"][:-1]] == [False] * 5
    assert [one["nothing"] for one in lines["1"][:-1]] == [one["confidence"] < 1 for one in lines["0"][:-1]]
    assert lines["0"][-1]["scores"] == lines["1"][-1]["scores"]
    with pytest.raises(UsageError, match="no threshold of its own"):
        predict(str(tmp_path / "s.npy"), str(model_file), stream=True, reject_below="auto")


def test_lines_tell_the_confidence_that_the_threshold_is_held_against(capsys):
    """Plain probabilities would contradict the verdict: here the larger of two is rejected and the smaller one is not."""
    lines = Lines(StreamModel(["wave", "bow", "sit"], ["static"], Confidence(0.5, 0.6), 4, 1), False)
    for row in ([0.5, 0.48, 0.02], [0.48, 0.26, 0.26]):
        scores = np.array([row, row], np.float32)
        lines.write(Prediction(7, 1, scores, scores), 0.05, 0)
    lines.finish(scores, 9, 2, "end of stream")
    rejected, named, last = capsys.readouterr().out.splitlines()
    assert rejected == "frame 7: nothing happening; best wave 0.52 (static wave 0.52); 50 ms"
    assert named == "frame 7: wave 0.63 (static wave 0.63); 50 ms"
    assert last.startswith("end of stream: 9 frames, 2 clips: mean wave 0.63 (static wave 0.63); ")


def test_a_silence_is_told_once_and_counted(capsys):
    watch, points = _IrregularFrames(), np.ones((9, 3), np.float32)
    for number, silent in enumerate((0.0, 0.1, 7.3, 0.1, 2.5)):
        watch.see(number, points, silent)
    watch.sum_up()
    said = capsys.readouterr().err
    assert said.count("nothing came for 7.3 s before frame 2") == 1 and "2.5 s" not in said
    assert "frames in all: 2 after a silence" in said


@pytest.mark.parametrize(
    ("gaps", "waited", "timing", "said"),
    [
        ([0.033] * 60, 1.0, "clips", "come 0.033 s apart, 0.0667 in what msraction3d-24 learned from"),
        (
            [0.0001] * 200 + [0.033, 0.034, 0.032] * 20,
            0.9,
            "clips",
            "send one of 2",
        ),  # a pipe was full of frames at first
        ([0.2] * 60, 1.0, "clips", "faster in them: send more of them"),
        ([0.06] * 60, 1.0, "clips", ""),
        ([0.033] * 60, 1.0, "uniform", ""),
        ([0.0001] * 500, 1.0, "clips", ""),  # a recording, sent at once
        ([0.033] * 60, 0.1, "clips", ""),  # held back by slow predictions
        ([0.1, 0.0001, 0.0001] * 60, 1.0, "clips", ""),  # a folder, where a look finds several
    ],
)
def test_another_pace_than_that_of_the_training_is_told_once(gaps, waited, timing, said, capsys):
    unlike = _Unlike(ModelTask("-", "msraction3d-24", None), ModelInfo(CONFIG, NAMES, timing))
    arrived = 1000.0
    for gap in gaps:
        arrived += gap
        unlike.tell_pace(arrived, gap * waited)
    err = " ".join(capsys.readouterr().err.split())
    assert said in err and err.count("warning") == bool(said)
