"""Joining unlike files: label maps, names, units, fields; nothing is mixed up silently."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import pytest

from dpcli.errors import DataError, Stopped, UsageError
from dpcli.prepare.commands.merge import merge
from dpcli.prepare.label_map import LabelMap
from dpcli.prepare.pipeline import Conversion, convert
from dpcli.runtime.machines.shards import Shard, shard_of
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter
from dpcli.store.writing.open_readers import OpenReaders
from tests.support.commands import told as dpc
from tests.support.prepare_helpers import ROOT, ToyReader


def write(path: Path, names: list[str], classes: list[str], **options) -> Path:
    fields = options.get("fields", ())
    with CloudsWriter(path, class_names=classes, provenance={"config": {"of": path.name}}, **options) as writer:
        for number, name in enumerate(names):
            points = np.full((2 + number, 3), len(name) + number, np.float32)
            more = {"time": np.array([number / 2])} if "time" in fields else {}
            more |= {"track": [np.arange(len(points))]} if "track" in fields else {}
            label = number % len(classes) if classes else -1
            writer.write(CloudSequence.from_frames(name, [points], label=label, **more))
        writer.skipped = [(f"bad of {path.stem}", "why")]
    return path


@pytest.fixture
def two(tmp_path) -> list[Path]:
    a = write(tmp_path / "a.h5", ["a0", "a1", "a2"], ["hand wave", "push", "bend"])
    return [a, write(tmp_path / "b.h5", ["b0", "b1"], ["g1", "g2"])]


def joined(path: Path) -> dict[str, str]:
    with CloudsReader(path) as reader:
        return {name: reader.class_names[label] for name, label in zip(reader.names, reader.labels)}


def test_a_merge_of_files_that_changed_since_is_another_one(tmp_path):
    paths = [write(tmp_path / f"{k}.h5", [f"{k}x"], ["p"]) for k in range(2)]
    merge(paths, tmp_path / "all.h5")
    assert merge(paths, tmp_path / "all.h5").was_complete
    with h5py.File(paths[1], "r+") as file:
        file["points"][:1] += 1
    with pytest.raises(UsageError, match="exists, made with another file 2"):
        merge(paths, tmp_path / "all.h5")


def test_files_of_equal_classes_follow_one_another(tmp_path):
    paths = [write(tmp_path / f"{k}.h5", [f"{k}x", f"{k}y"], ["p", "q"]) for k in range(3)]
    report = merge(paths[::-1], tmp_path / "all.h5")
    assert report.written == 6 and report.skipped == [(f"bad of {k}", "why") for k in (2, 1, 0)]
    with CloudsReader(tmp_path / "all.h5") as whole, CloudsReader(paths[0]) as first:
        assert list(whole.names) == ["2x", "2y", "1x", "1y", "0x", "0y"] and whole.class_names == ["p", "q"]
        np.testing.assert_array_equal(whole.read(5).points, first.read(1).points)
        entry = whole.provenance[-1]
        assert entry["config"]["sources"][2] == [{"config": {"of": "0.h5"}}] and len(entry["inputs"]) == 3
    assert merge(paths[::-1], tmp_path / "all.h5").was_complete
    with pytest.raises(UsageError, match="made with other sources; merge"):
        merge(paths, tmp_path / "all.h5")


def test_many_files_are_not_all_open_at_once(tmp_path):
    readers = [CloudsReader(write(tmp_path / f"{k}.h5", [f"{k}x"], ["p"])) for k in range(5)]
    with OpenReaders(2) as opened:
        for reader in [*readers, *readers]:
            assert opened.use(reader).read(0).name == f"{reader.path.stem}x"
            assert sum(one._file is not None for one in readers) <= 2
    assert not any(one._file for one in readers)


def test_objects_of_few_and_of_many_parts_are_joined(tmp_path):
    paths = [tmp_path / "two.h5", tmp_path / "four.h5"]
    for path, parts in zip(paths, (2, 4)):
        with CloudsWriter(path, provenance={"config": {}}, fields=("part", "pose", "joint")) as writer:
            points, part = np.ones((4, 3), np.float32), np.arange(4, dtype=np.int16) % parts
            pose, joint = np.full((1, parts, 4, 4), 0.5), np.full((1, parts, 9), 1.0)
            writer.write(CloudSequence.from_frames(path.stem, [points], part=[part], pose=pose, joint=joint))
    for order in (paths, paths[::-1]):
        merge(order, tmp_path / "all.h5", force=True, labels=LabelMap())
        with CloudsReader(tmp_path / "all.h5") as whole:
            few = whole.read(whole.names.index("two"))
            assert (
                few.pose.shape == (1, 4, 4, 4)
                and (few.pose[0, :2] == 0.5).all()
                and (few.pose[0, 2:] == np.eye(4)).all()
            )
            assert (few.joint[0, :2] == 1).all() and few.joint[0, 2:].tolist() == [[-1.0, *[0.0] * 8]] * 2
            assert (whole.read(whole.names.index("four")).pose == 0.5).all()


def test_a_label_map_joins_unlike_classes(two, tmp_path):
    text = '[labels]\n"push" = "shove"\n"bend" = ""\n[files."b.h5"]\n"g1" = "shove"\n"g2" = "hand wave"\n'
    (tmp_path / "map.toml").write_text(text)
    content = {"labels": {"push": "shove", "bend": ""}, "files": {"b.h5": {"g1": "shove", "g2": "hand wave"}}}
    (tmp_path / "map.json").write_text(json.dumps(content))
    assert LabelMap.read(tmp_path / "map.toml") == LabelMap.read(tmp_path / "map.json")
    report = merge(two, tmp_path / "all.h5", labels=LabelMap.read(tmp_path / "map.toml"))
    assert joined(tmp_path / "all.h5") == {"a0": "hand wave", "a1": "shove", "b0": "shove", "b1": "hand wave"}
    assert ("a2", "class 'bend' is left out by the label map") in report.skipped
    (tmp_path / "order.toml").write_text('classes = ["shove", "hand wave"]\n' + text)
    merge(two, tmp_path / "ordered.h5", labels=LabelMap.read(tmp_path / "order.toml"))
    with CloudsReader(tmp_path / "ordered.h5") as reader:
        assert reader.class_names == ["shove", "hand wave"]
    assert joined(tmp_path / "ordered.h5") == joined(tmp_path / "all.h5")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[labels]\n"jump" = "leap"', "no file has a class 'jump'"),
        ('[files."c.h5"]\n"g1" = "push"', "no file 'c.h5' among a.h5, b.h5"),
        ('[files."b.h5"]\n"push" = "g1"', "b.h5 has no class 'push'"),
        ('classes = ["g1"]\n', "class 'hand wave' becomes 'hand wave', which classes"),
        ("[labels]\npush = 3\n", "something that is not a name"),
        ("labels = 3\n", "labels is 3, expected a table"),
        ("[label]\nx = 'y'\n", "holds label; expected classes"),
        ('classes = ["g1", "g1"]\n', "expected names, each once"),
        ("classes = [1, 2]\n", "expected names, each once"),
        ('classes = ["g1", ""]\n', "expected names, each once"),
        ("[labels\n", "not TOML"),
        ("", "holds nothing"),
    ],
)
def test_maps_that_fit_nothing_are_refused(two, tmp_path, text, message):
    (tmp_path / "map.toml").write_text(text)
    with pytest.raises(DataError, match=message):
        merge(two, tmp_path / "all.h5", labels=LabelMap.read(tmp_path / "map.toml"))
    assert not (tmp_path / "all.h5").exists()


def test_what_does_not_fit_is_refused(two, tmp_path):
    with pytest.raises(DataError, match="2 classes .*, other than the 3 of .*--labels"):
        merge(two, tmp_path / "all.h5")
    again = write(tmp_path / "c.h5", ["c0", "a1"], ["hand wave", "push", "bend"])
    with pytest.raises(DataError, match="sample 'a1' is in .*a.h5 as well.*--prefix"):
        merge([two[0], again], tmp_path / "all.h5")
    assert merge([two[0], again], tmp_path / "all.h5", prefix=True).written == 5
    assert {"a/a1", "c/a1"} < joined(tmp_path / "all.h5").keys()
    (tmp_path / "more").mkdir()
    same = write(tmp_path / "more" / "a.h5", ["a1"], ["hand wave", "push", "bend"])
    merge([two[0], again, same], tmp_path / "named.h5", prefix=True)
    assert {f"{tmp_path.name}/a1", "c/a1", "more/a1"} < joined(tmp_path / "named.h5").keys()
    (tmp_path / "other" / "more").mkdir(parents=True)
    (tmp_path / "other" / "more" / "a.h5").write_bytes(same.read_bytes())
    with pytest.raises(DataError, match="sample 'more/a1' is in .*files and folders of one name"):
        merge([tmp_path / "other" / "more" / "a.h5", same], tmp_path / "no.h5", prefix=True)
    meters = write(tmp_path / "mm.h5", ["m"], ["hand wave", "push", "bend"], length_unit="mm")
    with pytest.raises(DataError, match="its length unit is 'mm', of .*a.h5 it is 'm'"):
        merge([two[0], meters], tmp_path / "all.h5", force=True)
    with pytest.raises(UsageError, match="named twice"):
        merge([two[0], two[0]], tmp_path / "x.h5")
    with pytest.raises(UsageError, match="named twice"):
        merge(two, two[0], force=True)
    (tmp_path / "text.h5").write_text("no")
    with pytest.raises(DataError, match="not an HDF5 file"):
        merge([two[0], tmp_path / "text.h5"], tmp_path / "x.h5")


def test_a_label_map_knows_the_classes_of_all_files_of_one_name(tmp_path):
    sources = [(tmp_path / "one" / "train.h5", ["wave"]), (tmp_path / "two" / "train.h5", ["push"])]
    for labels in (LabelMap(labels={"wave": "hello"}), LabelMap(files={"train.h5": {"wave": "hello"}})):
        assert labels.resolve(sources) == (["hello", "push"], [[0], [1]])


def test_fields_that_not_all_have_are_left_out(tmp_path):
    paths = [
        write(tmp_path / "a.h5", ["a"], [], fields=["time", "track"]),
        write(tmp_path / "b.h5", ["b"], [], fields=["time"]),
    ]
    for order in (paths, paths[::-1]):
        merge(order, tmp_path / "all.h5", force=True)
        with CloudsReader(tmp_path / "all.h5") as reader:
            assert reader.fields == ("time",) and list(reader.labels) == [-1, -1]


def test_the_command(two, tmp_path):
    (tmp_path / "map.json").write_text(json.dumps({"labels": {"g1": "push"}}))
    done = dpc("prepare", "merge", *two, "-o", tmp_path / "all.h5", "--labels", tmp_path / "map.json")
    assert (
        done.returncode == 0 and done.stdout == f"{tmp_path / 'all.h5'}: 5 sequences, 5 frames, 14 points, 2 skipped\n"
    )
    refused = dpc("prepare", "merge", *two, "-o", tmp_path / "no.h5")
    assert refused.returncode == 3 and "--labels map.toml" in refused.stderr and not (tmp_path / "no.h5").exists()


SLOW = """
import sys, time
from pathlib import Path
from dpcli.prepare.commands.merge import merge
from dpcli.store import CloudsReader
read = CloudsReader.read
def slowly(self, index):
    time.sleep(0.05)
    return read(self, index)
CloudsReader.read = slowly
sys.argv = ["dpc", "prepare", "merge"]
merge([Path(word) for word in FILES], Path(OUT), prefix=True)
"""


@pytest.mark.parametrize("shards", [False, True])
def test_killed_and_run_again_it_ends_with_the_bytes_of_one_run(tmp_path, monkeypatch, shards):
    """kill -9 twice in the middle: each time what was copied stays, and only the rest is copied."""
    monkeypatch.setattr(sys, "argv", ["dpc", "prepare", "merge"])
    if shards:
        paths = [tmp_path / f"{k}.h5" for k in range(3)]
        for index, path in enumerate(paths):
            convert(ToyReader(count=24, bad=(3,)), path, Conversion(shard=Shard(index, 3)))
        script = SLOW.replace(", prefix=True", "")
    else:
        paths = [write(tmp_path / f"{k}.h5", [f"x{n}" for n in range(8)], ["p", "q"]) for k in range(3)]
        script = SLOW
    whole, out = tmp_path / "whole.h5", tmp_path / "out.h5"
    total = merge(paths, whole, prefix=not shards).written
    script = script.replace("FILES", repr([str(path) for path in paths])).replace("OUT", repr(str(out)))
    journal, kept = tmp_path / ".out.h5.part", 0
    for _ in range(2):
        process = subprocess.Popen([sys.executable, "-c", script], cwd=ROOT, stderr=subprocess.DEVNULL)
        deadline = time.monotonic() + 60
        while process.poll() is None and time.monotonic() < deadline:
            if journal.exists() and journal.stat().st_size > kept:
                break
            time.sleep(0.002)
        time.sleep(0.05)
        process.kill()
        process.wait(90)
        assert journal.stat().st_size > kept and not out.exists()
        kept = journal.stat().st_size
    read = []
    monkeypatch.setattr(CloudsReader, "read", counting(CloudsReader.read, read))
    report = merge(paths, out, prefix=not shards)
    assert report.written == total == (23 if shards else 24) and 0 < len(read) < total
    assert out.read_bytes() == whole.read_bytes()
    assert not journal.exists() and not (tmp_path / ".out.h5.new").exists()


def counting(read, calls: list):
    """CloudsReader.read that notes which samples are read whole; the closing line reads a few frames."""

    def noting(self, index, *frames, **fields):
        if not frames:
            calls.append((self.path, index))
        return read(self, index, *frames, **fields)

    return noting


def stopped_after(count: int, monkeypatch, *arguments, **options) -> None:
    """merge, ended by Ctrl-C before it reads sample `count`."""
    calls, read = [], CloudsReader.read

    def interrupted(self, index):
        if len(calls) == count:
            raise KeyboardInterrupt
        return counting(read, calls)(self, index)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(CloudsReader, "read", interrupted)
        merge(*arguments, **options)


def test_what_a_stopped_run_of_other_work_left(two, tmp_path, monkeypatch):
    """Other inputs: it stays, unless --force; a pipe leaves nothing; a conversion of the same name goes on, or stays."""
    out, journal = tmp_path / "all.h5", tmp_path / ".all.h5.part"
    again = write(tmp_path / "c.h5", ["c0", "c1"], ["hand wave", "push", "bend"])
    stopped_after(2, monkeypatch, [two[0], again], out)
    assert journal.exists()
    with pytest.raises(
        UsageError, match='with other settings or inputs .config.merge ."a.h5", "c.h5"., now .*; another file 1'
    ):
        merge([again, two[0]], out)
    assert journal.exists()
    merge([again, two[0]], out, force=True)
    assert list(joined(out)) == ["c0", "c1", "a0", "a1", "a2"] and not journal.exists()
    stopped_after(2, monkeypatch, [two[0], again], tmp_path / "pipe.h5", resume=False)
    assert not (tmp_path / ".pipe.h5.part").exists()

    paths = [tmp_path / f"shard{k}.h5" for k in range(2)]
    for index, path in enumerate(paths):
        convert(ToyReader(bad=(1,)), path, Conversion(shard=Shard(index, 2)))
    entry = shard_of(CloudsReader(paths[0]).provenance[-1])[1]
    for names, fine in ((["toy000"], True), (["toy000", "toy001"], False)):
        with pytest.raises(Stopped), CloudsWriter(tmp_path / "x.h5", provenance=entry, resume=True) as writer:
            for name in names:
                writer.write(CloudSequence.from_frames(name, [np.ones((1, 3), np.float32)]))
            raise Stopped("now")
        if fine:
            assert merge(paths, tmp_path / "x.h5").written == 4
            (tmp_path / "x.h5").unlink()
        else:
            with pytest.raises(UsageError, match="a stopped run left 2 other samples"):
                merge(paths, tmp_path / "x.h5")
            assert (tmp_path / ".x.h5.part").exists()
            assert merge(paths, tmp_path / "x.h5", force=True).written == 4


def test_a_signal_stops_it_politely(two, tmp_path, monkeypatch):
    read = CloudsReader.read

    def signaled(self, index):
        if index == 1:
            os.kill(os.getpid(), signal.SIGTERM)
        return read(self, index)

    with monkeypatch.context() as patch, pytest.raises(Stopped, match="SIGTERM; 2 of 3 samples are kept"):
        patch.setattr(CloudsReader, "read", signaled)
        merge(two[:1], tmp_path / "all.h5")
    assert merge(two[:1], tmp_path / "all.h5").written == 3
