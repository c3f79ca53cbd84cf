"""`dpc segment` as its users run it: train, stop, continue, predict, pipes, mistakes."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from dpcli.cli.app import app
from dpcli.errors import DataError, UsageError
from dpcli.segment.commands.predict import split_sequences
from dpcli.segment.frame_pairs import PairSource, backward_flow, choose_points, sequence_scale
from dpcli.segment.prediction import Refinement, predict_parts
from dpcli.segment.training.flow_store import FlowStore
from dpcli.segment.training.objective import Batch, Objective, pair_loss, turn_randomly
from dpcli.segment.training.trainer import Schedule, rand_index
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter
from dpcli.store.parts import PartsReader

TRAIN = ("--flow", "nearest", "--points", 48, "--batch", 2, "--epochs", 2, "--pairs-per-epoch", 6, "--seed", 3)


def drawer(name: str, seed: int, frames: int = 3, points: int = 60, **fields) -> CloudSequence:
    """A box and a drawer that slides out of it while both turn; the truth beside."""
    rng = np.random.default_rng(seed)
    clouds, parts, poses = [], [], []
    for t in range(frames):
        body = rng.uniform(-0.5, 0.5, (points // 2, 3)) * [0.4, 0.6, 0.5]
        front = rng.uniform(-0.5, 0.5, (points - points // 2, 3)) * [0.1, 0.5, 0.3]
        angle = 0.1 * t
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        pose = np.tile(np.eye(4), (2, 1, 1))
        pose[:, :3, :3] = turn
        pose[1, :3, 3] = turn @ [0.25 + 0.1 * t, 0, 0]
        clouds.append(np.float32(np.concatenate([body @ turn.T, front @ turn.T + pose[1, :3, 3]])))
        parts.append(np.repeat([0, 1], [points // 2, points - points // 2]).astype(np.int16))
        poses.append(pose)
    return CloudSequence.from_frames(name, clouds, part=parts, pose=np.stack(poses), **fields)


def drawers(path: Path, count: int) -> Path:
    """A file of drawers, the last third of them for testing."""
    with CloudsWriter(path, class_names=["drawer"], fields=["part", "pose"]) as writer:
        for i in range(count):
            writer.write(drawer(f"d{i}", i, split="train" if i < count - count // 3 else "test", label=0))
    return path


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return drawers(tmp_path_factory.mktemp("parts") / "clouds.h5", 6)


@pytest.fixture(scope="module")
def run_folder(dpc, data, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "model"
    done = dpc("segment", "train", data, "-o", folder, *TRAIN)
    assert done.returncode == 0, done.stderr.decode()
    assert done.stdout.decode().strip() == str(folder / "best.safetensors")
    return folder


def test_training_leaves_what_people_look_for(run_folder):
    rows = json.loads((run_folder / "log.json").read_text())
    assert [row["epoch"] for row in rows] == [1, 2] and all(np.isfinite(row["loss"]) for row in rows)
    assert rows[0]["flow_error"] > 0 and rows[1]["motion"] is not None and rows[1]["consensus"] is not None
    assert (run_folder / "curves.png").read_bytes()[:4] == b"\x89PNG"


def test_running_again_continues_and_another_configuration_is_refused(dpc_here, data, run_folder):
    again = dpc_here("segment", "train", data, "-o", run_folder, *TRAIN)
    assert again.returncode == 0 and b"is finished already" in again.stderr and b"continuing" not in again.stderr
    other = dpc_here("segment", "train", data, "-o", run_folder, *TRAIN[:-1], 4)
    assert other.returncode == 2 and b"another configuration" in other.stderr


def test_a_command_that_fails_deletes_no_network(dpc_here, data, run_folder, tmp_path):
    """--force empties the folder only once everything else is there, checked and read."""
    folder, other = shutil.copytree(run_folder, tmp_path / "run"), shutil.copytree(run_folder, tmp_path / "other")
    (other / "flows_first.npy").unlink()
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert {"best.safetensors", "flows_first.npy", "state.pt"} <= before.keys()
    for more, said in (
        (("--start-from", folder), "--start-from"),
        (("--start-from", "nosuch"), "--start-from nosuch: no such file"),
        (("--flows-of", folder), "lies in the folder of -o"),
        (("--flows-of", other), "no flows of a `dpc segment train` run"),
        (("--flow", "nosuch"), "--flow nosuch: expected icp"),
    ):
        done = dpc_here("segment", "train", data, "-o", folder, *TRAIN, "--force", *more)
        assert done.returncode == 2 and said in done.stderr.decode() and b"--model" not in done.stderr, (
            more,
            done.stderr,
        )
        assert {path.name: path.read_bytes() for path in folder.iterdir()} == before, more


def test_a_killed_run_ends_like_an_uninterrupted_one(data, run_folder, tmp_path):
    """SIGTERM saves and exits 75; kill -9 loses what came after the last checkpoint; weights and flows come out equal."""
    folder = tmp_path / "killed"
    command = [sys.executable, "-m", "dpcli", "segment", "train", data, "-o", folder, *TRAIN]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[3])}
    codes = []
    for number, wait_for in ((signal.SIGTERM, "flows.npy"), (signal.SIGKILL, "state.pt")):
        process = subprocess.Popen(
            [str(w) for w in command], env=environment, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL
        )
        deadline = time.time() + 120
        while not (folder / wait_for).exists() and process.poll() is None and time.time() < deadline:
            time.sleep(0.02)
        time.sleep(0.3)
        process.send_signal(number)
        process.communicate(timeout=120)
        codes.append(process.returncode)
    assert codes[0] in (75, 0) and codes[1] in (-9, 0)
    assert subprocess.run([str(w) for w in command], env=environment, capture_output=True, timeout=200).returncode == 0
    from safetensors.torch import load_file

    ours, theirs = (load_file(f / "last.safetensors") for f in (folder, run_folder))
    distance = sum(float((ours[k] - theirs[k]).square().sum()) for k in ours) ** 0.5
    assert distance <= 1e-3 * sum(float(v.square().sum()) for v in theirs.values()) ** 0.5
    flows = [np.load(f / "flows.npy") for f in (folder, run_folder)]
    assert np.abs(flows[0] - flows[1]).max() < 1e-3


def test_predict_and_evaluate_in_a_pipe_and_with_files(dpc, data, run_folder, tmp_path):
    predict = ("segment", "predict", data, "--model", run_folder, "--flow", "nearest", "--points", 48, "--pairs", "all")
    done = dpc(*predict, "-o", tmp_path / "parts.h5", "--picture", tmp_path / "parts.png", "--ply", tmp_path / "ply")
    assert done.returncode == 0, done.stderr.decode()
    assert (tmp_path / "parts.png").read_bytes()[:4] == b"\x89PNG" and len(
        list((tmp_path / "ply").rglob("*.ply"))
    ) == 18
    piped = dpc(*predict, "-o", "-")
    assert piped.returncode == 0
    judged = dpc("evaluate", "segmentation", "-", "--truth", data, "--json", stdin=piped.stdout)
    assert judged.returncode == 0, judged.stderr.decode()
    with PartsReader(tmp_path / "parts.h5") as reader:
        assert len(reader) == 6 and reader.num_parts == 8
        sample, sequence = reader.read_parts(0), reader.read(0)
        assert sample.pairs.tolist() == [[i, j] for i in range(3) for j in range(3) if i != j]
        assert np.allclose(sample.probability.sum(1), 1, atol=1e-4)
        assert (sequence.part == sample.probability.argmax(1)).all()
    motion = dpc("evaluate", "motion", tmp_path / "parts.h5", "--truth", data, "--json")
    assert motion.returncode == 0 and np.isfinite(json.loads(motion.stdout)["metrics"]["epe3d"])


@pytest.mark.parametrize("method", ["dbscan", "ward", "ssc", "trajaffn"])
def test_classical_methods_write_the_same_kind_of_file(dpc_here, data, tmp_path, method):
    done = dpc_here(
        "segment", "predict", data, "--method", method, "--flow", "nearest", "-o", tmp_path / "p.h5", "--split", "test"
    )
    assert done.returncode == 0, done.stderr.decode()
    with PartsReader(tmp_path / "p.h5") as reader:
        assert reader.names == ["d4", "d5"] and reader.read(0).part.min() >= 0


def test_too_little_memory_keeps_what_was_predicted(dpc_here, data, tmp_path, monkeypatch):
    from dpcli.segment.commands import predict as commands

    predict, asked = commands.predict_parts, []

    def scarce(sequence, *rest):
        asked.append(sequence.name)
        if len(asked) == 3:
            raise MemoryError
        return predict(sequence, *rest)

    monkeypatch.setattr(commands, "predict_parts", scarce)
    words = ("segment", "predict", data, "--method", "ward", "--flow", "nearest", "--parts", 2, "--split", "all")
    assert dpc_here(*words, "-o", tmp_path / "whole.h5").returncode == 1 and len(asked) == 3
    assert dpc_here(*words, "-o", tmp_path / "whole.h5").returncode == 0
    assert len(asked) == 3 + len(PartsReader(tmp_path / "whole.h5")) - 2 and not list(tmp_path.glob(".*"))


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (("train", "DATA", "-o", "OUT", "--config", "huge"), 2, b"compact, release"),
        (("train", "DATA", "-o", "OUT", "--validation", "lamp"), 2, b"no class 'lamp'"),
        (("train", "DATA", "-o", "OUT", "--loss", "l2"), 2, b"blended or per-part"),
        (("train", "DATA", "-o", "OUT", "--lr", "0"), 2, b"above 0"),
        (("train", "DATA", "-o", "OUT", "--flow", "nowhere.safetensors"), 2, b"nowhere.safetensors"),
        (("predict", "DATA", "-o", "OUT", "--model", "nowhere"), 2, b"no such file"),
        (("predict", "DATA", "-o", "OUT", "--method", "kmeans"), 2, b"dbscan, ward, ssc, trajaffn"),
        (("predict", "DATA", "-o", "OUT", "--parts", "3"), 2, b"belong to --method"),
        (("predict", "DATA", "-o", "OUT", "--method", "ward", "--pairs", "some"), 2, b"adjacent or all"),
        (("predict", "DATA", "-o", "OUT", "--method", "ward", "--split", "none"), 3, b"no sequence of split"),
        (("predict", "nothing.h5", "-o", "OUT", "--method", "ward"), 3, b"no such file"),
    ],
)
def test_mistakes_end_with_a_sentence(dpc_here, data, tmp_path, words, code, message):
    words = [str(data) if w == "DATA" else str(tmp_path / "out") if w == "OUT" else w for w in words]
    done = dpc_here("segment", *words)
    assert done.returncode == code and message in done.stderr, done.stderr.decode()
    assert b"a bug" not in done.stderr and not (tmp_path / "out").is_file()


def two_halves(frames, flows):
    """A segmenter that knows the answer of points in the order of `drawer`."""
    masks = []
    for frame in frames:
        mask = torch.full((len(frame), 3), 1e-6)
        mask[: len(frame) // 2, 0], mask[len(frame) // 2 :, 2] = 1 - 2e-6, 1 - 2e-6
        masks.append(mask)
    return masks


def true_flows(sequence: CloudSequence, scale: float):
    """An estimator that knows the answer; frames are told apart by their first point."""
    from dpcli.segment.frame_pairs import frame_parts, true_flow

    clouds = [sequence.frame(t) for t in range(sequence.num_frames)]
    center = np.concatenate(clouds).mean(0)
    whole = [(c - center) * scale for c in clouds]

    def which(points):
        return int(np.argmin([np.abs(c[0] - points[0].numpy()).max() for c in whole]))

    def one(first, second):
        i, j = which(first), which(second)
        flow = true_flow(clouds[i], frame_parts(sequence, i), sequence.pose[i], sequence.pose[j])
        return torch.tensor(np.float32(flow * scale))

    def estimate(first, second):
        return one(first, second), one(second, first)

    return estimate


@pytest.mark.parametrize("pairs", ["adjacent", "all"])
def test_motions_are_the_true_ones_in_the_inputs_own_coordinates(pairs):
    """With the right masks and flows, part_motion is pose_j pose_i^-1 and flow follows, whatever place and unit."""
    sequence = drawer("d", 5)
    sequence.points = np.float32(sequence.points * 7 + [100, -50, 3])
    sequence.pose[:, :, :3, 3] = sequence.pose[:, :, :3, 3] * 7 + [100, -50, 3]
    scale = sequence_scale([sequence.frame(t) for t in range(3)])
    options = Refinement(pairs=pairs, icp=0, vote=False)  # where parts touch, a neighbor frame votes otherwise
    labels, sample = predict_parts(sequence, 0, two_halves, true_flows(sequence, scale), options, 0)
    assert rand_index(torch.tensor(labels), torch.tensor(np.int64(sequence.part))) == 1
    for (i, j), motion, flow in zip(sample.pairs, sample.motion, sample.flow):
        truth = sequence.pose[j] @ np.linalg.inv(sequence.pose[i])
        assert np.abs(motion[[0, 2], :3, :3] - truth[:, :3, :3]).max() < 2e-3
        points = sequence.frame(i)
        moved = np.einsum("nij,nj->ni", truth[sequence.part[:60], :3, :3], points) + truth[sequence.part[:60], :3, 3]
        assert np.abs(flow - (moved - points)).max() < 1e-2  # of 7 units an object


@pytest.mark.parametrize("pairs", ["adjacent", "all"])
@pytest.mark.parametrize("empty", [(0,), (2,), (1, 3), (0, 5, 6)])
def test_frames_without_points_change_nothing_for_the_others(empty, pairs):
    whole = drawer("d", 5, frames=4)
    clouds, rest = [whole.frame(t) for t in range(4)], list(range(4))
    for t in empty:
        clouds.insert(t, np.zeros((0, 3), np.float32))
        rest = [k + (k >= t) for k in rest]
    holed = CloudSequence.from_frames("d", clouds)

    def halves_and_flow(found: list):
        """Masks from the points; flow from nearest neighbors; and what was asked for."""

        def estimate(first, second):
            found.append((len(first), len(second)))
            return torch.full_like(first, 0.01 * len(found)), torch.full_like(second, -0.01)

        return estimate

    asked, same = [], []
    options = Refinement(pairs=pairs, icp=0)
    labels, sample = predict_parts(whole, 0, two_halves, halves_and_flow(asked), options, 0)
    found, holes = predict_parts(holed, 0, two_halves, halves_and_flow(same), options, 0)
    np.testing.assert_array_equal(found, labels)
    np.testing.assert_array_equal(holes.probability, sample.probability)
    known = {tuple(pair): number for number, pair in enumerate(sample.pairs.tolist())}
    assert len(holes.pairs) == (len(clouds) - 1 if pairs == "adjacent" else len(clouds) * (len(clouds) - 1))
    for (i, j), motion, flow in zip(holes.pairs.tolist(), holes.motion, holes.flow):
        assert flow.shape == (len(clouds[i]), 3)
        if i in rest and j in rest:
            own = known[rest.index(i), rest.index(j)]
            np.testing.assert_array_equal(motion, sample.motion[own])
            np.testing.assert_array_equal(flow, sample.flow[own])
        else:
            assert (motion == np.eye(4)).all() and not flow.any()


def test_training_leaves_pairs_without_points_out(tmp_path, capsys):
    clouds = [drawer("d", 0, frames=5).frame(t) for t in range(5)]
    clouds[2] = np.zeros((0, 3), np.float32)
    with CloudsWriter(tmp_path / "a.h5") as writer:
        writer.write(CloudSequence.from_frames("a", clouds))
        writer.write(drawer("b", 1))
        writer.write(CloudSequence.from_frames("c", [clouds[0], clouds[2]]))
    reader = CloudsReader(tmp_path / "a.h5")
    source = PairSource(reader, [0, 1, 2], 20, 0)
    assert [(p.number, p.sequence, p.first) for p in source.pairs] == [(0, 0, 0), (1, 0, 3), (2, 1, 0), (3, 1, 1)]
    assert "3 of 7 pairs of frames left out" in capsys.readouterr().err
    assert all(np.isfinite(source.load(pair).points).all() for pair in source.pairs)
    with pytest.raises(DataError, match="all with a frame without points"):
        PairSource(reader, [2], 20, 0)


def test_poor_sequences_get_an_answer():
    def anything(frames, flows):
        return [torch.softmax(torch.randn(len(f), 4, generator=torch.Generator().manual_seed(0)), 1) for f in frames]

    def still(first, second):
        return torch.zeros_like(first), torch.zeros_like(second)

    for name, frames in {
        "one frame": [np.random.default_rng(0).normal(size=(50, 3))],
        "one point": [np.zeros((1, 3)), np.ones((1, 3))],
        "an empty frame": [np.zeros((0, 3)), np.random.default_rng(0).normal(size=(9, 3))],
        "all equal": [np.ones((30, 3)), np.ones((40, 3))],
    }.items():
        sequence = CloudSequence.from_frames(name, [np.float32(f) for f in frames])
        labels, sample = predict_parts(sequence, 0, anything, still, Refinement(points=32), 0)
        assert len(labels) == len(sequence.points) and np.isfinite(sample.probability).all(), name
        assert np.isfinite(sample.motion).all() and all(np.isfinite(f).all() for f in sample.flow), name


def test_the_right_masks_cost_less_than_wrong_ones_in_every_form(data):
    """The unsupervised loss prefers the truth to one part, to a shuffle, to a random mask."""
    reader = CloudsReader(data)
    source = PairSource(reader, [0, 1], 48, 0)
    loaded = [source.load(pair) for pair in source.pairs]
    stacked = (torch.tensor(np.stack([getattr(p, key) for p in loaded])) for key in ("points", "flow", "part"))
    batch = Batch(*(values.transpose(0, 1).flatten(0, 1) for values in stacked))

    class Fixed(torch.nn.Module):
        motion = None

        def __init__(self, mask):
            super().__init__()
            self.mask = mask

        def forward(self, points):
            return self

    right = torch.nn.functional.one_hot(batch.part, 4).float()
    wrong = {
        "one part": torch.nn.functional.one_hot(torch.zeros_like(batch.part), 4).float(),
        "shuffled": right[:, torch.randperm(48, generator=torch.Generator().manual_seed(0))],
        "even": torch.full_like(right, 0.25),
    }
    for form in ("blended", "per-part"):
        objective = Objective(form=form, cold_start=0)
        best = float(pair_loss(Fixed(right), batch, objective, 0.0).loss)
        assert best < 1e-3
        for name, mask in wrong.items():
            assert float(pair_loss(Fixed(mask), batch, objective, 0.0).loss) > 5 * best + 1e-3, (form, name)


def with_scene_flow(sequence: CloudSequence) -> CloudSequence:
    """The truth told as displacements to the next frame (the last frame's: to the one before) instead of poses."""
    from dpcli.segment.frame_pairs import frame_parts, true_flow

    rows, last = [], sequence.num_frames - 1
    for t in range(sequence.num_frames):
        poses = sequence.pose[t], sequence.pose[t + 1 if t < last else t - 1]
        rows.append(true_flow(sequence.frame(t), frame_parts(sequence, t), *poses))
    sequence.scene_flow = np.float32(np.concatenate(rows))
    return sequence


@pytest.fixture(scope="module")
def flow_data(tmp_path_factory) -> Path:
    """The sequences of `data`, whose truth is scene flow."""
    path = tmp_path_factory.mktemp("parts") / "flow.h5"
    with CloudsWriter(path, class_names=["drawer"], fields=["part", "scene_flow"]) as writer:
        for i in range(6):
            writer.write(with_scene_flow(drawer(f"d{i}", i, split="train" if i < 4 else "test", label=0)))
    return path


def test_pairs_with_scene_flow_are_those_with_poses(data, flow_data):
    """Where the file tells both ways, both are equal; elsewhere the way back is found among the points (below)."""
    ours, theirs = (PairSource(CloudsReader(path), [0, 1], 48, 3) for path in (flow_data, data))
    for pair in ours.pairs:
        one, other = ours.load(pair), theirs.load(pair)
        np.testing.assert_array_equal(one.points, other.points)
        np.testing.assert_allclose(one.flow[0], other.flow[0], atol=1e-6)
        if pair.first == 1:  # of three frames
            np.testing.assert_allclose(one.flow[1], other.flow[1], atol=1e-6)
        else:
            assert np.linalg.norm(one.flow[1] - other.flow[1], axis=1).mean() < 0.1 * np.abs(other.flow[1]).max()
    still = PairSource(CloudsReader(flow_data), [0], 48, 3)
    still.fields = ["part"]
    assert still.load(still.pairs[0]).flow is None


def test_the_way_back_ends_where_the_way_there_began():
    rng = np.random.default_rng(0)
    points, order = rng.normal(size=(40, 3)), rng.permutation(40)
    flow = rng.normal(size=(40, 3)) * 0.3
    np.testing.assert_array_equal(backward_flow(points, flow, (points + flow)[order]), -flow[order])


def test_supervised_training_learns_from_scene_flow(flow_data, tmp_path):
    def train(data: Path, name: str):
        words = (
            "-o",
            tmp_path / name,
            "--supervised",
            "--points",
            48,
            "--batch",
            2,
            "--epochs",
            1,
            "--pairs-per-epoch",
            2,
        )
        return CliRunner().invoke(app, ["segment", "train", str(data), *map(str, words)])

    assert train(flow_data, "run").exit_code == 0
    rows = json.loads((tmp_path / "run" / "log.json").read_text())
    assert all(np.isfinite(row["loss"]) and row["motion"] > 0 and row["flow_error"] == 0 for row in rows)
    with CloudsWriter(tmp_path / "bare.h5", fields=["part"]) as writer:
        writer.write(drawer("d", 0, split="train"))
    refused = train(tmp_path / "bare.h5", "no").exception
    assert isinstance(refused, DataError)
    assert "poses or scene flow, but the file has no pose or scene_flow" in str(refused)


def test_true_flow_of_loaded_pairs_maps_parts_onto_parts(data):
    source = PairSource(CloudsReader(data), [0], 60, 0)
    pair = source.load(source.pairs[0])
    moved = pair.points[0] + pair.flow[0]
    for part in (0, 1):  # independent samples of the same solid: the same extent within sampling
        a, b = moved[pair.part[0] == part], pair.points[1][pair.part[1] == part]
        assert np.abs(a.mean(0) - b.mean(0)).max() < 0.08


def test_flow_store_changes_nothing_twice_and_hands_first_flows_on(tmp_path):
    store = FlowStore(tmp_path, 3, 5, fresh=True)
    assert store.get(1) is None and store.telling(1) is None
    store.put_first(1, torch.ones(2, 5, 3), True)
    store.put(1, torch.full((2, 5, 3), 2.0))
    pending = store.pending()
    store.flush()
    again = FlowStore(tmp_path, 3, 5, fresh=False)
    again.restore(pending)  # as after a kill between saving the state and flushing
    assert float(again.get(1).mean()) == 2 and again.telling(1) and again.get(2) is None
    (tmp_path / "other").mkdir()
    other = FlowStore(tmp_path / "other", 3, 5, fresh=True, take_from=tmp_path)
    assert float(other.get(1).mean()) == 1 and other.telling(1) and other.get(0) is None
    with pytest.raises(UsageError, match="--flows-of"):
        FlowStore(tmp_path / "other", 4, 5, fresh=True, take_from=tmp_path)


def test_turning_keeps_pairs_together():
    points = torch.randn(6, 20, 3)
    turned, rotation = turn_randomly(points, torch.Generator().manual_seed(0))
    assert torch.equal(rotation[:3], rotation[3:]) and not torch.allclose(rotation[0], rotation[1])
    assert torch.allclose(torch.cdist(points, points), torch.cdist(turned, turned), atol=1e-4)


def test_splits_and_choices(data):
    reader = CloudsReader(data)
    assert split_sequences(reader, None, 0) == ([0, 1, 2, 3], [])
    train, held = split_sequences(reader, "0.25", 0)
    assert len(train) == 3 and len(held) == 1 and not set(train) & set(held)
    with pytest.raises(UsageError, match="fraction"):
        split_sequences(reader, "1.5", 0)
    rng = np.random.default_rng(0)
    assert sorted(choose_points(5, 5, rng)) == [0, 1, 2, 3, 4] and set(choose_points(3, 8, rng)) == {0, 1, 2}
    with pytest.raises(UsageError, match="--batch"):
        Schedule(batch=0)
    with pytest.raises(DataError, match="two frames"):
        PairSource(reader, [], 8, 0)


def test_a_flow_estimator_is_trained_and_used(dpc, data, tmp_path):
    folder = tmp_path / "flow"
    done = dpc("segment", "flow", data, "-o", folder, "--steps", 3, "--batch", 2, OMP_NUM_THREADS="1")
    assert done.returncode == 0, done.stderr.decode()
    assert (folder / "curves.png").exists() and done.stdout.decode().strip().endswith("best.safetensors")
    words = ("segment", "predict", data, "--method", "ward", "--flow", folder, "-o", tmp_path / "p.h5")
    used = dpc(*words, OMP_NUM_THREADS="1")
    assert used.returncode == 0, used.stderr.decode()
    again = dpc(*words, OMP_NUM_THREADS="1")
    assert again.returncode == 0 and b"already complete" in again.stderr
    learn = ("segment", "train", data, "-o", tmp_path / "run", *TRAIN[2:], "--flow", folder)
    assert dpc(*learn, OMP_NUM_THREADS="1").returncode == 0
    weights = folder / "best.safetensors"  # the estimator is trained on: the same path, another network
    header, tensors = weights.read_bytes()[:-4], weights.read_bytes()[-4:]
    weights.write_bytes(header + bytes(byte ^ 1 for byte in tensors))
    other = dpc(*words, OMP_NUM_THREADS="1")
    assert other.returncode == 2 and b"another model, data or choice" in other.stderr
    other = dpc(*learn, OMP_NUM_THREADS="1")
    assert other.returncode == 2 and b"another configuration (flow_weights" in other.stderr, other.stderr


@pytest.mark.parametrize(
    "words",
    [
        ("--group", "foo"),
        ("--pooling", "foo"),
        ("--smooth", "-1"),
        ("--cold-start", "-0.5"),
        ("--motion-after", "-0.1"),
        ("--lr", "0"),
        ("--lr", "1e+300"),
        ("--tau", "0"),
        ("--loss", "foo"),
        ("--consensus", "foo"),
    ],
)
def test_a_wrong_choice_is_named_before_anything_is_made(words, dpc_here, data, tmp_path):
    done = dpc_here("segment", "train", data, "-o", tmp_path / "model", *TRAIN, *words)
    assert done.returncode == 2 and f"{words[0]} {words[1]}".encode() in done.stderr and b"expected" in done.stderr
    assert not (tmp_path / "model").exists()


@pytest.mark.parametrize(
    "words, said",
    [
        (("train", "--validation", "drawer", *TRAIN), "--validation drawer: holds out all of the 4 training sequences"),
        (("predict", "--method", "ward", "--model", "x"), "--model x: --method ward uses no network"),
        (("predict", "--method", "ward", "--method-option", "max_points=1"), "expected int, 2 or more"),
        (("predict", "--method", "ward", "--method-option", "threshold=inf"), "expected a positive float"),
        (("predict", "--method", "ward", "--parts", "40000"), "--parts 40000: more than the 512 points"),
    ],
)
def test_what_cannot_be_meant_is_refused(words, said, dpc_here, data, tmp_path):
    done = dpc_here("segment", words[0], data, "-o", tmp_path / "out.h5", *words[1:])
    assert done.returncode == 2 and said.encode() in done.stderr, done.stderr
    assert not (tmp_path / "out.h5").exists()


def test_a_profile_names_the_groups_it_knows(dpc_here):
    done = dpc_here("segment", "profile", "--group", "foo")
    assert done.returncode == 2 and b"--group foo: expected icosahedral or trivial" in done.stderr


@pytest.mark.parametrize("words", [("--picture", "no/x.png"), ("--picture", "x.foo"), ("--turntable", "x.png")])
def test_pictures_that_cannot_be_written_are_refused_before_the_work(words, dpc_here, data, tmp_path):
    done = dpc_here("segment", "predict", data, "-o", tmp_path / "parts.h5", words[0], tmp_path / words[1])
    assert done.returncode in (2, 3) and words[0].encode() in done.stderr and not (tmp_path / "parts.h5").exists()
