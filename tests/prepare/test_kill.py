"""A conversion killed at any moment: nothing but the sample in hand is lost, and the end is the same bytes."""

from __future__ import annotations

import contextlib
import itertools
import shutil
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dpcli.errors import DpcError, Stopped, UsageError
from dpcli.prepare import pipeline
from dpcli.prepare.pipeline import Conversion, convert, convert_item
from dpcli.runtime import pool
from dpcli.runtime.provenance import file_digest
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter
from dpcli.store import clouds_writer as writer_module
from dpcli.store.writing import item_pass
from dpcli.store.writing.journal import Journal
from tests.support.prepare_helpers import DPC, ROOT, ToyReader, dpc
from tests.support.sessions import members

SYNTHETIC = ("prepare", "synthetic", "gestures", "--frames", "8", "--size", "64", "--videos-per-class", "6")
ABOUT = {"kind": "clouds", "provenance": [{"config": 1}]}


def sequence(number: int) -> CloudSequence:
    rng = np.random.default_rng(number)
    frames = [rng.normal(size=(int(n), 3)).astype(np.float32) for n in rng.integers(0, 9, 3) + [1, 0, 0]]
    track = [np.arange(len(frame)) for frame in frames]
    return CloudSequence.from_frames(f"s{number} é", frames, label=number % 2, time=np.arange(3.0), track=track)


def options(config: int = 1) -> dict:
    return {"class_names": ["a", "b"], "fields": ["track", "time"], "resume": True, "provenance": {"config": config}}


@pytest.fixture(autouse=True, scope="module")
def small_chunks():
    """So that samples of a few points span several chunks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer_module, "POINTS_PER_CHUNK", 4)
        yield


@pytest.fixture(scope="module")
def killed(small_chunks, tmp_path_factory) -> tuple[bytes, list[int], bytes, str]:
    """The journal of five samples, where each of them ends in it, the unfinished HDF5, and the whole file's digest."""
    folder = tmp_path_factory.mktemp("kill")
    ends, journal = [], folder / ".a.h5.part"
    with pytest.raises(Stopped), CloudsWriter(folder / "a.h5", **options()) as writer:
        for number in range(5):
            ends.append(journal.stat().st_size)
            writer.write(sequence(number))
        ends.append(journal.stat().st_size)
        unfinished = (folder / ".a.h5.new").read_bytes()  # as a kill leaves it: HDF5 has written nothing else yet
        raise Stopped("now")
    content = journal.read_bytes()
    with CloudsWriter(folder / "whole.h5", **options()) as writer:
        for number in range(5):
            writer.write(sequence(number))
    return content, ends, unfinished, file_digest(folder / "whole.h5")


@settings(max_examples=80, deadline=None)
@given(data=st.data())
def test_a_journal_cut_anywhere_or_damaged_gives_the_samples_before(killed, tmp_path_factory, data):
    """Every state that a kill or a lost block can leave."""
    content, ends, unfinished, whole = killed
    folder = tmp_path_factory.mktemp("cut")
    cut = data.draw(st.one_of(st.sampled_from(ends), st.integers(0, len(content))))
    left = bytearray(content[:cut])
    sound = cut
    if data.draw(st.booleans()) and cut:
        sound = data.draw(st.integers(0, cut - 1))
        left[sound] ^= data.draw(st.integers(1, 255))
    (folder / ".a.h5.part").write_bytes(left)
    (folder / ".a.h5.new").write_bytes(unfinished)
    (folder / ".a.h5.alt").write_bytes(data.draw(st.sampled_from([b"", b"\x89HDF\r\n\x1a\n", b"x" * 5000])))
    (folder / ".a.h5.part.new").write_bytes(data.draw(st.sampled_from([b"", content[: cut // 2]])))
    go_on(folder, max([0, *(k for k, end in enumerate(ends) if end <= sound)]))
    assert file_digest(folder / "a.h5") == whole
    assert [path.name for path in folder.iterdir()] == ["a.h5"]


def go_on(folder: Path, expected: int) -> None:
    with CloudsWriter(folder / "a.h5", **options()) as writer:
        assert writer.written_names == [sequence(k).name for k in range(expected)]
        for number in range(expected, 5):
            writer.write(sequence(number))


@pytest.mark.parametrize("number", [1, 3])
@pytest.mark.parametrize("damage", ["changed", "cut", "gone"])
def test_points_that_are_not_in_the_unfinished_file_are_not_taken(killed, tmp_path, number, damage):
    """Blocks that never came to the disk: the samples before are kept, where there are any."""
    content, _, unfinished, whole = killed
    (tmp_path / ".a.h5.part").write_bytes(content)
    at = unfinished.index(chunk_of(number))
    if damage == "changed":
        (tmp_path / ".a.h5.new").write_bytes(
            unfinished[: at + 5] + bytes([unfinished[at + 5] ^ 1]) + unfinished[at + 6 :]
        )
    elif damage == "cut":
        (tmp_path / ".a.h5.new").write_bytes(unfinished[: at + 5])
    go_on(tmp_path, number if damage != "gone" else first_placed())
    assert file_digest(tmp_path / "a.h5") == whole
    assert [path.name for path in tmp_path.iterdir()] == ["a.h5"]


def chunk_of(number: int) -> bytes:
    """Of the first whole chunk that ends in a sample, the last bytes."""
    ends = np.cumsum([len(sequence(k).points) for k in range(5)])
    start = ends[number] - len(sequence(number).points)
    end = (start // 4 + 1) * 4
    assert end <= ends[number]
    return sequence(number).points[: end - start].tobytes()


def first_placed() -> int:
    """The first sample with a whole chunk: it is the first that points into the HDF5 file."""
    return int(np.argmax(np.cumsum([len(sequence(k).points) for k in range(5)]) >= 4))


@pytest.mark.parametrize("reached", [0, 2, 3, 4])
def test_a_kill_while_going_on_loses_nothing(killed, tmp_path, monkeypatch, reached):
    """What an earlier run left stays until the new file holds all of it, whichever of the two names it has."""
    content, ends, unfinished, whole = killed
    folder, left = tmp_path / "a", tmp_path / "left"
    folder.mkdir()
    (folder / ".a.h5.part").write_bytes(content[: ends[4]])
    (folder / ".a.h5.new").write_bytes(unfinished)
    note, count = CloudsWriter._note, itertools.count()

    def killed_there(self, *given):
        if next(count) == reached:
            shutil.copytree(folder, left)
            raise Stopped("here")
        note(self, *given)

    with monkeypatch.context() as patch, pytest.raises(Stopped, match="here"):
        patch.setattr(CloudsWriter, "_note", killed_there)
        with CloudsWriter(folder / "a.h5", **options()) as writer:
            writer.write(sequence(4))
    for place in (folder, left):
        for stop in (True, False):  # stopped: the file of the other name is the one to go on with
            with contextlib.suppress(Stopped), CloudsWriter(place / "a.h5", **options()) as writer:
                assert len(writer.written_names) == 4
                if stop:
                    raise Stopped("now")
                writer.write(sequence(4))
        assert file_digest(place / "a.h5") == whole
        assert [path.name for path in place.iterdir()] == ["a.h5"]


def test_a_journal_of_another_version_starts_over(killed, tmp_path):
    (tmp_path / ".a.h5.part").write_bytes(killed[0].replace(b"dpc journal 3", b"dpc journal 2", 1))
    (tmp_path / ".a.h5.new").write_bytes(killed[2])
    go_on(tmp_path, 0)
    assert file_digest(tmp_path / "a.h5") == killed[3]


def test_a_journal_gives_back_what_went_in(tmp_path):
    given_values = [sequence(3), np.arange(6.0).reshape(2, 3)[:, ::2], [np.zeros((0, 3), np.float32)], "x", 4, None]
    data = tmp_path / ".j.new"
    data.write_bytes(b"123" + given_values[0].points.tobytes())
    placed = (given_values[0].points, [(3, 12), (15, 4)])  # the rest goes to the journal
    journal = Journal(tmp_path / ".j.part", ABOUT)
    assert journal.data_name == ""
    with data.open("r+b") as file:
        journal.begin(data, file.fileno())
    journal.append(given_values, placed)
    journal.keep()
    journal = Journal(tmp_path / ".j.part", ABOUT)
    assert journal.data_name == data.name
    (back,) = journal.samples()
    for key, value in vars(given_values[0]).items():
        np.testing.assert_array_equal(getattr(back[0], key), value)
    np.testing.assert_array_equal(back[1], given_values[1])
    assert back[2][0].shape == (0, 3) and back[2][0].dtype == np.float32 and back[3:] == given_values[3:]
    journal.discard()
    assert list(tmp_path.iterdir()) == []


def test_of_two_writers_of_one_file_the_second_is_refused(tmp_path):
    with CloudsWriter(tmp_path / "a.h5", **options()) as writer:
        writer.write(sequence(0))
        with pytest.raises(DpcError, match=r"^\S+/a\.h5: cannot write \(another dpc is writing it"):
            CloudsWriter(tmp_path / "a.h5", **options())
        writer.write(sequence(1))
    with CloudsReader(tmp_path / "a.h5") as reader:
        assert len(reader) == 2


def test_a_journal_of_other_work_stays_and_force_starts_over(killed, tmp_path):
    left = {".a.h5.part": killed[0], ".a.h5.new": killed[2]}
    for name, content in left.items():
        (tmp_path / name).write_bytes(content)
    with pytest.raises(UsageError, match="stopped run with other settings or inputs .config .*, now 2.*--force"):
        CloudsWriter(tmp_path / "a.h5", **{**options(), "provenance": {"config": 2}})
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == left
    with CloudsWriter(tmp_path / "a.h5", **{**options(), "force": True}) as writer:
        assert writer.written_names == []
        writer.write(sequence(0))
    assert [path.name for path in tmp_path.iterdir()] == ["a.h5"]


def test_a_command_spelled_otherwise_goes_on_and_another_one_is_refused(tmp_path, monkeypatch):
    """As `dpc` is called with another --on-error, or RAW/ instead of RAW."""

    def run(words: list[str], **more):
        monkeypatch.setattr("sys.argv", ["dpc", "prepare", *words])
        return convert(ToyReader(), tmp_path / "a.h5", Conversion(**more))

    with monkeypatch.context() as patch, pytest.raises(DpcError, match="died"):
        patch.setattr(item_pass, "ordered_map", dies_after_three)
        run(["toy", "RAW"])
    kept = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(UsageError, match="with other settings or inputs .config.points 0, now 1; config.sampling"):
        run(["toy", "RAW", "--points", "1"], points=1)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == kept
    read = []
    monkeypatch.setattr(pipeline, "convert_item", lambda *a, **k: read.append(a[-1][0]) or convert_item(*a, **k))
    run(["toy", "RAW/", "--on-error", "stop"], on_error="stop")
    assert read == [3, 4]


def test_what_a_kill_after_the_renaming_left_is_swept(tmp_path):
    convert(ToyReader(), tmp_path / "a.h5")
    (tmp_path / ".a.h5.part").write_bytes(b"rest")
    assert convert(ToyReader(), tmp_path / "a.h5").was_complete
    assert [path.name for path in tmp_path.iterdir()] == ["a.h5"]


def dies_after_three(work, items, jobs, executor, apart):
    for number, result in enumerate(pool.ordered_map(work, items, jobs, executor, apart)):
        if number == 3:
            raise DpcError("a worker process died")
        yield result


def test_a_lost_worker_keeps_what_is_done(tmp_path, monkeypatch):
    whole = convert(ToyReader(), tmp_path / "whole.h5")

    with monkeypatch.context() as patch, pytest.raises(DpcError, match="died"):
        patch.setattr(item_pass, "ordered_map", dies_after_three)
        convert(ToyReader(), tmp_path / "a.h5")
    read = []
    monkeypatch.setattr(pipeline, "convert_item", lambda *a, **k: read.append(a[-1][0]) or convert_item(*a, **k))
    assert convert(ToyReader(), tmp_path / "a.h5").written == whole.written
    assert read == [3, 4] and file_digest(tmp_path / "a.h5") == file_digest(tmp_path / "whole.h5")


def test_kill_minus_nine_at_random_moments(tmp_path):
    """The same command again and again, killed each time a little later, ends with the bytes of one whole run."""
    out, rng = tmp_path / "out.h5", np.random.default_rng(5)
    assert dpc(*SYNTHETIC, "-o", tmp_path / "whole.h5", "--jobs", "2").returncode == 0
    journal, kept = tmp_path / ".out.h5.part", 0
    for _ in range(4):
        process = subprocess.Popen(
            [*DPC, *SYNTHETIC, "-o", str(out), "--jobs", "2"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            cwd=ROOT,
            start_new_session=True,
        )
        deadline = time.monotonic() + 60
        while process.poll() is None and time.monotonic() < deadline:
            if journal.exists() and journal.stat().st_size > kept:
                break
            time.sleep(0.002)
        time.sleep(rng.uniform(0, 0.15))
        process.kill()  # nothing where it has ended already
        process.wait(90)
        size = journal.stat().st_size if journal.exists() else 0
        assert out.exists() or size >= kept  # what an earlier run had is still there
        kept = size
        while members(process.pid) and time.monotonic() < deadline:
            time.sleep(0.02)
        assert not members(process.pid)
    last = dpc(*SYNTHETIC, "-o", out, "--jobs", "2")
    assert last.returncode == 0 and ("continuing: " in last.stderr or "already complete" in last.stderr), last.stderr
    assert file_digest(out) == file_digest(tmp_path / "whole.h5")
    assert {path.name for path in tmp_path.iterdir()} == {"out.h5", "whole.h5"}
