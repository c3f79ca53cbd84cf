"""The pipeline: thinning, order and bytes whatever the jobs, skipping, continuing, and refusing to mix."""

from __future__ import annotations

import errno
import os
import pickle
import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from dpcli.errors import DataError, DpcError, Stopped, UsageError
from dpcli.prepare import pipeline
from dpcli.prepare.actions.depth import DepthVideos
from dpcli.prepare.actions.msraction3d import MSRAction3D
from dpcli.prepare.pipeline import Conversion, convert, convert_item
from dpcli.prepare.reader import drop_empty_frames, natural_key
from dpcli.prepare.scans.clouds import CloudFolders
from dpcli.prepare.scans.recorded_clouds import RecordedClouds
from dpcli.prepare.scans.tables import TableSequences
from dpcli.prepare.thinning import Thinning, voxel_representatives
from dpcli.runtime.provenance import file_digest
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter
from tests.support.prepare_helpers import ToyReader, write_msr


def toy_sequence(counts: list[int]) -> CloudSequence:
    rng = np.random.default_rng(0)
    frames = [rng.normal(size=(n, 3)).astype(np.float32) for n in counts]
    tracks = [np.arange(n, dtype=np.int64) + 1000 * t for t, n in enumerate(counts)]
    return CloudSequence.from_frames("toy", frames, track=tracks)


@pytest.mark.parametrize("sampling", ["random", "fps", "voxel"])
def test_thinning_keeps_distinct_points_with_their_fields(sampling):
    before = toy_sequence([100, 7, 31])
    after = Thinning(30, sampling).apply(toy_sequence([100, 7, 31]), np.random.default_rng(0))
    assert np.diff(after.frame_offsets).tolist() == [30, 7, 30]
    for t in range(3):
        a, b = after.frame_offsets[t : t + 2]
        chosen = after.track[a:b] - 1000 * t
        assert len(set(chosen)) == b - a
        np.testing.assert_array_equal(after.points[a:b], before.frame(t)[chosen])


def test_fps_thinning_is_farthest_point_sampling():
    cloud = toy_sequence([200]).points
    chosen = Thinning(20, "fps").choose(cloud, np.random.default_rng(0))
    distances = cdist(cloud, cloud)
    for k in range(1, 20):
        nearest = distances[:, chosen[:k]].min(1)
        assert nearest[chosen[k]] == pytest.approx(nearest.max(), rel=1e-5)


@given(st.integers(0, 2**32 - 1), st.integers(1, 60))
def test_voxel_representatives_spread_and_suffice(seed, points):
    rng = np.random.default_rng(seed)
    cloud = rng.normal(size=(60, 3)).astype(np.float32) * rng.choice([1, 0.01, 0], 3)
    chosen = voxel_representatives(cloud, points)
    assert points <= len(chosen) <= 60 and (np.diff(chosen) > 0).all()


def test_voxel_thinning_evens_out_the_density():
    rng = np.random.default_rng(0)
    dense, sparse = rng.uniform(0, 1, (5000, 3)), rng.uniform(0, 1, (500, 3)) + [2, 0, 0]
    cloud = np.concatenate([dense, sparse]).astype(np.float32)
    share = {}
    for sampling in ("voxel", "random"):
        chosen = Thinning(200, sampling).choose(cloud, np.random.default_rng(0))
        share[sampling] = np.mean(chosen >= 5000)
    assert share["voxel"] > 0.35 and share["random"] < 0.15


@pytest.mark.parametrize(("points", "sampling"), [(-1, "random"), (5, "best")])
def test_impossible_thinning(points, sampling):
    with pytest.raises(UsageError):
        Thinning(points, sampling)


def test_bytes_do_not_depend_on_the_number_of_jobs(tmp_path):
    raw = write_msr(tmp_path / "raw", [f"a{a:02}_s0{s}_e01" for a in range(1, 5) for s in (1, 6)])
    (raw / "a05_s01_e01_sdepth.bin").write_bytes(b"broken")
    for jobs in (1, 2):
        report = convert(MSRAction3D(raw), tmp_path / f"{jobs}.h5", Conversion(jobs=jobs, points=10, seed=5))
        assert (report.written, len(report.skipped)) == (8, 1)
    assert file_digest(tmp_path / "1.h5") == file_digest(tmp_path / "2.h5")
    convert(MSRAction3D(raw), tmp_path / "other.h5", Conversion(points=10, seed=6))
    assert file_digest(tmp_path / "other.h5") != file_digest(tmp_path / "1.h5")


def _write_inputs(folder: Path, suffix: str, count: int) -> Path:
    for number in range(count):
        path = folder / f"c{number % 2}" / f"video{number:03}"
        path.parent.mkdir(parents=True, exist_ok=True)
        if suffix == "frames":
            path.mkdir()
            np.save(path / "0.npy", np.ones((4, 3), np.float32))
        elif suffix == ".npy":
            np.save(path.with_suffix(suffix), np.ones((2, 4, 5), np.uint16))
        else:  # recordings that can't be opened are items, too
            path.with_suffix(suffix).write_text("frame,x,y,z\n0,0,0,0\n0,1,1,1\n1,1,1,1\n1,2,2,2\n")
    return folder


@pytest.mark.parametrize(
    ("suffix", "make"),
    [
        ("frames", lambda raw: CloudFolders(raw, label_from_folder=True)),
        (".csv", lambda raw: TableSequences(raw, label_from_folder=True)),
        (".mcap", lambda raw: RecordedClouds(raw, label_from_folder=True)),
        (".npy", lambda raw: DepthVideos(inputs=(raw,), label_from_folder=True)),
        (".npy", lambda raw: DepthVideos(inputs=tuple(sorted(raw.rglob("*.npy"))))),
    ],
)
def test_what_goes_to_a_worker_with_an_item_does_not_grow_with_their_number(suffix, make, tmp_path, monkeypatch):
    sent = []

    def keep(taken, work, load, *_):
        sent.append(len(pickle.dumps((work, load(1)))))
        raise Stopped("seen")

    monkeypatch.setattr(pipeline.ItemPass, "run", keep)
    for count in (3, 40):
        reader = make(_write_inputs(tmp_path / f"{count:02}", suffix, count))
        with pytest.raises(Stopped):
            convert(reader, tmp_path / f"{count}.h5")
    assert sent[0] == sent[1]


def test_the_file_holds_the_items_in_order(tmp_path):
    convert(ToyReader(), tmp_path / "a.h5")
    with CloudsReader(tmp_path / "a.h5") as reader:
        assert list(reader.names) == [f"toy{k:03}" for k in range(5)]
        assert list(reader.labels) == [0, 1, 0, 1, 0]
        expected = convert_item(ToyReader(), Thinning(), 0, (3, ToyReader().items()[3])).sequence
        np.testing.assert_array_equal(reader.read(3).points, expected.points)
        assert reader.provenance[-1]["config"]["reader"] == "ToyReader"


def test_a_limit_does_not_change_the_items_it_keeps(tmp_path):
    convert(ToyReader(), tmp_path / "all.h5", Conversion(points=20))
    convert(ToyReader(), tmp_path / "two.h5", Conversion(points=20, limit=2))
    with CloudsReader(tmp_path / "all.h5") as whole, CloudsReader(tmp_path / "two.h5") as part:
        assert len(part) == 2
        np.testing.assert_array_equal(part.read(1).points, whole.read(1).points)


def test_bad_samples_are_skipped_and_named(tmp_path):
    report = convert(ToyReader(bad=(1, 3)), tmp_path / "a.h5", Conversion(points=20))
    assert (report.written, report.frames) == (3, 9)
    assert report.skipped == [("toy001", "toy001 is broken"), ("toy003", "toy003 is broken")]
    assert report.lines()[0] == "2 skipped:" and "toy003: toy003 is broken" in report.lines()[2]
    with CloudsReader(tmp_path / "a.h5") as skipping:
        convert(ToyReader(), tmp_path / "b.h5", Conversion(points=20))
        with CloudsReader(tmp_path / "b.h5") as whole:  # its neighbors' randomness is untouched
            np.testing.assert_array_equal(skipping.read(1).points, whole.read(2).points)


def test_on_error_stop_leaves_nothing(tmp_path):
    with pytest.raises(DataError, match="toy001: toy001 is broken .*--on-error skip"):
        convert(ToyReader(bad=(1,)), tmp_path / "a.h5", Conversion(on_error="stop"))
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(UsageError, match="--on-error maybe"):
        convert(ToyReader(), tmp_path / "a.h5", Conversion(on_error="maybe"))


def test_nothing_good_is_bad_data(tmp_path):
    with pytest.raises(DataError, match="none of the 2 samples is good; the first: toy000 is broken"):
        convert(ToyReader(count=2, bad=(0, 1)), tmp_path / "a.h5")
    assert list(tmp_path.iterdir()) == []


def test_unreadable_files_are_bad_samples_and_bugs_are_not(tmp_path, monkeypatch):
    def missing(self, item, rng):
        raise PermissionError(errno.EACCES, "Permission denied", "secret.bin")

    monkeypatch.setattr(ToyReader, "read", missing)
    with pytest.raises(DataError, match="the first: secret.bin: Permission denied"):
        convert(ToyReader(), tmp_path / "a.h5")
    with monkeypatch.context() as patched:
        patched.setattr(ToyReader, "read", lambda self, item, rng: 1 / 0)
        with pytest.raises(DataError, match="toy000: damaged.*ZeroDivisionError"):
            convert(ToyReader(), tmp_path / "a.h5")
    monkeypatch.undo()
    monkeypatch.setattr(Thinning, "apply", lambda self, sequence, rng: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        convert(ToyReader(), tmp_path / "a.h5")
    assert list(tmp_path.iterdir()) == []


def test_running_again_says_already_complete(tmp_path):
    path = tmp_path / "a.h5"
    convert(ToyReader(), path, Conversion(points=20))
    before = (file_digest(path), path.stat().st_mtime_ns)
    report = convert(ToyReader(), path, Conversion(points=20))
    assert report.was_complete and report.written == 5
    assert (file_digest(path), path.stat().st_mtime_ns) == before


@pytest.mark.parametrize(
    ("reader", "options", "message"),
    [
        (ToyReader(), {"points": 30}, "made with points 20, now 30"),
        (ToyReader(), {"seed": 1}, "made with seed 0, now 1"),
        (ToyReader(config_extra="x"), {}, 'made with extra "", now "x"'),
        (ToyReader(count=6), {}, "items 5, now 6"),
        (ToyReader(), {"compression": "lzf"}, 'compression "none", now "lzf"'),
    ],
)
def test_another_configuration_is_refused_unless_forced(tmp_path, reader, options, message):
    path = tmp_path / "a.h5"
    convert(ToyReader(), path, Conversion(points=20))
    before = file_digest(path)
    with pytest.raises(UsageError, match=message):
        convert(reader, path, Conversion(**{"points": 20, **options}))
    assert file_digest(path) == before
    convert(reader, path, Conversion(force=True, **{"points": 20, **options}))
    assert file_digest(path) != before


def test_a_foreign_file_is_not_overwritten(tmp_path):
    path = tmp_path / "notes.h5"
    path.write_text("precious")
    with pytest.raises(UsageError, match="notes.h5: not an HDF5 file.*\n.*--force"):
        convert(ToyReader(), path)
    assert path.read_text() == "precious"


def test_a_full_disk_is_explained_and_keeps_what_is_done(tmp_path, monkeypatch, capsys):
    original = CloudsWriter.write

    def write(self, sequence):
        if len(self) == 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        original(self, sequence)

    monkeypatch.setattr(CloudsWriter, "write", write)
    with pytest.raises(
        DpcError,
        match=r"no space left on the device \(about .* needed, .* free in .*\); what is done, 2 samples, is kept",
    ) as error:
        convert(ToyReader(), tmp_path / "a.h5")
    assert error.value.exit_code == 1
    assert not (tmp_path / "a.h5").exists()
    monkeypatch.undo()
    assert convert(ToyReader(), tmp_path / "a.h5").written == 5
    assert "continuing: 2 of 5" in capsys.readouterr().err


class Stopper:
    """Sends this process a signal when the n-th sample is written."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, after: int, number: int) -> None:
        original = CloudsWriter.write

        def write(writer, sequence):
            original(writer, sequence)
            if len(writer) == after:
                os.kill(os.getpid(), number)

        monkeypatch.setattr(CloudsWriter, "write", write)


@pytest.mark.parametrize(
    ("number", "raised"), [("SIGTERM", Stopped), ("SIGUSR1", Stopped), ("SIGINT", KeyboardInterrupt)]
)
@pytest.mark.parametrize("bad", [(), (0, 2)])
def test_a_stopped_run_is_continued_to_the_same_bytes(tmp_path, monkeypatch, number, raised, bad):
    reader, path = ToyReader(count=9, bad=bad), tmp_path / "a.h5"
    whole = convert(reader, tmp_path / "whole.h5", Conversion(points=20))
    with monkeypatch.context() as patch:
        Stopper(patch, 3, getattr(signal, number))
        with pytest.raises(raised):
            convert(reader, path, Conversion(points=20))
    assert {p.name for p in tmp_path.iterdir()} == {"whole.h5", ".a.h5.part", ".a.h5.new"}
    read = []
    monkeypatch.setattr(pipeline, "convert_item", lambda *a, **k: read.append(a[-1][0]) or convert_item(*a, **k))
    report = convert(reader, path, Conversion(points=20))
    assert set(read) == set(range(9)) - ({0, 1, 2} if not bad else {1, 3, 4})  # good ones are not read again
    assert file_digest(path) == file_digest(tmp_path / "whole.h5")
    assert (report.written, report.skipped) == (whole.written, whole.skipped)
    assert {p.name for p in tmp_path.iterdir()} == {"a.h5", "whole.h5"}


def test_a_repaired_sample_does_not_break_the_order(tmp_path, monkeypatch):
    broken, path = ToyReader(count=6, bad=(1,)), tmp_path / "a.h5"
    with monkeypatch.context() as patch:
        Stopper(patch, 3, signal.SIGTERM)
        with pytest.raises(Stopped):
            convert(broken, path)
    monkeypatch.setattr(ToyReader, "read", lambda self, item, rng: original_read(replace(self, bad=()), item, rng))
    report = convert(broken, path)
    assert report.skipped[0][0] == "toy001" and "--force starts over" in report.skipped[0][1]
    with CloudsReader(path) as reader:
        assert list(reader.names) == ["toy000", "toy002", "toy003", "toy004", "toy005"]


original_read = ToyReader.read


def test_a_part_of_another_configuration_is_refused_and_force_starts_over(tmp_path, monkeypatch):
    path = tmp_path / "a.h5"
    with monkeypatch.context() as patch:
        Stopper(patch, 2, signal.SIGTERM)
        with pytest.raises(Stopped):
            convert(ToyReader(), path, Conversion(points=20))
    with pytest.raises(UsageError, match="config.points 20, now 10"):
        convert(ToyReader(), path, Conversion(points=10))
    convert(ToyReader(), path, Conversion(points=10, force=True))
    convert(ToyReader(), tmp_path / "fresh.h5", Conversion(points=10))
    assert file_digest(path) == file_digest(tmp_path / "fresh.h5")


@pytest.mark.parametrize("old_date", [False, True])  # as what an archive or `rsync -a` puts there has
@pytest.mark.parametrize("shape", ["file", "folder"])
def test_inputs_that_are_newer_than_the_output_are_named(tmp_path, capsys, shape, old_date):
    raw = tmp_path / "raw"
    for name in "ab":
        (raw / name).mkdir(parents=True)
        for t in range(3):
            depth = np.full((6, 8), 1000 + t, np.uint16)
            np.save(raw / f"{name}.npy", np.stack([depth] * 3)) if shape == "file" else np.save(
                raw / name / f"{t}.npy", depth
            )
    output = raw / "out.h5"
    convert(DepthVideos(inputs=(raw,)), output)
    assert convert(DepthVideos(inputs=(raw,)), output).was_complete and "newer than" not in capsys.readouterr().err
    changed = raw / "a.npy" if shape == "file" else raw / "a" / "1.npy"
    date = 1e9 if old_date else output.stat().st_mtime + 10
    os.utime(changed, (date, date))
    assert convert(DepthVideos(inputs=(raw,)), output).was_complete  # copying changes dates, too
    told = capsys.readouterr().err
    assert (
        f"newer than what an earlier run left (out.h5), and not read again where that had them: {changed.relative_to(raw).parts[0]};"
        in told
    )
    os.rename(output, raw / "other.h5")  # which makes the file later than its content
    assert convert(DepthVideos(inputs=(raw,)), raw / "other.h5").was_complete
    assert ("newer than" in capsys.readouterr().err) != old_date


def test_the_last_frame_counts_whatever_lies_behind_it_in_the_folder(tmp_path):
    for t in range(3):
        np.savetxt(tmp_path / f"{t}.xyz", np.full((5, 3), t))
    (tmp_path / "z.log").write_text("done")
    convert(CloudFolders(tmp_path), tmp_path / "out.h5")
    assert convert(CloudFolders(tmp_path), tmp_path / "out.h5").was_complete
    np.savetxt(tmp_path / "2.xyz", np.full((6, 3), 2))
    with pytest.raises(UsageError, match="exists, made with other samples, labels or sizes of files"):
        convert(CloudFolders(tmp_path), tmp_path / "out.h5")


def test_other_data_labels_or_classes_under_the_same_names_are_not_already_complete(tmp_path):
    from dpcli.prepare.scans.clouds import CloudFolders

    def write(folder: Path, frames: int) -> Path:
        for name in ("a", "b"):
            (folder / name).mkdir(parents=True)
            for t in range(frames):
                np.save(folder / name / f"{t}.npy", np.full((5, 3), t, np.float32))
        return folder

    table, other = tmp_path / "one.csv", tmp_path / "other.csv"
    table.write_text("name,label,subject,split\na,wave,1,train\nb,zoom,2,test\n")
    first, copied, longer = (
        write(tmp_path / "x/clouds", 2),
        write(tmp_path / "y/clouds", 2),
        write(tmp_path / "z/clouds", 3),
    )
    output = first / "out.h5"  # beside the data, as some have it
    convert(CloudFolders(first, labels=table), output)
    for same in (first, copied):
        assert convert(CloudFolders(same, labels=table), output).was_complete
    for text in ("walk,1", "wave,7"):  # a class, a subject
        other.write_text(table.read_text().replace("wave,1", text))
        with pytest.raises(UsageError, match="exists, made with other samples, labels or sizes of files"):
            convert(CloudFolders(first, labels=other), output)
    with pytest.raises(UsageError, match="exists, made with other samples, labels or sizes of files"):
        convert(CloudFolders(longer, labels=table), output)


def test_reader_helpers():
    assert sorted(["f10", "f9", "f09", "g1", "f"], key=natural_key) == ["f", "f09", "f9", "f10", "g1"]
    kept, notes = drop_empty_frames("x", np.array([0, 3, 0, 1]))
    assert kept.tolist() == [1, 3] and notes == {"frames without points dropped": 2}
    for counts in ([], [0, 0]):
        with pytest.raises(DataError, match="x: "):
            drop_empty_frames("x", np.array(counts, np.int64))
