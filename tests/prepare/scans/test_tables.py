"""Tables of many frames: columns of frames and sequences, gaps, times, kept columns, labels, in texts and Parquet."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dpcli.errors import DataError, UsageError
from dpcli.prepare.pipeline import Conversion, convert
from dpcli.prepare.scans.frames_of_tables import FELL, JOINED, SILENT, SINGLE, WRAPPED
from dpcli.prepare.scans.tables import MIXED, WIDE, TableSequences
from dpcli.store import CloudsReader

RNG = np.random.default_rng(0)
quick = settings(
    max_examples=40, derandomize=True, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def write(path, rows, header="frame,x,y,z"):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


def frames(*numbers, points=2):
    return [(number, number + k / 10, 1, 2) for number in numbers for k in range(points)]


def sequences(raw, **options):
    reader = TableSequences(raw, **options)
    return [reader.read(item, RNG) for item in reader.items()]


def test_frames_by_a_column_with_times(tmp_path):
    path = write(tmp_path / "log.csv", frames(3, 4, 7))
    (sample,) = sequences(path, fps=10)
    assert sample.sequence.name == "log" and sample.notes == {}
    np.testing.assert_allclose(sample.sequence.time, [0, 0.1, 0.4])
    np.testing.assert_allclose(sample.sequence.frame(2), [[7, 1, 2], [7.1, 1, 2]])
    (strided,) = sequences(path, fps=10, stride=2)
    np.testing.assert_allclose(strided.sequence.time, [0, 0.4])
    assert TableSequences(path).fields == ()


def test_gaps_and_restarts_begin_sequences(tmp_path):
    path = write(tmp_path / "log.csv", frames(0, 1, 2, 9, 10, 0, 1))
    found = sequences(path, gap=3)
    assert [(s.sequence.name, s.sequence.num_frames) for s in found] == [("log/000", 3), ("log/001", 2), ("log/002", 2)]
    (joined,) = sequences(path)
    assert joined.sequence.num_frames == 5 and joined.notes == {JOINED: 2}
    assert [s.sequence.num_frames for s in sequences(path, gap=7)] == [5, 2]


def test_sequences_by_a_column(tmp_path):
    rows = [(run, *row) for run in ("b", "a") for row in frames(0, 1)] + [("b", 5, 5, 5, 5)]
    path = write(tmp_path / "log.csv", rows, "run,frame,x,y,z")
    found = sequences(path, sequence_column="run")
    assert [(s.sequence.name, s.sequence.num_frames) for s in found] == [("log/b", 3), ("log/a", 2)]
    found = sequences(path, sequence_column="run", gap=2)
    assert [s.sequence.name for s in found] == ["log/b/000", "log/b/001", "log/a/000"]
    path = write(tmp_path / "log.csv", [("day 1/b", *row) for row in frames(0, 1)], "run,frame,x,y,z")
    assert [s.sequence.name for s in sequences(path, sequence_column="run")] == ["log/day 1_b"]


@pytest.mark.parametrize(
    ("name", "values", "expected"),
    [
        ("timestamp", ["10.25", "10.5", "11"], [0, 0.25, 0.75]),
        ("t_ms", [0, 33, 66], [0, 0.033, 0.066]),
        ("timestamp", [1600000000000, 1600000000100, 1600000000300], [0, 0.1, 0.3]),
        ("stamp_ns", [10**18, 10**18 + 10**8, 10**18 + 3 * 10**8], [0, 0.1, 0.3]),
        ("frame", [0, 5, 10], None),
        ("frame", [254, 255, 0], None),
        ("stamp", ["2024-03-05T23:59:59.95Z", "2024-03-06T00:00:00Z", "2024-03-06T02:00:00.1+02:00"], [0, 0.05, 0.15]),
        ("stamp", ["23:59:59.950", "00:00:00.000", "00:00:00.050"], [0, 0.05, 0.1]),
        ("frame", ["a.png", "b.png", "c.png"], None),
    ],
)
def test_times_are_what_the_column_tells_or_absent(tmp_path, name, values, expected):
    path = write(tmp_path / "a.csv", [(value, 1, 2, k) for value in values for k in (1, 2)], f"{name},x,y,z")
    (sample,) = sequences(path, frame_column=name)
    assert sample.sequence.num_frames == 3
    if expected is None:
        assert sample.sequence.time is None
        (sample,) = sequences(path, frame_column=name, fps=10)
        expected = [0, 0.1, 0.2]
    np.testing.assert_allclose(sample.sequence.time, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "values", "expected"),
    [
        ("time", [10.25, 10.5, 11], [0, 0.25, 0.75]),
        ("timestamp_us", [0, 40_000, 90_000], [0, 0.04, 0.09]),
        ("Time [ms]", [0, 40, 90], [0, 0.04, 0.09]),
        ("stamp", ["23:59:59.95", "00:00:00", "00:00:00.05"], [0, 0.05, 0.1]),
        ("time", [3, 4, 5], None),  # of which unit?
        ("time", [0.5, 0.5, 0.5], None),
        ("time", [0.5, 0.1, 0.9], None),
        ("dwell", [0.5, 0.6, 0.9], None),
        ("time", [0.5, "", 0.9], None),
    ],
)
def test_a_column_of_times_beside_that_of_frames_tells_the_times(tmp_path, name, values, expected):
    rows = [(frame, 1, 2, k, value) for frame, value in zip((7, 8, 9), values) for k in (1, 2)]
    reader = TableSequences(write(tmp_path / "a.csv", rows, f"frame,x,y,z,{name}"), frame_column="frame")
    (item,) = reader.items()
    if expected is None:
        assert reader.read(item, RNG).sequence.time is None and name in reader.summary([item])[0].split("not read: ")[1]
    else:
        np.testing.assert_allclose(reader.read(item, RNG).sequence.time, expected, atol=1e-6)
        assert f"times by column {name!r}" in reader.summary([item])[0] and "not read" not in reader.summary([item])[0]
    (sample,) = sequences(tmp_path / "a.csv", frame_column="frame", fps=10)
    np.testing.assert_allclose(sample.sequence.time, [0, 0.1, 0.2])


def test_times_of_points_are_those_of_the_first_of_a_frame(tmp_path):
    rows = [(f, 1, 2, k, 5 + f / 10 + k / 100) for f in (0, 1, 2) for k in (1, 2, 3)]
    (sample,) = sequences(write(tmp_path / "a.csv", rows, "frame,x,y,z,t"), frame_column="frame")
    np.testing.assert_allclose(sample.sequence.time, [0, 0.1, 0.2], atol=1e-6)
    assert sample.sequence.num_frames == 3
    rows = [(f, 1, 2, k, k / 100, 5 + f / 10) for f in (0, 1, 2) for k in (1, 2, 3)]  # first the time within a frame
    (sample,) = sequences(write(tmp_path / "b.csv", rows, "frame,x,y,z,t,timestamp"), frame_column="frame")
    np.testing.assert_allclose(sample.sequence.time, [0, 0.1, 0.2], atol=1e-6)


def test_numbers_that_fall_are_told_and_counters_that_are_full_go_on(tmp_path):
    (sample,) = sequences(write(tmp_path / "a.csv", frames(2, 0, 1)))
    assert sample.notes == {FELL: 1} and sample.sequence.points[:, 0].tolist()[::2] == [0, 1, 2]
    (sample,) = sequences(write(tmp_path / "b.csv", frames(254, 255, 0, 1, 2)), fps=10)
    assert sample.notes == {WRAPPED: 1} and sample.sequence.points[::2, 0].tolist() == [254, 255, 0, 1, 2]
    np.testing.assert_allclose(sample.sequence.time, [0, 0.1, 0.2, 0.3, 0.4])


def test_kept_columns_and_colors_are_in_the_file(tmp_path):
    rows = [(f, 1, 2, k, 255, 0, 10 * k, f + k / 4) for f in (0, 1) for k in (1, 2, 3)]
    path = write(tmp_path / "log.csv", rows, "frame,x,y,z,r,g,b,doppler [m/s]")
    reader = TableSequences(path, keep=("doppler [m/s]",))
    assert reader.summary(reader.items()) == ["1 sequence in 1 table, frames by column 'frame'"]
    assert "not read: doppler" in TableSequences(path).summary(TableSequences(path).items())[0]
    convert(reader, tmp_path / "out.h5", Conversion(points=2))
    with CloudsReader(tmp_path / "out.h5") as file:
        assert file.fields == ("color", "field_doppler [m_s]")
        sequence = file.read(0)
    assert sequence.color.shape == (4, 3)
    blue = sequence.color[:, 2] / 10
    np.testing.assert_allclose(sequence.extra["field_doppler [m_s]"], np.repeat([0, 1], 2) + blue / 4)


def test_labels_of_tables(tmp_path):
    for name in ("walk/a", "walk/b", "run/a"):
        write(tmp_path / "in" / f"{name}.csv", frames(0, 1, 8))
    reader = TableSequences(tmp_path / "in", gap=2, label_from_folder=True)
    assert reader.class_names == ["run", "walk"]
    assert [(i.name, i.label) for i in reader.items()][:3] == [("run/a/000", 0), ("run/a/001", 0), ("walk/a/000", 1)]
    labels = tmp_path / "in" / "labels.csv"
    labels.write_text("name,label,subject,split\nrun/a,3,7,test\n")
    items = TableSequences(tmp_path / "in", labels=labels).items()
    assert [(i.name, i.label, i.subject, i.split) for i in items][0] == ("run/a", 3, 7, "test")


@pytest.mark.parametrize(("column", "told"), [("activity", True), ("Gesture_ID", True), ("label", False)])
def test_a_column_that_may_tell_labels_is_named(tmp_path, column, told):
    rows = [(recording, *row, "wave") for recording in (3, 4) for row in frames(0, 1)]
    path = write(tmp_path / "r.csv", rows, f"recording,frame,x,y,z,{column}")
    reader = TableSequences(path, sequence_column="recording")
    said = [line for line in reader.summary(reader.items()) if "labels are not read" in line]
    assert [f"from column {column!r};" in line and line.endswith("like r/3") for line in said] == [True] * told
    (tmp_path / "labels.csv").write_text("name,label\nr/3,wave\nr/4,wave\n")
    labeled = TableSequences(path, sequence_column="recording", labels=tmp_path / "labels.csv")
    assert not any("labels are not read" in line for line in labeled.summary(labeled.items()))


def test_a_bad_table_is_skipped_and_named(tmp_path):
    write(tmp_path / "in" / "a.csv", frames(0, 1))
    write(tmp_path / "in" / "b.csv", [("0", 1, 2, "word")])
    report = convert(TableSequences(tmp_path / "in"), tmp_path / "out.h5", Conversion())
    assert report.written == 1
    ((name, reason),) = report.skipped
    assert name == "b" and "b.csv:2: column 'z' holds 'word'" in reason


def test_times_of_points_taken_for_frames_are_doubted(tmp_path):
    path = write(tmp_path / "a.csv", [(k / 1000, 1, 2, k) for k in range(9)], "timestamp,x,y,z")
    (sample,) = sequences(path, frame_column="timestamp")
    assert sample.notes == {SINGLE: 1}
    assert sequences(write(tmp_path / "b.csv", frames(0, 1, 2, 3, 4, 5)))[0].notes == {}


def test_a_column_of_recordings_that_is_not_asked_for_is_named_where_frames_mix_them(tmp_path):
    rows = [(word, *row) for number in range(3) for word in ("b", "a") for row in frames(number)]  # sorted by frames
    path = write(tmp_path / "log.csv", rows, "Video,frame,x,y,z")
    (sample,) = sequences(path)
    assert sample.notes == {MIXED.format("Video"): 1} and sample.sequence.frame_offsets.tolist() == [0, 4, 8, 12]
    assert [one.notes for one in sequences(path, sequence_column="Video")] == [{}, {}]
    after = [("ab"[number > 1], *row) for number in range(4) for row in frames(number)]  # each frame of one recording
    assert sequences(write(tmp_path / "c.csv", after, "Video,frame,x,y,z"))[0].notes == {}
    tracked = [(row[1], *row) for number in range(3) for row in frames(number)]
    assert sequences(write(tmp_path / "d.csv", tracked, "track,frame,x,y,z"))[0].notes == {}


def test_further_points_of_a_row_are_told(tmp_path):
    rows = [(number, *range(9)) for number in range(8)]
    wide = write(tmp_path / "a.csv", rows, "frame," + ",".join(f"{axis}{k}" for k in (1, 2, 3) for axis in "xyz"))
    (sample,) = sequences(wide)
    assert sample.notes == {WIDE.format("x1, y1, z1", "x2, y2, z2"): 1}
    other = write(tmp_path / "b.csv", [(*row, *row) for row in frames(0, 1)], "frame,x,y,z,t,vel_x,vel_y,vel_z")
    assert sequences(other)[0].notes == {}
    named = write(tmp_path / "c.csv", [row[:7] for row in rows], "frame,hand.X,hand.Y,hand.Z,head.X,head.Y,head.Z")
    (item,) = TableSequences(named).items()
    assert "a row holds one point: write a row for each of them" in item.problem


@pytest.mark.parametrize("name", ["Frame #", "frame no.", "#Frame", "frameNum", "scan_id"])
def test_names_of_frame_columns(tmp_path, name):
    (sample,) = sequences(write(tmp_path / "a.csv", frames(0, 1, 8), f"{name},x,y,z"))
    assert sample.sequence.num_frames == 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"frame_column": "scan"}, "--frame-column scan: no such column; found frame, x, y, z"),
        ({"sequence_column": "run"}, "--sequence-column run: no such column"),
        ({"keep": ("snr",)}, "no column snr among those to read"),
    ],
)
def test_columns_that_are_not_there(tmp_path, options, message):
    path = write(tmp_path / "a.csv", frames(0, 1))
    (item,) = TableSequences(path, **options).items()
    assert message in item.problem


def test_files_that_only_seem_tables_are_named(tmp_path):
    (tmp_path / "a.xlsx").write_bytes(b"PK\3\4")
    with pytest.raises(DataError, match=".xlsx files are not read: save their sheets as .csv"):
        TableSequences(tmp_path / "a.xlsx", frame_column="frame").items()
    (tmp_path / "a.csv").write_text("<html><body>sign in</body></html>")
    assert "a web page; download it again" in TableSequences(tmp_path / "a.csv").items()[0].problem


def test_a_word_among_the_numbers_of_frames_is_none(tmp_path):
    path = write(tmp_path / "a.csv", [*frames(0, 1), ("Mean", 1, 2, 3)])
    (item,) = TableSequences(path).items()
    assert "a.csv:6: column 'frame' holds 'Mean'; expected numbers" in item.problem


def test_tables_that_cannot_be_split(tmp_path):
    (item,) = TableSequences(write(tmp_path / "0.csv", [], "frame,x,y,z")).items()
    assert "a header, but no rows" in item.problem
    (item,) = TableSequences(write(tmp_path / "a.csv", [(1, 2, 3)], "x,y,z")).items()
    assert "which column numbers the frames? give --frame-column NAME; found x, y, z" in item.problem
    (item,) = TableSequences(write(tmp_path / "b.csv", [("", 1, 2, 3), (1, 1, 2, 3)])).items()
    assert "1 row without a number in 'frame', the first is 1" in item.problem
    (item,) = TableSequences(write(tmp_path / "c.csv", [("p", 1, 2, 3)]), gap=2).items()
    assert "--gap needs numbers in 'frame'; it holds words such as 'p'" in item.problem
    with pytest.raises(UsageError, match="--gap 0: expected more than 0"):
        TableSequences(tmp_path / "a.csv", gap=0)
    with pytest.raises(DataError, match="does not exist"):
        TableSequences(tmp_path / "none").items()
    write(tmp_path / "two" / "a.csv", frames(0))
    write(tmp_path / "two" / "a.txt", frames(0))
    with pytest.raises(DataError, match="same name in another format"):
        TableSequences(tmp_path / "two").items()


@quick
@given(data=st.data())
def test_parquet_is_read_as_pyarrow_wrote_it(tmp_path, data):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    kind = data.draw(st.sampled_from(["float32", "float64", "int16", "int64"]))
    count = data.draw(st.integers(2, 30))
    rng = np.random.default_rng(data.draw(st.integers(0, 9)))
    points = rng.uniform(-90, 90, (count, 3)).astype(kind)
    points[0] = 1  # an integer 0 0 0 twice would be no return
    number = np.sort(rng.integers(0, 4, count))
    order = data.draw(st.permutations(["x", "y", "z", "frame", "run"]))
    columns = {**dict(zip("xyz", points.T)), "frame": number, "run": np.array(["a"] * count)}
    table = pyarrow.table({name: columns[name] for name in order})
    path = tmp_path / "a.parquet"
    parquet.write_table(
        table,
        path,
        compression=data.draw(st.sampled_from(["none", "snappy", "gzip", "zstd"])),
        use_dictionary=data.draw(st.booleans()),
        row_group_size=data.draw(st.sampled_from([1, 7, 1000])),
    )
    (sample,) = sequences(path, sequence_column="run")
    np.testing.assert_allclose(sample.sequence.points, points.astype(np.float32))
    assert sample.sequence.num_frames == len(np.unique(number))


@pytest.mark.parametrize("packed", ["uncompressed", "lz4", "zstd"])
@pytest.mark.parametrize("rows", [2, 100])
def test_feather_is_read_as_pyarrow_wrote_it(tmp_path, packed, rows):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import feather

    points = np.random.default_rng(0).uniform(1, 9, (7, 3)).astype(np.float16)
    columns = {"frame": np.repeat([0, 1], [3, 4]), **dict(zip("xyz", points.T))}
    feather.write_feather(pyarrow.table(columns), str(tmp_path / "a.feather"), compression=packed, chunksize=rows)
    (sample,) = sequences(tmp_path / "a.feather")
    np.testing.assert_array_equal(sample.sequence.points, points.astype(np.float32))
    assert np.diff(sample.sequence.frame_offsets).tolist() == [3, 4]
    (tmp_path / "a.feather").write_bytes((tmp_path / "a.feather").read_bytes()[:-9])
    (item,) = TableSequences(tmp_path / "a.feather").items()
    assert "a.feather: not a readable Feather table" in item.problem


def test_arrow_is_read_as_a_file_and_as_a_stream(tmp_path):
    """Polars writes files under this name, Hugging Face's data sets streams; the first version of Feather is named."""
    pyarrow = pytest.importorskip("pyarrow")
    table = pyarrow.table({"frame": [0, 0, 1], "x": [1.0, 2.0, 3.0], "y": [0.0, 0.0, 1.0], "z": [1.0, 1.0, 1.0]})
    for name, make in (("a", pyarrow.ipc.new_file), ("b", pyarrow.ipc.new_stream)):
        with pyarrow.OSFile(str(tmp_path / f"{name}.arrow"), "wb") as file, make(file, table.schema) as writer:
            writer.write_table(table, max_chunksize=2)
        (sample,) = sequences(tmp_path / f"{name}.arrow")
        assert sample.sequence.points[:, 0].tolist() == [1, 2, 3]
    (tmp_path / "c.feather").write_bytes(b"FEA1" + bytes(60))
    (item,) = TableSequences(tmp_path / "c.feather").items()
    assert "c.feather: Feather of version 1; write it again" in item.problem


def test_a_truncated_parquet_is_named(tmp_path):
    (tmp_path / "a.parquet").write_bytes(b"PAR1 and then nothing")
    pytest.importorskip("pyarrow")
    (item,) = TableSequences(tmp_path / "a.parquet").items()
    assert "a.parquet: not a readable Parquet table" in item.problem


@quick
@given(st.sets(st.integers(0, 40), min_size=3), st.sampled_from([1, 2, 10]), st.integers(0, 5))
def test_numbers_of_frames_without_rows_are_told(tmp_path, places, step, first):
    numbers = [first + step * place for place in sorted(places)]
    (sample,) = sequences(write(tmp_path / "log.csv", frames(*numbers)))
    own = np.gcd.reduce(np.diff(numbers))
    missing = (numbers[-1] - numbers[0]) // own + 1 - len(numbers)
    steady = 2 * (np.diff(numbers) == own).sum() > len(numbers) - 1
    assert sample.notes.get(SILENT, 0) == (missing if steady else 0)
    (timed,) = sequences(tmp_path / "log.csv", fps=10)  # whose times hold the gaps
    assert timed.notes == {}


@pytest.mark.parametrize(
    ("names", "told"),
    [
        (("part-0", "part-1"), True),
        (("rec/part-00000-8f3a.c000", "rec/part-00001-8f3a.c000"), True),
        (("part.0", "part.1"), True),
        (("train-00000-of-00002", "train-00001-of-00002"), True),
        (("part-0", "walk"), False),
        (("party-1", "party-2"), False),
        (("1", "2"), False),
    ],
)
def test_pieces_of_one_table_are_told(tmp_path, names, told):
    """As programs write that divide a table among files: each file is a sequence, and a frame may be in two."""
    for name in names:
        path = tmp_path / f"{name}.csv"
        path.parent.mkdir(exist_ok=True)
        path.write_text("frame,x,y,z\n0,1,2,3\n1,1,2,4\n")
    reader = TableSequences(tmp_path)
    assert any("pieces of one table" in line for line in reader.summary(reader.items())) == told


@pytest.mark.parametrize("option", ["frame_column", "sequence_column"])
def test_columns_that_folders_of_a_divided_table_name(tmp_path, option):
    path = tmp_path / "take=a" / "0.csv"
    path.parent.mkdir()
    path.write_text("frame,x,y,z\n0,1,2,3\n1,1,2,4\n")
    (item,) = TableSequences(tmp_path, **{option: "take"}).items()
    assert "no such column" in item.problem and "Its folder take=a tells it: join the pieces" in item.problem


def test_recordings_and_packed_files_beside_tables_are_told_as_left_out(tmp_path):
    write(tmp_path / "raw" / "log.csv", frames(3, 4, 7))
    for name in ("a.bag", "b.mcap", "c.mcap", "d.csv.gz", "readme.md", "~$log.csv"):
        (tmp_path / "raw" / name).write_bytes(b"")
    reader = TableSequences(tmp_path / "raw")
    assert [item.name for item in reader.items()] == ["log"]  # and not the lock that a spreadsheet left
    told = "left out: 1 .bag file, 1 .gz file, 2 .mcap files (name the recordings themselves, or unpack them)"
    assert reader.summary(reader.items())[-1] == told
