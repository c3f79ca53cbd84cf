"""The clouds contract: what is written comes back; what is malformed is refused; a file that exists is complete."""

from __future__ import annotations

import multiprocessing
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dpcli.errors import DataError, DpcError, Stopped, UsageError
from dpcli.runtime.provenance import file_digest
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter, PartsReader, ScoresReader, file_kind
from tests.support.hdf5_edits import edit, replacing


def write(path: Path, sequences: list[CloudSequence], **options) -> Path:
    with CloudsWriter(path, class_names=["a", "b", "c"], **options) as writer:
        for sequence in sequences:
            writer.write(sequence)
    return path


@pytest.fixture
def three(make_sequence) -> list[CloudSequence]:
    return [make_sequence(f"s{i}", seed=i, frames=4 + i, label=i, split="train", subject=i) for i in range(3)]


def test_round_trip_of_every_field(tmp_path, make_sequence):
    rng = np.random.default_rng(0)
    sequence = make_sequence("x", label=2, split="test", subject=7, camera=1, time=np.arange(5) / 30)
    count = len(sequence.points)
    sequence.color = rng.integers(0, 255, (count, 3), np.uint8)
    sequence.part, sequence.track = rng.integers(0, 4, count).astype(np.int16), np.arange(count)
    sequence.pose = rng.normal(size=(5, 4, 4, 4))
    path = write(tmp_path / "a.h5", [sequence], fields=["time", "color", "part", "track", "pose"], length_unit="m")
    back = CloudsReader(path).read(0)
    for field in ("points", "frame_offsets", "time", "color", "part", "track", "pose"):
        assert np.array_equal(getattr(back, field), getattr(sequence, field)), field
    assert (back.name, back.label, back.split, back.subject, back.camera) == ("x", 2, "test", 7, 1)


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    sizes=st.lists(st.lists(st.integers(0, 6), min_size=1, max_size=5).filter(any), min_size=1, max_size=4),
    data=st.data(),
)
def test_any_frames_of_any_ragged_file(tmp_path, sizes, data):
    rng = np.random.default_rng(1)
    clouds = [[rng.normal(size=(n, 3)).astype(np.float32) for n in frames] for frames in sizes]
    path = tmp_path / "ragged.h5"
    write(path, [CloudSequence.from_frames(f"n{i}", frames) for i, frames in enumerate(clouds)], force=True)
    reader = CloudsReader(path)
    index = data.draw(st.integers(0, len(clouds) - 1))
    picks = data.draw(st.lists(st.integers(0, len(clouds[index]) - 1), min_size=1, max_size=6))
    part = reader.read(index, picks)
    assert part.num_frames == len(picks)
    for t, pick in enumerate(picks):
        assert np.array_equal(part.frame(t), clouds[index][pick])
    assert reader.point_counts.tolist() == [sum(map(len, frames)) for frames in clouds]


def test_reads_only_the_frames_asked_for(tmp_path, three, monkeypatch):
    reader = CloudsReader(write(tmp_path / "a.h5", three))
    touched = []
    original = h5py.Dataset.__getitem__
    monkeypatch.setattr(
        h5py.Dataset, "__getitem__", lambda self, key, **k: touched.append((self.name, key)) or original(self, key, **k)
    )
    reader.read(1, slice(1, 3))
    spans = [key for name, key in touched if name == "/points"]
    first = int(reader._frame_offsets[reader._sequence_offsets[1] + 1])
    assert spans == [slice(first, first + len(three[1].frame(1)) + len(three[1].frame(2)))]


def test_equal_work_gives_equal_bytes(tmp_path, three):
    assert file_digest(write(tmp_path / "a.h5", three)) == file_digest(write(tmp_path / "b.h5", three))


def test_stopped_part_continues_to_identical_bytes(tmp_path, three):
    options = {"provenance": {"command": "x", "config": {"k": 1}}, "resume": True}
    whole = write(tmp_path / "whole.h5", three, **options)
    path = tmp_path / "stopped.h5"
    with pytest.raises(Stopped), CloudsWriter(path, class_names=["a", "b", "c"], **options) as writer:
        writer.write(three[0])
        raise Stopped("now")
    assert not path.exists()
    with CloudsWriter(path, class_names=["a", "b", "c"], **options) as writer:
        assert writer.written_names == ["s0"]
        for sequence in three[1:]:
            writer.write(sequence)
    assert file_digest(path) == file_digest(whole)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["stopped.h5", "whole.h5"]


def test_part_of_another_configuration_stays_and_force_starts_over(tmp_path, three):
    path = tmp_path / "a.h5"
    with pytest.raises(Stopped), CloudsWriter(path, provenance={"config": 1}, resume=True) as writer:
        writer.write(three[0])
        raise Stopped("now")
    with pytest.raises(UsageError, match="with other settings or inputs .config 1, now 2"):
        CloudsWriter(path, provenance={"config": 2}, resume=True)
    assert (tmp_path / ".a.h5.part").exists() and (tmp_path / ".a.h5.new").exists()
    with CloudsWriter(path, provenance={"config": 2}, resume=True, force=True) as writer:
        assert writer.written_names == []
        writer.write(three[1])
    assert CloudsReader(path).names == ["s1"]


def test_an_error_leaves_nothing_behind(tmp_path, three):
    with pytest.raises(ZeroDivisionError), CloudsWriter(tmp_path / "a.h5") as writer:
        writer.write(three[0])
        raise ZeroDivisionError
    with pytest.raises(DataError, match="not one good sample"), CloudsWriter(tmp_path / "a.h5"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_existing_file_is_kept_without_force(tmp_path, three):
    path = write(tmp_path / "a.h5", three)
    before = file_digest(path)
    with pytest.raises(UsageError, match="--force"):
        write(path, three[:1])
    assert file_digest(path) == before


def _bad(sequence: CloudSequence, **changes) -> CloudSequence:
    for key, value in changes.items():
        setattr(sequence, key, value)
    return sequence


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: _bad(s, points=np.full_like(s.points, 3e37)), r"a number beyond 1e\+12"),
        (lambda s: _bad(s, points=np.full_like(s.points, np.nan)), "NaN or infinite"),
        (lambda s: _bad(s, label=3), "out of range; expected -1 .unknown. or 0..2"),
        (lambda s: _bad(s, subject=-2), "subject -2, expected -1 .unknown. or 0 to"),
        (lambda s: _bad(s, camera=2**40), "camera 1099511627776, expected -1"),
        (lambda s: _bad(s, frame_offsets=s.frame_offsets[::-1]), "frame_offsets must rise"),
        (lambda s: _bad(s, points=s.points[:, :2]), "expected .points, 3"),
        (lambda s: _bad(s, part=np.zeros(1, np.int16)), "part is int16"),
        (lambda s: _bad(s, name=""), "no name"),
        (lambda s: _bad(s, name="s1"), "appears twice"),
        (lambda s: CloudSequence.from_frames("e", [np.zeros((0, 3))]), "no frames or no points"),
    ],
)
def test_malformed_samples_are_refused(tmp_path, three, make_sequence, change, message):
    with pytest.raises(DataError, match=message):
        write(tmp_path / "a.h5", [three[1], change(make_sequence("new"))])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "key, values, said",
    [
        ("part", [0, 65537], "part holds 0 to 65537, expected -32768 to 32767 .int16."),
        ("part", [0.0, np.nan], "part holds nan to nan"),
        ("color", [[0, 0, 256]] * 2, "color holds 0 to 256, expected 0 to 255 .uint8."),
        ("track", np.uint64([0, 2**63]), "track holds 0 to 9.22337e.18"),
    ],
)
def test_numbers_that_a_field_cannot_hold_are_refused(key, values, said):
    with pytest.raises(DataError, match=said):
        CloudSequence.from_frames("a", [np.zeros((2, 3))], **{key: [np.array(values)]})


def test_a_label_below_the_unknown_one_is_refused_without_classes(three):
    with pytest.raises(DataError, match=r"label -2 is out of range; expected -1 .unknown. or 0, 1, \.\.\.$"):
        _bad(three[0], label=-2).validate()


def test_reader_crosses_process_borders(tmp_path, three):
    reader = CloudsReader(write(tmp_path / "a.h5", three))
    reader.read(0)
    copy = pickle.loads(pickle.dumps(reader))
    assert copy._file is None and np.array_equal(copy.read(2).points, three[2].points)


def test_handles_are_kept_closed_and_opened_again(tmp_path, three):
    """Each data set is looked up once; a closed reader opens itself again, at whatever file has that name by then."""
    path = write(tmp_path / "a.h5", three)
    with CloudsReader(path) as reader:
        reader.read(0)
        kept = reader._set("points")
        reader.read(1)
        assert reader._set("points") is kept and kept.id.valid
        assert pickle.loads(pickle.dumps(reader))._sets == {}
        reader.close()
        assert not kept.id.valid and np.array_equal(reader.read(2).points, three[2].points)
        moved = [replace(sequence, points=sequence.points + 1) for sequence in three]
        write(tmp_path / "b.h5", moved).replace(path)
        assert np.array_equal(reader.read(1).points, three[1].points)  # what was opened
        reader.close()
        assert np.array_equal(reader.read(1).points, moved[1].points)
        reader.file.close()  # by someone else
        assert np.array_equal(reader.read(0).points, moved[0].points)


def test_a_forked_process_opens_its_own(tmp_path, three):
    reader = CloudsReader(write(tmp_path / "a.h5", three))
    reader.read(0)
    handle = reader.file

    def child(pipe) -> None:
        sums = [float(reader.read(index).points.sum()) for index in range(3)]
        pipe.send((sums, reader.file is handle))
        reader.close()

    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe()
    process = context.Process(target=child, args=(theirs,))
    process.start()
    assert ours.poll(60) and ours.recv() == ([float(s.points.sum()) for s in three], False)
    process.join(60)
    assert process.exitcode == 0 and reader.file is handle
    assert np.array_equal(reader.read(2).points, three[2].points)


def test_several_workers_read_what_one_reads(tmp_path, three):
    """As a DataLoader's do, but for the import of torch in each."""
    reader = CloudsReader(write(tmp_path / "a.h5", three))
    reader.read(0)  # an open handle in the parent must not leak into the workers
    pool = multiprocessing.get_context("forkserver").Pool(2)
    found = pool.map(reader.read, range(3), chunksize=1)
    pool.close()  # not terminate: workers of the server that another test may have started let no SIGTERM through
    pool.join()
    assert [np.array_equal(a.points, b.points) for a, b in zip(found, three, strict=True)] == [True] * 3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: f.attrs.update(dpc_kind="scores"), "holds 'scores', expected 'clouds'"),
        (lambda f: f.attrs.update(dpc_schema=9), "schema 9"),
        (lambda f: f.attrs.__delitem__("dpc_kind"), "not one of dpc's"),
        (replacing("frame_offsets", np.array([0, 5, 3])), "start at 0 and never fall"),
        (replacing("sequence_offsets", np.array([0, 99])), "99"),
        (replacing("label", np.array([0, 1, 5], np.int32)), "label 5 of 's2', but 3 classes"),
        (lambda f: f.__delitem__("points"), "'points' is missing"),
        (replacing("points", h5py.ExternalLink("other.h5", "/points")), "link to elsewhere"),
        (replacing("points", h5py.SoftLink("/label")), "link to elsewhere"),
    ],
)
def test_files_that_break_the_contract_are_refused(tmp_path, three, change, message):
    path = write(tmp_path / "a.h5", three)
    CloudsReader(path).close()
    edit(path, change)
    with pytest.raises(DataError, match=message):
        CloudsReader(path)


def test_virtual_and_external_data_are_refused(tmp_path, three):
    path = write(tmp_path / "a.h5", three)

    def virtual(file):
        layout = h5py.VirtualLayout((5, 3), np.float32)
        layout[:] = h5py.VirtualSource("secret.h5", "points", (5, 3))
        del file["points"]
        file.create_virtual_dataset("points", layout)

    edit(path, virtual)
    with pytest.raises(DataError, match="keeps its data in another file"):
        CloudsReader(path)


@pytest.mark.parametrize("keep", [0, 4, 100, 0.5, 0.95])
def test_truncated_files_are_refused(tmp_path, three, keep):
    path = write(tmp_path / "a.h5", three)
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data)) if isinstance(keep, float) else keep])
    with pytest.raises(DataError, match="truncated|empty|not an HDF5"):
        CloudsReader(path)


def test_nan_in_a_file_is_found_when_read(tmp_path, three):
    path = write(tmp_path / "a.h5", three)

    for value in (np.nan, np.inf, -5.9e37):  # of the last, squares are infinite

        def poison(file, value=value):
            file["points"][3, 1] = value

        edit(path, poison)
        with pytest.raises(DataError, match="coordinates of NaN, infinity or a number beyond"):
            CloudsReader(path).read(0)
    CloudsReader(path).read(1)


def test_kind_is_told_and_text_is_not_hdf5(tmp_path, three):
    assert file_kind(write(tmp_path / "a.h5", three)) == "clouds"
    (tmp_path / "b.h5").write_text("name,label\n")
    with pytest.raises(DataError, match="not an HDF5 file"):
        file_kind(tmp_path / "b.h5")
    for reader, advice in (
        (ScoresReader, "ScoresWriter"),
        (PartsReader, "PartsWriter"),
        (CloudsReader, "`dpc prepare`"),
    ):
        with pytest.raises(DataError, match=advice):
            reader(tmp_path / "b.h5")
    with pytest.raises(DataError, match="a folder"):
        file_kind(tmp_path)


def test_a_full_disk_is_said_in_words_and_leaves_nothing(tmp_path):
    """A limit on the file's size stands for a full disk: the same write fails in the same place."""
    code = f"""
import resource, signal, numpy as np
from dpcli.store import CloudSequence, CloudsWriter
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
with CloudsWriter({str(tmp_path / "a.h5")!r}) as writer:
    for i in range(50):
        writer.write(CloudSequence.from_frames(f"s{{i}}", [np.ones((5000, 3), np.float32)]))
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert run.returncode != 0 and "DiskFull" in run.stderr and "file size limit" in run.stderr
    assert list(tmp_path.iterdir()) == []


def test_memory_does_not_grow_with_samples(tmp_path):
    code = """
import resource, sys, numpy as np
from dpcli.store import CloudSequence, CloudsWriter
with CloudsWriter(sys.argv[1]) as writer:
    for i in range(int(sys.argv[2])):
        writer.write(CloudSequence.from_frames(f"s{i}", [np.ones((20000, 3), np.float32)] * 2))
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""
    peaks = []
    for count in (10, 160):  # 4.8 MB and 77 MB of points
        run = subprocess.run(
            [sys.executable, "-c", code, str(tmp_path / f"{count}.h5"), str(count)], capture_output=True, text=True
        )
        peaks.append(int(run.stdout) / 1024)
    assert peaks[1] - peaks[0] < 12, peaks


def test_a_folder_tells_of_its_files(tmp_path):
    for names, said in (
        ((), "`dpc prepare` turns"),
        (("b.h5", "a.h5", "x.txt"), r"holds a.h5, b.h5: name one, or all .*\*.h5"),
    ):
        for name in names:
            (tmp_path / name).touch()
        for opened in (lambda: CloudsReader(tmp_path), lambda: file_digest(tmp_path)):
            with pytest.raises(DataError, match=f"a folder, expected an HDF5 file; .*{said}"):
                opened()


def test_missing_folder_is_said(tmp_path):
    with pytest.raises(DpcError, match="does not exist"):
        CloudsWriter(tmp_path / "no" / "a.h5")


def test_class_names_may_be_missing_where_no_sample_has_a_label(tmp_path):
    sequence = CloudSequence.from_frames("a", [np.ones((3, 3))])
    for label in (-1, 0):
        path = tmp_path / f"{label}.h5"
        sequence.label = label
        with CloudsWriter(path) as writer:
            writer.write(sequence)
        with h5py.File(path, "a") as file:
            del file["class_names"]
    assert CloudsReader(tmp_path / "-1.h5").class_names == []
    with pytest.raises(DataError, match="class_names' is missing, though samples have labels"):
        CloudsReader(tmp_path / "0.h5")
