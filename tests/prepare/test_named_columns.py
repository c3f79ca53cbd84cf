"""Tables in files of arrays: structured arrays, tables as PyTables and pandas write them, and columns side by side."""

from __future__ import annotations

import pickle
from importlib import import_module

import h5py
import numpy as np
import pytest

from dpcli.errors import DataError
from dpcli.prepare.named_columns import ArrayTable
from dpcli.prepare.scans.tables import TableSequences
from dpcli.store import CloudsReader
from tests.support.commands import told

FRAMES, POINTS = 6, 40
RNG = np.random.default_rng(5)
COLUMNS = {
    "frame": np.repeat(np.arange(FRAMES), POINTS),
    "t": np.repeat(np.arange(FRAMES) * 0.1 + 5, POINTS),
    **{axis: RNG.normal(size=FRAMES * POINTS) for axis in "xyz"},
    "snr": RNG.random(FRAMES * POINTS, np.float32),
}


def structured(order: str = "<") -> np.ndarray:
    """The columns as one array of records."""
    kinds = [(name, values.dtype.newbyteorder(order)) for name, values in COLUMNS.items()]
    table = np.zeros(FRAMES * POINTS, kinds)
    for name, values in COLUMNS.items():
        table[name] = values
    return table


def write_pandas(path, form: str) -> None:
    """The bytes of `DataFrame.to_hdf`, whose ``table`` has the names of its blocks in a pickle."""
    xyz = np.stack([COLUMNS[axis] for axis in "xyz"], axis=1)
    with h5py.File(path, "w") as file:
        group = file.create_group("df")
        group.attrs["pandas_type"] = "frame_table" if form == "table" else "frame"
        if form == "table":
            table = np.zeros(
                len(xyz), [("index", "i8"), ("values_block_0", "i8", (1,)), ("values_block_1", "f8", (4,))]
            )
            table["values_block_0"] = COLUMNS["frame"][:, None]
            table["values_block_1"] = np.concatenate([COLUMNS["t"][:, None], xyz], axis=1)
            group["table"] = table
            for place, names in enumerate((["frame"], ["t", "x", "y", "z"])):
                group["table"].attrs[f"values_block_{place}_kind"] = np.bytes_(pickle.dumps(names, 0))
        else:
            group["axis0"], group["axis1"] = np.bytes_(["frame", "t", *"xyz"]), np.arange(len(xyz))
            group["axis1"].attrs["name"] = np.bytes_(b"N.")
            group["block0_items"], group["block0_values"] = np.bytes_(["frame"]), COLUMNS["frame"][:, None]
            group["block1_items"] = np.bytes_(["t", *"xyz"])
            group["block1_values"] = np.concatenate([COLUMNS["t"][:, None], xyz], axis=1)


def write(folder, form: str):
    """The table in one of its forms; the path."""
    path = folder / f"a.{form.split()[0]}"
    if form == "npy":
        np.save(path, structured(">"))
    elif form == "npz records":
        np.savez(path, structured())
    elif form == "npz columns":
        np.savez(path, **COLUMNS, names=np.array(["a", "b"]))
    elif form == "npz points":
        xyz = np.stack([COLUMNS[axis] for axis in "xyz"], axis=1)
        np.savez(path, points=xyz, **{name: COLUMNS[name] for name in ("frame", "t", "snr")})
    elif form == "h5 table":
        write_pandas(path, "table")
    elif form == "h5 fixed":
        write_pandas(path, "fixed")
    else:
        with h5py.File(path, "w") as file:
            file["log/points"] = structured()
            file["log/people"] = np.zeros(3, [("id", "i4"), ("name", "S4")])
    return path


FORMS = ["npy", "npz records", "npz columns", "npz points", "h5 table", "h5 fixed", "h5 records"]


@pytest.mark.parametrize("form", FORMS)
def test_a_table_in_a_file_of_arrays_is_read_as_one_of_text(tmp_path, form):
    path = write(tmp_path, form)
    run = told("prepare", "clouds", path, "-o", tmp_path / "out.h5", "--jobs", 1, "--item-seconds", 0)
    assert not run.returncode and "frames by column 'frame', times by column 't'" in run.stderr, run.stderr
    with CloudsReader(tmp_path / "out.h5") as reader:
        sample = reader.read(0)
    assert np.array_equal(sample.points, np.float32(np.stack([COLUMNS[axis] for axis in "xyz"], axis=1)))
    assert np.diff(sample.frame_offsets).tolist() == [POINTS] * FRAMES
    assert np.allclose(sample.time, np.arange(FRAMES) * 0.1)


@pytest.mark.parametrize("form", ["table", "fixed"])
def test_tables_of_single_clouds_are_read_by_the_names_of_their_columns(tmp_path, form):
    """In a folder, too, where their first number isn't x, and beside the index of PyTables that was never written."""
    for place in range(2):
        write_pandas(tmp_path / f"{place}.h5", form)
        with h5py.File(tmp_path / f"{place}.h5", "r+") as file:  # the column of whole numbers tells no frames here
            item = file["df/table"].attrs if form == "table" else file["df"]
            key, names = (
                ("values_block_0_kind", pickle.dumps(["level"], 0)) if form == "table" else ("block0_items", "level")
            )
            del item[key]
            item[key] = np.bytes_(names) if form == "table" else np.bytes_([names])
            file.create_dataset("_i_table/index/indicesLR", (131072,), "i4", chunks=(1024,), compression="gzip")
    run = told("prepare", "clouds", tmp_path, "-o", tmp_path / "out.h5", "--jobs", 1, "--item-seconds", 0)
    assert not run.returncode and "1 sequence of 2 frames" in run.stderr, run.stderr
    with CloudsReader(tmp_path / "out.h5") as reader:
        sample = reader.read(0)
    expected = np.float32(np.stack([COLUMNS[axis] for axis in "xyz"], axis=1))
    assert np.array_equal(sample.points, np.concatenate([expected, expected]))


@pytest.mark.parametrize(
    ("units", "meters"), [("1e-3 m", 1e-3), ("0.01 m", 1e-2), ("in", 0.0254), ("\u00b5m", 1e-6), ("m/s", 1)]
)
def test_units_are_read_as_netcdf_may_write_them(tmp_path, units, meters):
    """With a factor before them, and with a letter beyond ASCII; a speed is no length."""
    points = RNG.normal(size=(4, 50, 3))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["points"] = points
        file["points"].attrs["units"] = units
    run = told("prepare", "clouds", tmp_path / "a.h5", "-o", tmp_path / "out.h5", "--jobs", 1, "--item-seconds", 0)
    assert not run.returncode, run.stderr
    assert ("attribute units says 'm/s', no length" in run.stderr) == (units == "m/s")
    with CloudsReader(tmp_path / "out.h5") as reader:
        assert np.allclose(reader.read(0).points.reshape(points.shape), points * meters, atol=0, rtol=1e-5)


@pytest.mark.parametrize(("unit", "meters"), [("mm", 1e-3), ("degrees_east", 1)])
@pytest.mark.parametrize("form", ["points", "x y z", "table"])
def test_units_of_data_sets_count_in_files_of_one_cloud(tmp_path, form, unit, meters):
    """What is no length is told."""
    points = RNG.normal(size=(50, 3)) * 100
    (tmp_path / "in").mkdir()
    with h5py.File(tmp_path / "in/0.h5", "w") as file:
        if form == "points":
            file["points"] = points
        elif form == "table":
            file["points"] = np.rec.fromarrays(points.T, names="x,y,z")
        else:
            file["x"], file["y"], file["z"] = points.T
        for item in file.values():
            item.attrs["units"] = unit
    run = told("prepare", "clouds", tmp_path / "in", "-o", tmp_path / "out.h5", "--jobs", 1, "--item-seconds", 0)
    assert not run.returncode, run.stderr
    assert ("converted from mm to m" if unit == "mm" else "'degrees_east', no length") in run.stderr
    with CloudsReader(tmp_path / "out.h5") as reader:
        assert np.allclose(reader.read(0).points, points * meters)


@pytest.mark.parametrize("form", ["npy", "npz columns", "npz points", "h5 records"])
def test_further_columns_and_sequences_are_taken_where_that_is_asked_for(tmp_path, form):
    reader = TableSequences(write(tmp_path, form), sequence_column="frame", frame_column="t", keep=("snr",))
    items = reader.items()
    assert [item.name for item in items] == [f"a/{frame}" for frame in range(FRAMES)]
    kept = [reader.read(item, np.random.default_rng(0)).sequence.extra["field_snr"] for item in items]
    assert np.array_equal(np.concatenate(kept), COLUMNS["snr"])


@pytest.mark.parametrize("column", ["npy", "npz columns", "npz points", "h5 table", "h5 fixed", "h5 records"])
def test_a_folder_of_tables_is_not_taken_for_frames(tmp_path, column):
    """Each row of which would lose its frame."""
    (tmp_path / "in").mkdir()
    path = write(tmp_path / "in", column)
    path.with_name("b" + path.suffix).write_bytes(path.read_bytes())
    words = ("prepare", "clouds", path.parent, "-o", tmp_path / "out.h5", "--jobs", 1, "--item-seconds", 0)
    run = told(*words)
    assert run.returncode == 3 and "'frame' numbers 6 frames; --frame-column frame makes them a sequence" in run.stderr
    run = told(*words, "--frame-column", "frame")
    assert not run.returncode and "2 sequences in 2 tables" in run.stderr and "left out" not in run.stderr


def test_units_of_columns_count(tmp_path):
    """As attributes of HDF5 tell them: places in millimeters, times in milliseconds."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, values in COLUMNS.items():
            file[name] = values * 1000 if name == "t" else values
        file["x"].attrs["units"], file["t"].attrs["units"] = "mm", "ms"
    reader = TableSequences(tmp_path / "a.h5")
    sample = reader.read(reader.items()[0], np.random.default_rng(0)).sequence
    assert np.allclose(sample.points[:, 1], COLUMNS["y"] / 1000) and np.allclose(sample.time, np.arange(FRAMES) * 0.1)


def test_columns_of_matlab_are_a_table(tmp_path):
    """As version 7.3 has vectors: rows or columns of HDF5 in the other order."""
    with h5py.File(tmp_path / "a.mat", "w", userblock_size=512) as file:
        for name, values in COLUMNS.items():
            file[name] = values[None]
    reader = TableSequences(tmp_path / "a.mat")
    sample = reader.read(reader.items()[0], np.random.default_rng(0)).sequence
    assert np.allclose(sample.points[:, 1], COLUMNS["y"]) and np.allclose(sample.time, np.arange(FRAMES) * 0.1)


def test_units_of_columns_that_differ_are_refused(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, values in COLUMNS.items():
            file[name] = values
        for name, unit in zip("xyz", ("mm", "mm", "m")):
            file[name].attrs["units"] = unit
    run = told("prepare", "clouds", tmp_path / "a.h5", "-o", tmp_path / "out.h5", "--jobs", 1, "--item-seconds", 0)
    assert run.returncode == 3 and "different units (m, mm)" in run.stderr


@pytest.mark.parametrize("place", ["columns", "table"])
@pytest.mark.parametrize("form", ["h5", "parquet", "feather"])
@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize(("unit", "meters"), [("mm", 1e-3), ("pixels", 1)])
def test_units_beside_columns_count_in_every_form_of_table(tmp_path, form, wide, place, unit, meters):
    """As attributes of HDF5 and metadata of Arrow's fields and schemas tell them: places in millimeters, times in milliseconds.
    What is no length is told.
    """
    coordinates = [f"{part}_{axis}" for part in "ab" for axis in "xyz"] if wide else list("xyz")
    columns = {"frame": np.arange(4), "time": np.arange(4) * 40} | {name: np.arange(4) + 0.5 for name in coordinates}
    units = {"time": "ms", **dict.fromkeys(coordinates[:-1], unit)}
    units = units if place == "columns" else {"time": "ms"}
    path = tmp_path / f"a.{form}"
    if form == "h5":
        with h5py.File(path, "w") as file:
            if place == "table":
                file["log"] = np.rec.fromarrays(list(columns.values()), names=list(columns))
                file["log"].attrs["units"] = unit
            else:
                for name, one in columns.items():
                    file[name] = one
                    file[name].attrs["units"] = units.get(name, "")
    else:
        arrow = pytest.importorskip("pyarrow")
        fields = [
            arrow.field(
                name, arrow.from_numpy_dtype(one.dtype), metadata={"units": units[name]} if name in units else {}
            )
            for name, one in columns.items()
        ]
        schema = arrow.schema(fields, metadata={"unit": unit} if place == "table" else {})
        table = arrow.table([arrow.array(one) for one in columns.values()], schema=schema)
        write = import_module(f"pyarrow.{form}")
        (write.write_table if form == "parquet" else write.write_feather)(table, path)
    track = ("--track", "columns") if wide else ()
    words = ("prepare", "clouds", path, "-o", tmp_path / "out.h5", "--jobs", 1, "--item-seconds", 0)
    run = told(*words, *track)
    assert not run.returncode and ("'pixels', no length that is known" in run.stderr) == (unit == "pixels")
    with CloudsReader(tmp_path / "out.h5") as reader:
        sample = reader.read(0)
    assert np.allclose(sample.points[:: 2 if wide else 1, 2], (np.arange(4) + 0.5) * meters)
    if (form, place) != ("h5", "table"):
        assert np.allclose(sample.time, np.arange(4) * 0.04)


@pytest.mark.parametrize("kind", ["u2", "i2", "u4", "u8"])
def test_whole_times_may_fall_from_row_to_row(tmp_path, kind):
    """A difference below 0 has no place among unsigned numbers, one above half of their range none among small ones."""
    stamps = np.array([30_000, 0, 65_000 if kind[0] == "u" else -30_000]).astype(kind)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in ("frame", *"xyz"):
            file[name] = np.arange(3.0)
        file["t"] = stamps
        file["t"].attrs["units"] = "ms"
    table = ArrayTable(tmp_path / "a.h5")
    assert np.allclose(table.moments(table.names.index("t")), (stamps.astype(float) - 30_000) / 1000)


def test_a_type_that_has_a_name_is_no_table(tmp_path):
    """As netCDF keeps the compound types of its variables."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["kind"], file["log"] = structured().dtype, structured()
    assert ArrayTable(tmp_path / "a.h5").names == tuple(COLUMNS)


def test_rows_that_are_frames_are_read_where_that_is_asked_for(tmp_path):
    table = np.zeros(
        FRAMES, [("time", "f8"), *((f"{part}_{axis}", "f8") for part in ("hip", "knee") for axis in "xyz")]
    )
    table["time"], table["hip_x"], table["knee_y"] = np.arange(FRAMES) / 4, np.arange(FRAMES), 7
    np.save(tmp_path / "a.npy", table)
    words = ("prepare", "clouds", tmp_path / "a.npy", "-o", tmp_path / "out.h5", "--jobs", 1, "--item-seconds", 0)
    run = told(*words)
    assert run.returncode == 3 and "give --track columns" in run.stderr
    assert not told(*words, "--track", "columns").returncode
    with CloudsReader(tmp_path / "out.h5") as reader:
        sample = reader.read(0)
    assert np.array_equal(sample.points.reshape(FRAMES, 2, 3)[:, 1], np.tile(np.float32([0, 7, 0]), (FRAMES, 1)))
    assert np.allclose(sample.time, np.arange(FRAMES) / 4)


def test_a_pickle_of_names_is_not_loaded(tmp_path):
    """Whatever it would do: its texts alone are looked at."""
    write_pandas(tmp_path / "a.h5", "table")

    class Harm:
        def __reduce__(self):
            return (tmp_path.joinpath("harm").mkdir, ())

    with h5py.File(tmp_path / "a.h5", "a") as file:
        file["df/table"].attrs["values_block_1_kind"] = np.bytes_(pickle.dumps([Harm(), "t", "x", "y", "z"], 0))
    run = told("prepare", "clouds", tmp_path / "a.h5", "-o", tmp_path / "out.h5", "--jobs", 1, "--item-seconds", 0)
    assert run.returncode == 3 and not (tmp_path / "harm").exists()


def test_several_tables_are_named(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["one"], file["other"] = structured(), structured()
    run = told("prepare", "clouds", tmp_path / "a.h5", "-o", tmp_path / "out.h5", "--jobs", 1, "--item-seconds", 0)
    assert run.returncode == 3 and "one, other" in run.stderr


def test_a_unit_of_a_whole_table_counts_and_an_empty_one_is_said_to_be(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["log"] = structured()
        file["log"].attrs["units"] = "mm"
    reader = TableSequences(tmp_path / "a.h5")
    sample = reader.read(reader.items()[0], np.random.default_rng(0)).sequence
    assert np.allclose(sample.points[:, 2], COLUMNS["z"] / 1000)
    np.save(tmp_path / "b.npy", structured()[:0])
    run = told("prepare", "clouds", tmp_path / "b.npy", "-o", tmp_path / "out.h5", "--jobs", 1, "--item-seconds", 0)
    assert run.returncode == 3 and "a table without rows" in run.stderr


@pytest.mark.parametrize("form, name", [("table", "table"), ("fixed", "block1_values"), ("fixed", "axis1")])
def test_nothing_is_read_from_the_files_that_a_table_of_pandas_names(tmp_path, form, name):
    for file in ("a.h5", "other.h5"):
        write_pandas(tmp_path / file, form)
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        del file["df"][name]
        file["df"][name] = h5py.ExternalLink("other.h5", f"/df/{name}")
    with pytest.raises(DataError, match=f"a.h5: no data set '{name}' of its own; found "):
        ArrayTable(tmp_path / "a.h5")
