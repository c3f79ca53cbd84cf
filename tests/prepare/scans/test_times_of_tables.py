"""Times and frames that columns of tables tell: units in names, seconds and their parts, types of times, exact numbers."""

from __future__ import annotations

from datetime import datetime, timedelta

import h5py
import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.prepare.decode.cloud_files import read_cloud
from dpcli.prepare.scans.clouds import TIMED, CloudFolders
from dpcli.prepare.scans.frames_of_tables import ROUNDED
from dpcli.prepare.scans.tables import TableSequences

RNG = np.random.default_rng(0)


def only_sequence(path, **options):
    reader = TableSequences(path, **options)
    (item,) = reader.items()
    assert not item.problem
    return reader.read(item, RNG).sequence, reader.summary([item])[0]


def csv(path, header, rows):
    path.write_text("\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


@pytest.mark.parametrize(
    ("name", "unit", "values", "expected"),
    [
        ("time", "ms", [0, 33.3, 66.7], [0, 0.0333, 0.0667]),  # with fractions they would be taken for seconds
        ("t", "[s]", [7, 8, 10], [0, 1, 3]),
        ("stamp", "µs", [5, 40_005, 90_005], [0, 0.04, 0.09]),
        ("clock time", "min", [1, 2, 4], [0, 60, 180]),
        ("time", "-", [3, 4, 5], None),
        ("time", "s", ["23:59:59", "00:00:00", "00:00:01"], [0, 1, 2]),
        ("dwell", "ms", [0, 40, 90], None),
    ],
)
def test_a_row_of_units_tells_that_of_times_beside_frames_and_of_frames(tmp_path, name, unit, values, expected):
    rows = [(frame, value, 10, 20, k) for frame, value in zip((7, 8, 9), values) for k in (1, 2)]
    path = csv(tmp_path / "a.csv", f"frame,{name},x,y,z", [("-", unit, "mm", "mm", "mm"), *rows])
    sequence, _ = only_sequence(path, frame_column="frame", keep=(name,) if expected and unit != "s" else ())
    np.testing.assert_allclose(sequence.points[:2], [[0.01, 0.02, 0.001], [0.01, 0.02, 0.002]])
    assert (sequence.time is None) == (expected is None)
    if expected:
        np.testing.assert_allclose(sequence.time, expected, atol=1e-9)
        np.testing.assert_allclose(only_sequence(path, frame_column=name)[0].time, expected, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "values", "expected"),
    [
        ("t [µs]", [0.0, 50_000.5], [0, 0.0500005]),
        ("t [μs]", [0, 50_000], [0, 0.05]),  # the other letter
        ("time_msec", [0.25, 33.75], [0, 0.0335]),
        ("timestamp_millis", [0, 40], [0, 0.04]),
        ("TIMESTAMP (nanoseconds)", [5 * 10**8, 6 * 10**8], [0, 0.1]),
        ("time (min)", [0.25, 0.75], [0, 30]),
        ("time [h]", [0.5, 0.75], [0, 900]),
        ("time (UTC)", [0.5, 0.75], [0, 0.25]),
        ("time [ticks]", [0.5, 0.75], None),
        ("timestamp", [1_234_567_890, 1_234_617_890], None),  # microseconds since the sensor began
        ("timestamp", [1_700_000_000, 1_700_000_030], [0, 30]),
        ("timestamp", [1_700_000_000_000.5, 1_700_000_000_050.5], [0, 0.05]),
        ("t", [0.5, 50.5], [0, 50]),
        ("time", ["0 days 00:00:01.500000", "0 days 00:00:01.750000"], [0, 0.25]),
        ("time", ["11:59:59 AM", "12:00:00.5 pm"], [0, 1.5]),
        ("time", [45356.5, 45356.50001157407], [0, 1]),  # days, as spreadsheets count them
        ("time", [45356.5, 45356.75], [0, 0.25]),
        ("time [days]", [0.5, 0.75], [0, 21_600]),
        ("time [100 ns]", [0, 1_000_000], [0, 0.1]),
        ("time [0.1 ms]", [0, 1_000], [0, 0.1]),
        ("Zeitstempel", ["05.03.2024 23:59:59,5", "06.03.2024 00:00:00"], [0, 0.5]),
        ("datetime", ["2024-03-05 14:30:00", "2024-03-05 14:30:01"], [0, 1]),
        ("date", ["2024-03-05", "2024-03-06"], None),
        ("time [5 turns]", [0.5, 0.75], None),
        ("timestamp", [638_452_458_000_000_000, 638_452_458_001_000_000], [0, 0.1]),  # .NET
        ("timestamp", [133_531_434_000_000_000, 133_531_434_001_000_000], [0, 0.1]),  # Windows
        ("timestamp", [315_966_265_259_836_000, 315_966_265_359_836_000], [0, 0.1]),  # nanoseconds
        ("timestamp", [20240305143059.5, 20240305143100.25], [0, 0.75]),
        ("timestamp", [20231231235959, 20240101000001], [0, 2]),
        ("timestamp", ["2.0240305143059500e+13", "2.0240305143100000e+13"], [0, 0.5]),
        ("timestamp", [20249905143059.5, 20249905143100.25], [0, 40.75]),  # no date has a month 99
        ("time", ["1 day, 0:00:01", "2 days, 0:00:01"], [0, 86400]),
    ],
)
def test_units_in_the_names_of_times(tmp_path, name, values, expected):
    rows = [(frame, value, k, 1, 2) for frame, value in enumerate(values) for k in (1, 2)]
    if any("," in str(value) for value in values):
        rows = [(frame, f'"{value}"', *rest) for frame, value, *rest in rows]
    sequence, about = only_sequence(csv(tmp_path / "a.csv", f"frame,{name},x,y,z", rows))
    if expected is None:
        assert sequence.time is None and name in about.split("not read: ")[1]
    else:
        np.testing.assert_allclose(sequence.time, expected, atol=2e-5)  # of ticks a float holds every 16th


@pytest.mark.parametrize(
    ("name", "values", "fps", "expected"),
    [
        ("time", [0, 33, 67, 100], 30, [0, 0.033, 0.067, 0.1]),
        ("t", [5_000_000, 5_100_000, 5_200_000], 10, [0, 0.1, 0.2]),
        ("t", [0, 1, 2, 5], 10, [0, 0.1, 0.2, 0.5]),
        ("frame", [0, 33, 66], 30, [0, 1 / 30, 2 / 30]),
        ("time [ticks]", [0.25, 0.5, 0.75], 10, [0, 0.1, 0.2]),
    ],
)
def test_a_rate_tells_the_unit_of_times_in_whole_numbers(tmp_path, name, values, fps, expected):
    path = csv(tmp_path / "a.csv", f"{name},x,y,z", [(value, 1, 2, k) for k, value in enumerate(values)])
    np.testing.assert_allclose(only_sequence(path, frame_column=name, fps=fps)[0].time, expected, atol=1e-6)


@pytest.mark.parametrize("rate", [1, 4, 200])
@pytest.mark.parametrize("written", ["spreadsheet", "matlab", "clock", "digits", "milliseconds"])
@pytest.mark.parametrize("as_frames", [False, True])
def test_moments_written_as_days_or_as_digits_are_seconds(tmp_path, rate, written, as_frames):
    before, after = (10, 2) if rate < 200 else (1, 1)  # seconds around a full hour
    start = datetime(2024, 3, 5, 15) - timedelta(seconds=before)
    moments = [start + timedelta(seconds=k / rate) for k in range((before + after) * rate)]
    days = [(moment - datetime(1899, 12, 30)) / timedelta(days=1) for moment in moments]
    values = {
        "spreadsheet": [f"{day:.11f}" for day in days],
        "matlab": [f"{day + 693_960:.11f}" for day in days],
        "clock": [moment.strftime("%H%M%S.") + f"{moment.microsecond // 1000:03d}" for moment in moments],
        "digits": [moment.strftime("%Y%m%d%H%M%S.") + f"{moment.microsecond // 1000:03d}" for moment in moments],
        "milliseconds": [moment.strftime("%Y%m%d%H%M%S") + f"{moment.microsecond // 1000:03d}" for moment in moments],
    }[written]
    path = csv(tmp_path / "a.csv", "frame,utc,x,y,z", [(k, value, k, 1, 2) for k, value in enumerate(values)])
    sequence, _ = only_sequence(path, frame_column="utc" if as_frames else "frame")
    np.testing.assert_allclose(sequence.time, np.arange(len(values)) / rate, atol=2e-5)


@pytest.mark.parametrize(("fps", "told"), [(10, True), (25, False)])
def test_a_rate_that_the_times_of_the_frame_column_overrule_is_told(tmp_path, fps, told):
    path = csv(tmp_path / "a.csv", "t_ms,x,y,z", [(40 * frame, 1, 2, 3) for frame in range(5) for _ in (1, 2)])
    reader = TableSequences(path, frame_column="t_ms", fps=fps)
    (item,) = reader.items()
    np.testing.assert_allclose(reader.read(item, RNG).sequence.time, np.arange(5) / 25)
    lines = [line for line in reader.summary([item]) if "not used" in line]
    assert lines == (["--fps 10 is not used: column 't_ms' tells the times, 25 frames a second"] if told else [])


def test_plain_seconds_stay_seconds(tmp_path):
    for start in (0, 50, 45_000, 735_000, 143_050):
        times = start + np.arange(500) * 0.25
        rows = [(k, time, k, 1, 2) for k, time in enumerate(times)]
        sequence, _ = only_sequence(csv(tmp_path / f"{start}.csv", "frame,time,x,y,z", rows))
        np.testing.assert_allclose(sequence.time, times - start, atol=1e-6)


@pytest.mark.parametrize(
    ("names", "parts"),
    [("stamp.sec,stamp.nanosec", 1e9), ("secs,nsecs", 1e9), ("ts_sec,ts_usec", 1e6), ("time_s,time_ms", 1e3)],
)
def test_seconds_and_their_parts_are_one_time(tmp_path, names, parts):
    moments = [(10, 0.9), (11, 0.1), (12, 0.05)]  # the seconds alone would rise, too
    rows = [(f, s, round(p * parts), k, 1, 2) for f, (s, p) in enumerate(moments) for k in (1, 2)]
    path = csv(tmp_path / "a.csv", f"frame,{names},x,y,z", rows)
    first, second = names.split(",")
    sequence, about = only_sequence(path)
    np.testing.assert_allclose(sequence.time, [0, 0.2, 1.15], atol=1e-6)
    assert f"times by column {first!r} and {second!r}" in about and "not read" not in about
    sequence, _ = only_sequence(path, frame_column=first)
    np.testing.assert_allclose(sequence.time, [0, 0.2, 1.15], atol=1e-6)


def test_names_of_frames_in_the_order_of_the_alphabet_are_put_in_that_of_their_numbers(tmp_path):
    names = sorted(f"frame_{k}.pcd" for k in range(12))
    path = csv(tmp_path / "a.csv", "frame,x,y,z", [(name, int(name[6:-4]), 1, 2) for name in names])
    assert only_sequence(path)[0].points[:, 0].tolist() == list(range(12))
    logged = [f"frame_{k}.pcd" for k in (8, 9, 10, 1)]
    path = csv(tmp_path / "b.csv", "frame,x,y,z", [(name, int(name[6:-4]), 1, 2) for name in logged])
    assert only_sequence(path)[0].points[:, 0].tolist() == [8, 9, 10, 1]
    clocks = ["11:59:59:07", "12:00:01:02", "1:00:00:01"]  # in the alphabet's order by chance
    path = csv(tmp_path / "d.csv", "frame,x,y,z", [(clock, k, 1, 2) for k, clock in enumerate(clocks)])
    assert only_sequence(path)[0].points[:, 0].tolist() == [0, 1, 2]
    csv(tmp_path / "c.csv", "frame,x,y,z", [("a", 1, 1, 1), ("", 1, 1, 1)])
    (item,) = TableSequences(tmp_path / "c.csv").items()
    assert "1 row without a number in 'frame', the first is 2" in item.problem


@pytest.mark.parametrize("first", [2**53, 2**60, 1_709_640_000_123_456_789, 2**64 - 9])
def test_numbers_that_no_float_holds_stay_apart(tmp_path, first):
    rows = [(first + k, k, 1, 2) for k in range(4)]
    sequence, _ = only_sequence(csv(tmp_path / "a.csv", "frame,x,y,z", rows), fps=10)
    assert sequence.num_frames == 4
    np.testing.assert_allclose(sequence.time, [0, 0.1, 0.2, 0.3])
    reader = TableSequences(tmp_path / "a.csv")
    assert ROUNDED not in reader.read(reader.items()[0], RNG).notes


def test_times_that_float32_rounded_are_told(tmp_path):
    for moments, told in (([1_709_640_064] * 2, True), ([1_709_640_000, 1_709_640_001], False), ([128, 256], False)):
        csv(tmp_path / "a.csv", "time,x,y,z", [(moment, 1, 2, k) for k, moment in enumerate(moments)])
        reader = TableSequences(tmp_path / "a.csv", frame_column="time")
        assert (ROUNDED in reader.read(reader.items()[0], RNG).notes) == told


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_dates_tell_frames_apart_and_are_no_numbers(tmp_path, suffix):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import csv as texts
    from pyarrow import parquet

    days = pyarrow.array([18262, 18262, 18264], pyarrow.int32()).cast(pyarrow.date32())
    table = pyarrow.table({"day": days, **{axis: [1.0, 2, 3] for axis in "xyz"}})
    path = tmp_path / f"a.{suffix}"
    (texts.write_csv if suffix == "csv" else parquet.write_table)(table, path)
    assert np.diff(only_sequence(path, frame_column="day")[0].frame_offsets).tolist() == [2, 1]
    with pytest.raises(DataError, match="column 'day' holds "):
        read_cloud(path, keep=("day",))


def test_numbers_of_frames_in_groups_of_thousands(tmp_path):
    rows = [(f'"1,{k:03d}"', k + 0.5, 1, 2) for k in range(3)]
    np.testing.assert_allclose(
        only_sequence(csv(tmp_path / "a.csv", "frame,x,y,z", rows), fps=10)[0].time, [0, 0.1, 0.2]
    )


@pytest.mark.parametrize("kind", ["timestamp[s]", "timestamp[ns]", "duration[ms]", "time32[s]", "time64[us]", "int64"])
def test_types_of_times_are_times_whatever_their_columns_are_called(tmp_path, kind):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    parts = {"s]": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}.get(kind[-3:-1] if kind[-3] != "[" else "s]", 1)
    name, unit = kind.rstrip("]").split("[") if "[" in kind else ("", "")
    made = {"timestamp": lambda: pyarrow.timestamp(unit, "Europe/Berlin"), "duration": lambda: pyarrow.duration(unit)}
    made |= {"time32": lambda: pyarrow.time32(unit), "time64": lambda: pyarrow.time64(unit), "": pyarrow.int64}
    moments = pyarrow.array([parts * s for s in (5, 5, 7)], pyarrow.int32() if name == "time32" else pyarrow.int64())
    x = np.array([1.0, 2, 3])
    table = pyarrow.table({"recorded": moments.cast(made[name]()), "x": x, "y": x, "z": x, "run": [7, 7, None]})
    parquet.write_table(table, tmp_path / "a.parquet")
    sequence, _ = only_sequence(tmp_path / "a.parquet", frame_column="recorded")
    assert sequence.num_frames == 2
    assert sequence.time is None if kind == "int64" else sequence.time.tolist() == [0, 2]
    (item,) = TableSequences(tmp_path / "a.parquet", frame_column="recorded", sequence_column="run").items()
    assert "a row has nothing in its column 'run'" in item.problem


def test_structures_are_columns_and_lists_are_named(tmp_path):
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    places = [{"x": float(k), "y": 1.0, "z": 2.0} for k in range(3)]
    parquet.write_table(pyarrow.table({"frame": [0, 0, 1], "position": places}), tmp_path / "a.parquet")
    assert only_sequence(tmp_path / "a.parquet")[0].points[:, 0].tolist() == [0, 1, 2]
    lists = {name: [[1.0, 2.0], [3.0]] for name in "xyz"}
    parquet.write_table(pyarrow.table({"frame": [0, 1], **lists}), tmp_path / "b.parquet")
    (item,) = TableSequences(tmp_path / "b.parquet").items()
    assert "column 'x' holds lists; expected a row for each point" in item.problem


@pytest.mark.parametrize("column", ["clock", "time"])
@pytest.mark.parametrize("unit", ["time32[s]", "time64[ns]"])
def test_times_of_day_of_any_type_pass_midnight(tmp_path, column, unit):
    """Whether they number the frames or stand beside their numbers, a table in Parquet is read as the same table in a text is."""
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    seconds = [86_398, 86_398, 86_399, 0, 0, 2]
    x, frame = np.arange(6.0), np.repeat([0, 1, 2, 3], [2, 1, 2, 1])
    words = [f"{s // 3600:02d}:{s // 60 % 60:02d}:{s % 60:02d}" for s in seconds]
    csv(tmp_path / "a.csv", f"frame,{column},x,y,z", zip(frame, words, x, x, x))
    name, part = unit.rstrip("]").split("[")
    times = pyarrow.array([s * (10**9 if part == "ns" else 1) for s in seconds], f"int{name[4:]}")
    times = times.cast(getattr(pyarrow, name)(part))
    columns = {"frame": frame, column: times, "x": x, "y": x, "z": x}
    parquet.write_table(pyarrow.table(columns), tmp_path / "b.parquet")
    for place in ("a.csv", "b.parquet"):
        sequence, _ = only_sequence(tmp_path / place, frame_column=column if column == "clock" else "frame")
        assert sequence.points[:, 0].tolist() == x.tolist(), place
        assert sequence.frame_offsets.tolist() == [0, 2, 3, 5, 6], place
        np.testing.assert_allclose(sequence.time, [0, 1, 2, 4], atol=1e-9, err_msg=place)


def test_durations_below_0_as_pandas_writes_them(tmp_path):
    words = ["0 days 00:00:00.250000", "-1 days +23:59:59.750000", "-1 day, 23:59:59.900000"]
    sequence, _ = only_sequence(
        csv(tmp_path / "a.tsv", "since\tx\ty\tz", [[f"{w}\t1\t2\t{k}"] for k, w in enumerate(words)]),
        frame_column="since",
    )
    assert sequence.points[:, 2].tolist() == [1, 2, 0]
    np.testing.assert_allclose(sequence.time, [0, 0.15, 0.5], atol=1e-9)


@pytest.mark.parametrize("suffix", [".csv", ".h5"])
@pytest.mark.parametrize(
    "times, told",
    [
        (np.repeat([0.5, 0.6, 0.8], 4), True),
        (np.repeat([0.5, 0.5001, 0.5002], 4), False),  # columns of a turning lidar
        (np.arange(12) * 0.5, False),  # one for each point
        (np.tile([0.5, 0.6, 0.7], 4), False),
        (np.full(12, 0.5), False),
    ],
)
def test_tables_of_a_folder_whose_times_are_those_of_several_frames_are_told(tmp_path, suffix, times, told):
    """A folder's files are frames, so that recordings in them would become one cloud each."""
    columns = {"time": times, **dict(zip("xyz", RNG.normal(size=(3, 12)).round(3)))}
    for name in ("a1", "a2"):
        path = tmp_path / f"{name}{suffix}"
        rows = list(zip(*columns.values()))
        if suffix == ".csv":
            csv(path, ",".join(columns), rows)
        else:
            with h5py.File(path, "w") as file:
                file["rows"] = np.array(rows, [(name, "f8") for name in columns])
    reader = CloudFolders(tmp_path)
    assert (TIMED.format("time") in reader.summary(reader.items())) == told
    if told:  # and what is advised
        reader = TableSequences(tmp_path, frame_column="time")
        sequence = reader.read(reader.items()[0], RNG).sequence
        np.testing.assert_allclose(sequence.time, [0, 0.1, 0.3], atol=1e-9)
