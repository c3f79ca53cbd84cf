"""Sparse clouds by command: the data choose the network, and odd videos are told or refused, never classified in silence."""

from __future__ import annotations

from contextlib import ExitStack

import numpy as np
import pytest
import torch

from dpcli.classify.commands import train as command
from dpcli.classify.data.clips import ClipSource, OneVideo
from dpcli.classify.data.slots import measured
from dpcli.classify.network.kinet import Kinet
from dpcli.classify.network.model_file import ModelInfo, load_model
from dpcli.classify.settings import network_config
from dpcli.classify.stream.sliding_window import StreamPredictor
from dpcli.errors import UsageError
from dpcli.runtime.settings.catalog import Given
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter, ScoresReader
from dpcli.store.schema import kept_name
from tests.support.commands import exit_code as dpc

pytestmark = pytest.mark.usefixtures("one_thread")
SPEED = kept_name("speed")
SMALL = {"members": 2, "widths": ((8, 8), (16,))}
SHORT = {**SMALL, "batch": 16, "lr": 0.01}


def radar(path, videos, *, classes=2, people=3, back=False, column=True, points=3):
    """Videos of one to three points a frame that rise or fall, some points 30 m away; the speed says which."""
    rng = np.random.default_rng(0)
    names = ["up", "down", "still"][:classes]
    with CloudsWriter(path, class_names=names, fields=["time", SPEED] if column else ["time"]) as writer:
        for k in range(videos * classes):
            label, frames = k % classes, int(rng.integers(8, 20))
            step = (0.05, -0.05, 0.0)[label]
            made = [rng.normal((0, t * step, 2), 0.05, (int(rng.integers(1, points + 1)), 3)) for t in range(frames)]
            made[2][0] += 30
            sequence = CloudSequence.from_frames(f"v{k}", [one.astype(np.float32) for one in made], label=label)
            sequence.time = np.arange(frames)[:: -1 if back and k == 1 else 1] / 10.0
            sequence.split, sequence.subject = "test" if k >= (videos - 1) * classes else "train", k // classes % people
            if column:
                sequence.extra = {SPEED: rng.normal(20 * step, 0.1, len(sequence.points)).astype(np.float32)}
            writer.write(sequence)
    return path


def trained(path, folder, epochs=1):
    return command.train(str(path), str(folder), Given("auto", sets=SHORT, flags={"epochs": epochs}))


def test_a_radar_gets_its_own_network_which_learns_and_predicts(tmp_path, capsys):
    data = radar(tmp_path / "r.h5", 9)
    done = trained(data, tmp_path / "run", epochs=5)
    model, info = load_model(done.weights)
    assert model.config.backbone == "slots" and model.config.columns == ("speed",) and info.timing == "slots"
    assert done.videos == 16 and done.accuracy["static"] > 0.8 and done.caveat == ""  # all train, all are judged
    said = capsys.readouterr().err
    assert "are left out (" in said and "(cross)" in said
    assert info.notes["confidence"]["clips"] > 0
    assert dpc("classify", "predict", data, "--model", tmp_path / "run", "-o", tmp_path / "s.h5") == 0
    scores = ScoresReader(tmp_path / "s.h5")
    assert (scores.scores.argmax(1) == scores.labels).all() and np.allclose(scores.scores.sum(1), 1, atol=1e-5)
    again = tmp_path / "again.h5"
    assert dpc("classify", "predict", data, "--model", tmp_path / "run", "-o", again, "--batch", 1) == 0
    assert "--clips-per-video" not in capsys.readouterr().err
    assert np.array_equal(scores.scores, ScoresReader(again).scores)
    words = ("-o", again, "--force", "--clips-per-video", 9)
    assert dpc("classify", "predict", data, "--model", tmp_path / "run", *words) == 0
    assert "whose clips are whole videos; 4 of each are taken" in capsys.readouterr().err
    assert np.array_equal(scores.scores, ScoresReader(again).scores)
    bare = radar(tmp_path / "bare.h5", 2, column=False)
    capsys.readouterr()
    for words, sentence in (
        ((bare, "-o", tmp_path / "b.h5"), "no column speed"),
        ((bare, "-o", tmp_path / "b.csv", "--segments", "--window", 20), "no column speed"),
        ((data, "-o", tmp_path / "v.h5", "--split", "validation"), "learned from all videos"),
    ):
        assert dpc("classify", "predict", *words, "--model", tmp_path / "run") in (2, 3)
        assert sentence in capsys.readouterr().err
    streamed_and_cut(tmp_path, data, capsys)


def streamed_and_cut(tmp_path, data, capsys):
    """A stream and a recording carry the columns that a model reads; windows of the whole video say what `predict` says."""
    model = ("--model", tmp_path / "run")
    assert dpc("classify", "predict", data, *model, "-o", tmp_path / "one.h5", "--clips-per-video", 1) == 0
    expected = ScoresReader(tmp_path / "one.h5")
    with CloudsReader(data) as reader:
        video = reader.read(reader.names.index(expected.names[0]))
    rows = np.column_stack([video.points, video.extra[SPEED]])
    folder = tmp_path / "frames"
    folder.mkdir()
    names = ("frames", "bare", "millimeters")
    with ExitStack() as stack:
        pipe, bare, other = (stack.enter_context(open(tmp_path / f"{name}.npy", "wb")) for name in names)
        for t, frame in enumerate(np.split(rows, video.frame_offsets[1:-1])):
            np.save(pipe, frame)
            np.save(bare, frame[:, :3])
            np.save(other, frame * np.float32([1000, 1000, 1000, 1]))
            table = np.column_stack([frame[:, 3], frame[:, :3]])
            np.savetxt(folder / f"{t:03}.csv", table, delimiter=",", header="speed,x,y,z", comments="", fmt="%.9g")
    window = ("--stream", "--window", video.num_frames)
    for source in (tmp_path / "frames.npy", folder):
        assert dpc("classify", "predict", source, *window, *model, "-o", tmp_path / f"{source.stem}.h5", "--force") == 0
        assert np.allclose(ScoresReader(tmp_path / "frames.h5").scores, expected.scores[:1], atol=1e-3)
    assert "another" not in capsys.readouterr().err
    assert dpc("classify", "predict", tmp_path / "millimeters.npy", *window, *model) == 0
    said = capsys.readouterr().err
    assert "millimeters.npy: half of the points lie within" in said and "is the unit of length another one, or" in said
    assert dpc("classify", "predict", tmp_path / "bare.npy", *window, *model) == 3
    assert "frame 0: 3 numbers a point; the model reads 4: x, y, z, speed, in this order" in capsys.readouterr().err
    cut = tmp_path / "cut.csv"
    assert dpc("classify", "predict", data, "--segments", "--window", 8, *model, "-o", cut, "--reject-below", 0) == 0
    assert [line.split(",")[3] for line in cut.read_text().split()[1:]] == [
        expected.class_names[label] for label in expected.labels
    ]


@pytest.mark.parametrize("videos, people", [(2, 1), (2, 3), (3, 1)])
def test_one_or_two_videos_a_class_and_one_person_train(videos, people, tmp_path):
    done = trained(radar(tmp_path / "r.h5", videos, people=people, points=1), tmp_path / "run")
    assert all(torch.isfinite(value).all() for value in load_model(done.weights)[0].state_dict().values())
    assert done.videos == (0 if videos == 2 else 4)  # one training video a class: no judge could have seen its class


def test_what_fits_the_network_that_the_data_choose_is_not_refused_for_another(tmp_path, capsys):
    data = radar(tmp_path / "r.h5", 4)
    flags = {"epochs": 0, "validation": "cross", "frames": 4, "points": 6}  # fewer points than `quick` has centroids
    done = command.train(str(data), str(tmp_path / "run"), Given("auto", sets=SHORT, flags=flags))
    assert load_model(done.weights)[1].config.num_frames == 4 and done.videos == 6
    for words in (("--set", "epoch=3"), ("--frames", "2", "--points", "16", "--preset", "quick")):
        assert dpc("classify", "train", tmp_path / "none.h5", "-o", tmp_path / "x", *words) == 2
    assert "did you mean epochs" in (said := capsys.readouterr().err) and "centroids" in said and "none.h5" not in said


def test_one_class_is_refused_and_time_that_runs_back_is_told(tmp_path, capsys):
    assert dpc("classify", "train", radar(tmp_path / "one.h5", 3, classes=1), "-o", tmp_path / "run") == 3
    assert "at least two classes are needed" in capsys.readouterr().err
    trained(radar(tmp_path / "back.h5", 3, back=True), tmp_path / "back")
    assert "time runs back in 1 of 4 videos: v1; frames are taken in the file's order" in capsys.readouterr().err


def test_an_hour_is_one_clip_with_a_warning(tmp_path, capsys):
    done = trained(radar(tmp_path / "r.h5", 2), tmp_path / "run")
    config = load_model(done.weights)[0].config
    with CloudsReader(tmp_path / "r.h5") as reader:
        video = reader.read(0)
    times = 54_000 // video.num_frames + 1
    hour = CloudSequence.from_frames("hour", [video.frame(t) for t in range(video.num_frames)] * times)
    hour.extra = {SPEED: np.tile(video.extra[SPEED], times)}
    source = ClipSource(OneVideo.of(hour), [0], config, timing="slots")
    clips = source.video_clips(0, None)
    assert len(clips) == 4 and source.load(clips[0], 0).shape == (16, 24, 6)
    with CloudsWriter(tmp_path / "hour.h5", class_names=["up", "down"], fields=[SPEED]) as writer:
        writer.write(hour)
    capsys.readouterr()
    words = ("--model", tmp_path / "run", "-o", tmp_path / "s.h5", "--clips-per-video", 1)
    assert dpc("classify", "predict", tmp_path / "hour.h5", *words) == 0
    assert "1 of 1 video over 5 times as long as any" in capsys.readouterr().err


def test_a_stream_of_places_alone_is_predicted_by_its_window(tmp_path):
    with CloudsReader(radar(tmp_path / "r.h5", 2, column=False)) as reader:
        video = reader.read(0)
        config, _ = measured(network_config(Given("sparse", sets=SMALL), 2), reader, [0, 1, 2])
    info = ModelInfo(config, ["up", "down"], "slots", {"streams": ["static"]})
    predictor = StreamPredictor(Kinet(config).eval(), info, window=6)
    predictor.warm_up()
    made = [predictor.add(video.frame(t)) for t in range(video.num_frames)]
    nothing = [predictor.add(video.points[:0]) for _ in range(6)]
    assert np.allclose(nothing[-1].scores, 0.5)  # no point tells no class
    assert [one is not None for one in made] == [t >= 5 for t in range(video.num_frames)]
    assert all(np.allclose(one.scores.sum(-1), 1, atol=1e-5) for one in made if one is not None)
    with pytest.raises(UsageError, match="a stream has no end"):
        StreamPredictor(Kinet(config).eval(), info)
