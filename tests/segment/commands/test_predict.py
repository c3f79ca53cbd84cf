"""`dpc segment predict` as its users run it: files, pipes, classical methods, settings, mistakes."""

from __future__ import annotations

import json

import numpy as np
import pytest

from dpcli.store import CloudSequence, CloudsReader, CloudsWriter
from dpcli.store.parts import PartsReader
from tests.support.commands import piped


def test_predict_and_evaluate_in_a_pipe_and_with_files(dpc_here, data, run_folder, tmp_path):
    predict = ("segment", "predict", data, "--model", run_folder, "--flow", "nearest", "--points", 48, "--pairs", "all")
    done = dpc_here(
        *predict, "-o", tmp_path / "parts.h5", "--picture", tmp_path / "parts.png", "--ply", tmp_path / "ply"
    )
    assert done.returncode == 0, done.stderr.decode()
    assert (tmp_path / "parts.png").read_bytes()[:4] == b"\x89PNG" and len(
        list((tmp_path / "ply").rglob("*.ply"))
    ) == 18
    through = piped(*predict, "-o", "-")
    assert through.returncode == 0
    judged = piped("evaluate", "segmentation", "-", "--truth", data, "--json", stdin=through.stdout)
    assert judged.returncode == 0, judged.stderr.decode()
    with PartsReader(tmp_path / "parts.h5") as reader:
        assert len(reader) == 6 and reader.num_parts == 8
        sample, sequence = reader.read_parts(0), reader.read(0)
        assert sample.pairs.tolist() == [[i, j] for i in range(3) for j in range(3) if i != j]
        assert np.allclose(sample.probability.sum(1), 1, atol=1e-4)
        assert (sequence.part == sample.probability.argmax(1)).all()
    motion = dpc_here("evaluate", "motion", tmp_path / "parts.h5", "--truth", data, "--json")
    assert motion.returncode == 0 and np.isfinite(json.loads(motion.stdout)["metrics"]["epe3d"])


@pytest.mark.parametrize("command", [("predict", "--method", "ward"), ("estimate-flow",)])
def test_a_sequence_is_told_the_same_alone_and_among_others(command, dpc_here, tmp_path):
    """More points than are looked at, so that some are drawn."""
    rng = np.random.default_rng(8)
    clouds = {name: [np.float32(rng.uniform(-1, 1, (900, 3))) for _ in range(2)] for name in "abc"}
    for file, names in (("all.h5", "abc"), ("one.h5", "c")):
        with CloudsWriter(tmp_path / file, fields=[]) as writer:
            for name in names:
                writer.write(CloudSequence.from_frames(name, clouds[name]))
        words = ("--flow", "nearest", "--points", 40, "-o", tmp_path / f"found-{file}")
        assert dpc_here("segment", command[0], tmp_path / file, *command[1:], *words).returncode == 0
    reader = PartsReader if command[0] == "predict" else CloudsReader
    with reader(tmp_path / "found-all.h5") as whole, reader(tmp_path / "found-one.h5") as alone:
        one, other = whole.read(2), alone.read(0)
        assert one.points.tobytes() == other.points.tobytes()
        if command[0] == "predict":
            assert one.part.tobytes() == other.part.tobytes() and len(set(one.part.tolist())) > 1
        else:
            assert len(one.points) == 80 and one.scene_flow.tobytes() == other.scene_flow.tobytes()


@pytest.mark.parametrize("method", ["dbscan", "ward", "ssc", "trajaffn"])
def test_classical_methods_write_the_same_kind_of_file(dpc_here, data, tmp_path, method):
    done = dpc_here(
        "segment", "predict", data, "--method", method, "--flow", "nearest", "-o", tmp_path / "p.h5", "--split", "test"
    )
    assert done.returncode == 0, done.stderr.decode()
    with PartsReader(tmp_path / "p.h5") as reader:
        assert reader.names == ["d4", "d5"] and reader.read(0).part.min() >= 0


@pytest.mark.parametrize(
    ("parts", "sizes", "found"), [(40, [20] * 40, 40), (3, [400, 390, 10], 2), (20, [60] * 20, 20)]
)
@pytest.mark.parametrize("method", ["ward", "trajaffn", "ssc"])
def test_as_many_parts_are_found_as_are_asked_for_or_a_warning_says_so(method, parts, sizes, found, dpc_here, tmp_path):
    rng = np.random.default_rng(5)
    place, step = rng.uniform(-1, 1, (parts, 3)), rng.normal(0, 0.08, (parts, 3))
    own = np.repeat(np.arange(parts), sizes)
    shape = rng.normal(0, 0.01, (len(own), 3))
    clouds = [np.float32(place[own] + t * step[own] + shape) for t in range(2)]
    with CloudsWriter(tmp_path / "c.h5", fields=[]) as writer:
        writer.write(CloudSequence.from_frames("many", clouds))
    words = ("--method", method, "--parts", parts, "--flow", "nearest" if method == "ward" else "icp")
    done = dpc_here("segment", "predict", tmp_path / "c.h5", "-o", tmp_path / "p.h5", *words)
    assert done.returncode == 0, done.stderr
    with PartsReader(tmp_path / "p.h5") as reader:
        count = len(np.unique(reader.read(0).part))
    assert (f"fewer than the {parts} parts of --parts" in done.stderr.decode()) == (count < parts)
    assert method != "ward" or count == found


def test_no_name_in_a_file_leads_out_of_the_folder_of_ply_files(dpc_here, tmp_path):
    """Nor do two names share a folder."""
    names, cloud = ["..", "a/b", "a_b"], np.random.default_rng(0).random((20, 3), np.float32)
    with CloudsWriter(tmp_path / "c.h5", class_names=[], length_unit="m") as writer:
        for name in names:
            writer.write(CloudSequence.from_frames(name, [cloud]))
    done = dpc_here("segment", "predict", tmp_path / "c.h5", "-o", tmp_path / "p.h5", "--ply", tmp_path / "ply")
    assert done.returncode == 0, done.stderr.decode()
    found = sorted(path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.ply") if path.is_file())
    assert found == ["ply/a_b_1/0000.ply", "ply/a_b_2/0000.ply", "ply/object/0000.ply"]


def test_a_sequence_of_one_frame_is_told_to_be_one_part(dpc_here, tmp_path):
    rng = np.random.default_rng(0)
    with CloudsWriter(tmp_path / "c.h5", class_names=[]) as writer:
        for name, frames in (("two", 2), ("one", 1)):
            writer.write(CloudSequence.from_frames(name, [rng.random((200, 3), np.float32)] * frames))
    done = dpc_here("segment", "predict", tmp_path / "c.h5", "-o", tmp_path / "p.h5")
    assert done.returncode == 0 and "one frame shows no motion: all is one part in one\n" in done.stderr.decode()


@pytest.mark.parametrize(
    "method, unit, warned", [("scene", "furlong", 1), ("scene", "cm", 0), ("multibody", "furlong", 0)]
)
def test_a_unit_that_no_table_knows_is_told_once_where_lengths_are_meters(method, unit, warned, dpc_here, tmp_path):
    rng = np.random.default_rng(0)
    with CloudsWriter(tmp_path / "c.h5", class_names=[], length_unit=unit) as writer:
        for name in "ab":
            writer.write(CloudSequence.from_frames(name, [rng.random((200, 3), np.float32)] * 2))
    done = dpc_here("segment", "predict", tmp_path / "c.h5", "-o", tmp_path / "p.h5", "--method", method)
    assert done.returncode == 0, done.stderr.decode()
    assert done.stderr.decode().count("unit of length is 'furlong', which counts as 1 m here") == warned


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
        (("predict", "DATA", "-o", "OUT", "--model", "nowhere"), 3, b"no such file"),
        (("predict", "DATA", "-o", "OUT", "--method", "kmeans"), 2, b"dbscan, ward, ssc, trajaffn"),
        (("predict", "DATA", "-o", "OUT", "--parts", "3"), 2, b"parts belongs to --method"),
        (("predict", "DATA", "-o", "OUT", "--fast", "--method", "ward"), 2, b"it means --method network"),
        (("predict", "DATA", "-o", "OUT", "--model", "nowhere", "--method", "multibody"), 2, b"uses no network"),
        (("predict", "DATA", "-o", "OUT", "--flow", "nearest"), 2, b"multibody finds the motions itself"),
        (("predict", "DATA", "-o", "OUT", "--flow", "tracks"), 2, b"has no field track"),
        (("predict", "DATA", "-o", "OUT", "--flow", "tracks", "--fast"), 2, b"read tracks"),
        (
            ("predict", "DATA", "-o", "OUT", "--method", "ward", "--pairs", "some"),
            2,
            b"pairs = some: expected one of adjacent, all",
        ),
        (("predict", "DATA", "-o", "OUT", "--method", "ward", "--split", "none"), 3, b"no sequence of split"),
        (("predict", "nothing.h5", "-o", "OUT", "--method", "ward"), 3, b"no such file"),
    ],
)
def test_mistakes_end_with_a_sentence(dpc_here, data, tmp_path, words, code, message):
    words = [str(data) if w == "DATA" else str(tmp_path / "out") if w == "OUT" else w for w in words]
    done = dpc_here("segment", *words)
    assert done.returncode == code and message in done.stderr, done.stderr.decode()
    assert b"a bug" not in done.stderr and not (tmp_path / "out").is_file()


@pytest.mark.parametrize(
    "words, said",
    [
        (("--method", "ward", "--model", "x"), "--model x: --method ward uses no network"),
        (("--method", "ward", "--set", "max_points=1"), "max_points = 1: expected at least 2"),
        (("--method", "ward", "--set", "threshold=inf"), "threshold = inf: expected a finite number"),
        (("--method", "ward", "--set", "eps=0.3"), "eps belongs to --method dbscan; ward has threshold, motion_weight"),
        (("--method", "ssc", "--set", "motion=none"), "motion = none: --method ssc sees only motion"),
        (("--set", "max_parts=3"), "max_parts belongs to --method"),
        (("--method", "ward", "--parts", "40000"), "--parts 40000: more than the 512 points"),
        (("--scene", "--method", "ward"), "--scene: it means --method scene, but --method ward was given"),
        (("--scene", "--fast"), "--fast: it means --method network, but --scene was given"),
        (("--scene", "--model", "x"), "--model x: --method scene uses no network"),
        (("--scene", "--flow", "nearest"), "--flow nearest: scene finds the motions itself"),
    ],
)
def test_what_cannot_be_meant_is_refused(words, said, dpc_here, data, tmp_path):
    done = dpc_here("segment", "predict", data, "-o", tmp_path / "out.h5", *words)
    assert done.returncode == 2 and said.encode() in done.stderr, done.stderr
    assert not (tmp_path / "out.h5").exists()


@pytest.mark.parametrize("words", [("--picture", "no/x.png"), ("--picture", "x.foo"), ("--turntable", "x.png")])
def test_pictures_that_cannot_be_written_are_refused_before_the_work(words, dpc_here, data, tmp_path):
    done = dpc_here("segment", "predict", data, "-o", tmp_path / "parts.h5", words[0], tmp_path / words[1])
    assert done.returncode in (2, 3) and words[0].encode() in done.stderr and not (tmp_path / "parts.h5").exists()


def test_resolved_settings_stand_in_the_file(dpc_here, data, tmp_path):
    words = ("--method", "trajaffn", "--flow", "nearest", "--points", 48, "--set", "vote=false", "--split", "test")
    done = dpc_here("segment", "predict", data, "-o", tmp_path / "p.h5", *words)
    assert done.returncode == 0, done.stderr
    with PartsReader(tmp_path / "p.h5") as reader:
        config = reader.provenance[-1]["config"]["settings"]
    assert config["input"] == {"flow": "nearest", "split": "test"}
    assert config["refinement"]["vote"] is False and config["refinement"]["split_bodies"] is False
    assert config["classical"]["motion"] == "residual" and config["classical"]["fewest"] == 1
    assert "eps" not in config["classical"]
    told = dpc_here("info", tmp_path / "p.h5").stdout.decode()
    assert "settings refinement  icp 20, normalize true, pairs adjacent, points 48" in told


def test_settings_of_tracks_and_of_the_search_are_told_apart(dpc_here, tmp_path):
    """`flexible` is read only by tracks, the search's settings only without them."""
    rng = np.random.default_rng(2)
    clouds = [np.float32(rng.uniform(-1, 1, (60, 3)))] * 2
    for fields in ([], ["track"]):
        with CloudsWriter(tmp_path / f"c{len(fields)}.h5", fields=fields) as writer:
            sequence = CloudSequence.from_frames("one", clouds)
            sequence.track = np.tile(np.arange(60), 2) if fields else None
            writer.write(sequence)
    predict = ("segment", "predict")
    done = dpc_here(*predict, tmp_path / "c0.h5", "-o", tmp_path / "p.h5", "--set", "flexible=0.1")
    assert done.returncode == 2 and b"c0.h5 has no field track" in done.stderr
    words = ("--set", "flexible=0.1", "--flow", "icp")
    done = dpc_here(*predict, tmp_path / "c1.h5", "-o", tmp_path / "p.h5", *words)
    assert done.returncode == 2 and b"--flow icp uses none" in done.stderr
    words = ("--set", "flexible=0.1", "--set", "border=0.1", "--set", "max_bodies=3")
    done = dpc_here(*predict, tmp_path / "c1.h5", "-o", tmp_path / "p.h5", *words)
    assert done.returncode == 0 and b"warning: border: not read where points have tracks" in done.stderr


def test_flows_of_all_pairs_that_take_much_memory_are_told_before_the_work(dpc_here, tmp_path, monkeypatch):
    from dpcli.segment.commands import predict as commands

    rng, frames, points = np.random.default_rng(0), 5, 40
    with CloudsWriter(tmp_path / "c.h5", class_names=[]) as writer:
        writer.write(CloudSequence.from_frames("long", [rng.random((points, 3), np.float32)] * frames))
    words = ("segment", "predict", tmp_path / "c.h5", "-o", tmp_path / "p.h5", "--method", "ward", "--flow", "nearest")
    told = f"the flows and motions of the {frames * (frames - 1)} pairs of frames of long"
    assert told not in dpc_here(*words, "--pairs", "all").stderr.decode()
    with PartsReader(tmp_path / "p.h5") as reader:
        sample = reader.read_parts(0)
        made = sum(map(np.size, sample.flow)) * 4 + sample.motion.size * 4
    monkeypatch.setattr(commands, "_MUCH", made - 1)
    assert told in dpc_here(*words, "--pairs", "all", "--force").stderr.decode()
    monkeypatch.setattr(commands, "_MUCH", made)
    assert told not in dpc_here(*words, "--pairs", "all", "--force").stderr.decode()


def test_frames_of_more_points_than_are_looked_at_are_told(tmp_path, monkeypatch):
    from dpcli.segment.commands import predict as commands

    rng, lines = np.random.default_rng(0), []
    monkeypatch.setattr(commands.log, "info", lines.append)
    for name, sizes in (("few.h5", (40, 512)), ("many.h5", (40, 700))):
        with CloudsWriter(tmp_path / name, class_names=[]) as writer:
            writer.write(CloudSequence.from_frames("a", [rng.random((size, 3), np.float32) for size in sizes]))

    def said(name: str, points: int = 512) -> str:
        lines.clear()
        with CloudsReader(tmp_path / name) as reader:
            commands._tell_of_thinning(reader, [0], points)
        return "".join(lines)

    assert "512 of up to 700 points of a frame are looked at" in said("many.h5")
    assert said("many.h5", 600) == said("few.h5") == ""
