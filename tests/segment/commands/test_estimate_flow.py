"""`dpc segment estimate-flow`: true flow where it is known, the last frame's rule, the scale of --as-points, resuming."""

from __future__ import annotations

import io
import os
import pickle
import signal
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from dpcli.errors import DataError, Stopped, UsageError
from dpcli.runtime.machines.spread import Spread
from dpcli.runtime.seeds import SegmentStream, generator
from dpcli.segment.commands import estimate_flow as module
from dpcli.segment.commands.estimate_flow import (
    EstimatedFlow,
    FlowOfSequence,
    draw_points,
    estimate_flow_of_file,
    flow_as_points,
)
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter
from dpcli.store.joints import no_joints

pytestmark = pytest.mark.usefixtures("one_thread")
SHIFT = np.array([0.04, -0.02, 0.01])
FIELDS = ("time", "track", "pose", "scene_flow")


def moving(name: str, seed: int, frames: int = 3, points: int = 60, **fields) -> CloudSequence:
    """One cloud that moves by SHIFT from frame to frame, its points in another order each time."""
    rng = np.random.default_rng(seed)
    cloud = rng.uniform(-0.5, 0.5, (points, 3))
    orders = [rng.permutation(points) for _ in range(frames)]
    clouds = [np.float32(cloud[order] + t * SHIFT) for t, order in enumerate(orders)]
    wrong = [np.ones_like(c) for c in clouds]  # as if the input had a flow of its own
    return CloudSequence.from_frames(
        name,
        clouds,
        track=orders,
        scene_flow=wrong,
        time=np.arange(frames) / 10,
        pose=np.tile(np.eye(4), (frames, 1, 1, 1)),
        **fields,
    )


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("flow") / "clouds.h5"
    with CloudsWriter(
        path, class_names=["a", "b"], length_unit="cm", fields=FIELDS, provenance={"config": "x"}
    ) as writer:
        for i in range(5):
            split = "test" if i == 3 else "train"
            frames = 1 if i == 1 else 3
            writer.write(moving(f"s{i}", i, frames, label=i % 2, subject=i + 3, camera=i, split=split))
    return path


def estimate(data: object, output: object, **options) -> EstimatedFlow:
    given = {
        "flow": "nearest",
        "points": 20,
        "as_points": False,
        "split": "all",
        "seed": 0,
        "device": "cpu",
        "force": False,
        "spread": Spread(jobs=1),
    }
    return estimate_flow_of_file(str(data), str(output), **{**given, **options})


def test_icp_finds_a_translation_and_the_last_frame_looks_back():
    flow = FlowOfSequence("icp", points=40)(moving("s", 0)).scene_flow.reshape(3, 40, 3)
    np.testing.assert_allclose(flow[:2], np.broadcast_to(SHIFT, (2, 40, 3)), atol=2e-4)
    np.testing.assert_allclose(flow[2], np.broadcast_to(-SHIFT, (40, 3)), atol=2e-4)
    shown = FlowOfSequence("icp", points=40, as_points=True)(moving("s", 0))
    assert shown.scene_flow is None
    wanted = SHIFT / np.linalg.norm(SHIFT)  # the same way in every frame, the last one too
    lengths = np.linalg.norm(shown.points, axis=1, keepdims=True)
    np.testing.assert_allclose(shown.points / lengths, np.broadcast_to(wanted, (120, 3)), atol=1e-2)


def test_nearest_written_out_looks_into_the_whole_other_frame():
    sequence = moving("s", 1)
    found = FlowOfSequence("nearest", points=7)(sequence)
    for t, other in ((0, 1), (1, 2), (2, 1)):
        for point, flow in zip(found.frame(t), found.scene_flow[7 * t : 7 * t + 7]):
            distances = ((sequence.frame(other) - point) ** 2).sum(1)
            np.testing.assert_allclose(point + flow, sequence.frame(other)[distances.argmin()], atol=1e-6)


def test_points_are_drawn_with_their_fields_and_small_frames_stay_whole():
    sequence = moving("s", 2)
    sequence.frame_offsets = np.array([0, 5, 5, 180])  # a small frame, an empty one, a large one
    drawn = draw_points(sequence, 20, np.random.default_rng(0))
    assert np.diff(drawn.frame_offsets).tolist() == [5, 0, 20]
    np.testing.assert_array_equal(drawn.points[:5], sequence.points[:5])
    rows = {tuple(point): track for point, track in zip(sequence.points, sequence.track)}
    assert all(rows[tuple(point)] == track for point, track in zip(drawn.points, drawn.track))
    assert len({tuple(p) for p in drawn.points}) == 25
    np.testing.assert_array_equal(draw_points(sequence, 0, np.random.default_rng(0)).points, sequence.points)
    sequence.pose, sequence.joint = np.tile(np.eye(4), (3, 1, 1, 1)), no_joints(3, 1)
    drawn = draw_points(sequence, 20, np.random.default_rng(0))
    assert drawn.pose is sequence.pose and drawn.joint is sequence.joint
    flow = FlowOfSequence("nearest", points=20)(sequence).scene_flow
    assert flow.shape == (25, 3) and not flow.any()  # toward the empty frame, and back to it


def test_the_scale_rule():
    rng = np.random.default_rng(0)
    sequence = CloudSequence.from_frames(
        "s", list(rng.normal(3, 1, (3, 50, 3))), scene_flow=list(rng.normal(size=(3, 50, 3)))
    )
    shown = flow_as_points(sequence)
    distances = np.sort(np.linalg.norm(sequence.points - sequence.points.mean(0), axis=1))
    norms = np.sort(np.linalg.norm(sequence.scene_flow, axis=1))
    rank = 0.99 * 149  # between the sorted values 147 and 148
    p99 = [v[147] + (rank - 147) * (v[148] - v[147]) for v in (distances, norms)]
    signs = np.repeat([1, 1, -1], 50)[:, None]
    np.testing.assert_allclose(shown, sequence.scene_flow * signs * (p99[0] / p99[1]), rtol=1e-5)
    np.testing.assert_array_equal(flow_as_points(replace(sequence, scene_flow=2 * sequence.scene_flow)), shown)
    np.testing.assert_allclose(flow_as_points(replace(sequence, points=2 * sequence.points)), 2 * shown, rtol=1e-5)
    wild = sequence.scene_flow.copy()
    wild[0] *= 1e4  # one wrong match: the others keep nearly the same scale
    ratio = np.linalg.norm(flow_as_points(replace(sequence, scene_flow=wild))[1]) / np.linalg.norm(shown[1])
    assert 0.8 < ratio <= 1.0


def test_flow_that_tells_nothing_gives_no_nan():
    still = CloudSequence.from_frames("s", [np.eye(3)] * 100, scene_flow=[np.zeros((3, 3))] * 100)
    assert not flow_as_points(still).any()
    assert not flow_as_points(replace(still, scene_flow=np.full((300, 3), 1e-30, np.float32))).any()
    one = still.scene_flow.copy()
    one[7] = [0, 0, 0.5]  # less than 1 %: the percentile is 0, the largest counts
    shown = flow_as_points(replace(still, scene_flow=one))
    assert shown[7, 2] == pytest.approx(np.sqrt(2 / 3), rel=1e-6) and np.count_nonzero(shown) == 1
    alone = FlowOfSequence("icp", as_points=True)(moving("s", 0, frames=1))
    assert not alone.points.any() and alone.num_frames == 1


def test_what_is_known_of_a_sequence_stays(data, tmp_path):
    assert estimate(data, tmp_path / "flow.h5") == (5, 13)  # sequences, frames
    estimate(data, tmp_path / "points.h5", as_points=True)
    with (
        CloudsReader(data) as before,
        CloudsReader(tmp_path / "flow.h5") as flow,
        CloudsReader(tmp_path / "points.h5") as shown,
    ):
        assert set(flow.fields) == set(FIELDS) and shown.fields == ("time",)
        for after in (flow, shown):
            assert (after.names, after.splits, after.class_names) == (before.names, before.splits, before.class_names)
            assert after.length_unit == "cm" and after.provenance[:1] == before.provenance
            for column in ("labels", "subjects", "cameras"):
                np.testing.assert_array_equal(getattr(after, column), getattr(before, column))
        for i in range(5):
            own = flow.read(i)
            points, pairs = before.read(i), FlowOfSequence("nearest", 20)(before.read(i))
            np.testing.assert_array_equal(own.scene_flow, pairs.scene_flow)
            np.testing.assert_array_equal(own.time, points.time)
            np.testing.assert_array_equal(shown.read(i).points, flow_as_points(own))
        assert flow.provenance[-1]["config"] == {"flow": "nearest", "points": 20, "as_points": False, "split": "all"}
    estimate(data, tmp_path / "test.h5", split="test")
    with CloudsReader(tmp_path / "test.h5") as some, CloudsReader(tmp_path / "flow.h5") as flow:
        assert some.names == ["s3"]  # and its points don't depend on which other sequences are asked for
        np.testing.assert_array_equal(some.read(0).scene_flow, flow.read(3).scene_flow)


def test_flow_as_points_has_no_place_on_a_map():
    sequence = replace(moving("s", 0), shift=np.array([4.5e5, 5.4e6, 120.0]))
    assert FlowOfSequence("nearest", 20)(sequence).shift is not None
    assert FlowOfSequence("nearest", 20, as_points=True)(sequence).shift is None


def test_a_stopped_run_is_continued_to_the_same_bytes(data, tmp_path, monkeypatch):
    estimate(data, tmp_path / "whole.h5")
    done, calls = module.sequence_flow, []

    def stopping(*arguments):
        calls.append(1)
        if len(calls) == 2:
            os.kill(os.getpid(), signal.SIGTERM)
        return done(*arguments)

    monkeypatch.setattr(module, "sequence_flow", stopping)
    with pytest.raises(Stopped, match="2 of 5 sequences are kept"):
        estimate(data, tmp_path / "flow.h5")
    assert not (tmp_path / "flow.h5").exists()
    estimate(data, tmp_path / "flow.h5")
    assert len(calls) == 5
    assert (tmp_path / "flow.h5").read_bytes() == (tmp_path / "whole.h5").read_bytes()
    estimate(data, tmp_path / "flow.h5")  # already complete
    assert len(calls) == 5 and sorted(p.name for p in tmp_path.iterdir()) == ["flow.h5", "whole.h5"]
    with pytest.raises(UsageError, match="exists, made with seed 0, now 1; write"):
        estimate(data, tmp_path / "flow.h5", seed=1)
    estimate(data, tmp_path / "flow.h5", seed=1, force=True)
    assert (tmp_path / "flow.h5").read_bytes() != (tmp_path / "whole.h5").read_bytes()


def test_what_a_worker_process_gets_does_the_same(data):
    with CloudsReader(data) as reader:
        work, item = FlowOfSequence("nearest", 20), reader.read(2)
    there, given = pickle.loads(pickle.dumps((work, item)))
    np.testing.assert_array_equal(there(given).scene_flow, work(item).scene_flow)


def test_a_trained_estimator_is_loaded_once_and_sees_the_drawn_points(data, tmp_path, monkeypatch):
    from dpcli.segment.flow import model_file
    from dpcli.segment.flow.config import FlowConfig
    from dpcli.segment.flow.estimators import estimate_flow
    from dpcli.segment.flow.flowstep3d import FlowStep3D

    torch.manual_seed(0)
    model = FlowStep3D(FlowConfig(local=(8, 8), deep=(8, 8), hidden=8, head=8, neighbors=6, iterations=2))
    torch.nn.init.normal_(model.last.weight, std=0.1)
    model_file.save_flow_model(tmp_path / "best.safetensors", model, {})
    loads, load = [], model_file.load_network
    monkeypatch.setattr(model_file, "load_network", lambda *words: loads.append(1) or load(*words))
    estimate(data, tmp_path / "flow.h5", flow=str(tmp_path))
    assert len(loads) == 1
    with CloudsReader(tmp_path / "flow.h5") as reader, CloudsReader(data) as before:
        own = reader.read(4)
        drawn = draw_points(before.read(4), 20, generator(0, SegmentStream.FLOW_POINTS))
        np.testing.assert_array_equal(own.points, drawn.points)
        first, second = (torch.from_numpy(own.frame(t))[None] for t in (0, 1))
        np.testing.assert_array_equal(own.scene_flow[:20], estimate_flow(first, second, str(tmp_path))[0].numpy())
        assert set(reader.provenance[-1]["inputs"]) == {"clouds", "flow"}


def test_a_pipe_gives_the_same_file(data, tmp_path, monkeypatch):
    estimate(data, tmp_path / "file.h5")
    monkeypatch.setattr("sys.stdin", SimpleNamespace(buffer=io.BytesIO(data.read_bytes())))
    out = io.BytesIO()
    monkeypatch.setattr("sys.stdout", SimpleNamespace(buffer=out))
    estimate("-", "-")
    (tmp_path / "piped.h5").write_bytes(out.getvalue())
    with CloudsReader(tmp_path / "piped.h5") as piped, CloudsReader(tmp_path / "file.h5") as file:
        assert piped.names == file.names and piped.attributes["source"] == "stdin"
        np.testing.assert_array_equal(piped.read(4).scene_flow, file.read(4).scene_flow)


def test_mistakes_end_with_a_sentence(data, tmp_path):
    with pytest.raises(UsageError, match="--flow fast: expected icp, nearest, or a trained estimator"):
        estimate(data, tmp_path / "flow.h5", flow="fast")
    with pytest.raises(DataError, match="no sequence of split 'val'; it has"):
        estimate(data, tmp_path / "flow.h5", split="val")
    (tmp_path / "text.h5").write_text("no")
    with pytest.raises(UsageError, match="is where the output should go"):
        estimate(data, tmp_path / "text.h5")
    assert [p.name for p in tmp_path.iterdir()] == ["text.h5"]
