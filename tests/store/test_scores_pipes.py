"""Scores files, and `-`: one code path for files, redirected files and pipes."""

from __future__ import annotations

import io

import h5py
import numpy as np
import pytest

from dpcli.errors import DataError, UsageError
from dpcli.store import ScoresReader, ScoresWriter, input_file, output_file


def write(path, rows=4, **options):
    rng = np.random.default_rng(0)
    with ScoresWriter(path, class_names=["a", "b"], streams=("static",), **options) as writer:
        for i in range(rows):
            writer.write(f"v{i}", rng.random(2), label=i % 2, split="test", streams={"static": rng.random(2)})
    return path


def test_round_trip(tmp_path):
    scores = ScoresReader(write(tmp_path / "s.h5", provenance=[{"command": "one"}, {"command": "two"}]))
    rng = np.random.default_rng(0)
    expected = rng.random((4, 2, 2)).astype(np.float32)
    assert np.array_equal(scores.scores, expected[:, 0]) and np.array_equal(scores.streams["static"], expected[:, 1])
    assert scores.names == ["v0", "v1", "v2", "v3"] and scores.labels.tolist() == [0, 1, 0, 1]
    assert [entry["command"] for entry in scores.provenance] == ["one", "two"]
    assert scores.attributes["command"] == "two"


def test_bad_rows_are_refused(tmp_path):
    with (
        pytest.raises(DataError, match="2 finite numbers"),
        ScoresWriter(tmp_path / "s.h5", class_names=["a", "b"]) as writer,
    ):
        writer.write("v", np.array([0.5, np.nan]))
    for name, row, told in (("a\0b", np.ones(1), "holds NUL"), ("v", np.array([1e39]), "1 finite numbers")):
        with pytest.raises(DataError, match=told), ScoresWriter(tmp_path / "s.h5", class_names=["a"]) as writer:
            writer.write(name, row)
    with pytest.raises(DataError, match="not one sample"), ScoresWriter(tmp_path / "s.h5", class_names=["a"]):
        pass
    with (
        pytest.raises(DataError, match="streams"),
        ScoresWriter(tmp_path / "s.h5", class_names=["a"], streams=("x",)) as writer,
    ):
        writer.write("v", np.array([1.0]))
    for told, names, labels in (
        ("label 2, expected -1 .unknown. or 0 to 1", "vw", (0, 2)),
        ("label -2", "vw", (-1, -2)),
        ("'v': the name appears twice", "vv", (0, 1)),
    ):
        with pytest.raises(DataError, match=told), ScoresWriter(tmp_path / "s.h5", class_names=["a", "b"]) as writer:
            for name, label in zip(names, labels):
                writer.write(name, np.ones(2), label=label)
    with pytest.raises(DataError, match="1 class names repeat, such as 'a'"):
        ScoresWriter(tmp_path / "s.h5", class_names=["a", "b", "a"])
    with pytest.raises(DataError, match="a stream called 'a/b'"):
        ScoresWriter(tmp_path / "s.h5", class_names=["a"], streams=("a/b",))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("scores", np.ones((4, 3), np.float32), "samples, classes"),
        ("scores", np.full((4, 2), np.nan, np.float32), "4 of 4 samples with NaN or infinite scores, the first 'v0'"),
        (
            "scores",
            np.float32([[0, 1], [0, np.inf], [0, 0], [np.nan, 1]]),
            "2 of 4 samples .*, the first 'v1'; predict",
        ),
        ("label", np.array([0, 1, 2, 0], np.int32), "label 2 of 'v2'"),
        ("label", np.array([0, -1, -2, 0], np.int32), "label -2 of 'v2'"),
        ("name", ["v0", "v0", "v2", "v3"], "names repeat"),
        ("class_names", ["a", "a"], "1 class names repeat, such as 'a'"),
        ("class_names", np.arange(2), "'class_names' holds something else .*expected str"),
        ("class_names", [b"a", b"\xff"], "'class_names' is not UTF-8"),
        ("label", ["0", "1", "0", "1"], "'label' holds something else .*expected i32"),
        ("label", np.float32([0, 1, 0, 0.5]), "'label' holds something else .*expected i32"),
        ("label", np.int32(3), "'label' holds something else"),
        ("scores", None, "'scores' holds something else .a group., expected f32"),
        ("streams/static", None, "'streams/static' holds something else .*expected f32"),
        ("streams", np.ones(3), "'streams' holds something else .*expected a group of f32"),
        ("streams", np.ones((4, 2), np.float32), "'streams' holds something else .*expected a group of f32"),
        ("provenance", ["[1, 2]"], r"provenance holds \[1, 2\], expected a command's JSON object"),
    ],
)
def test_bad_files_are_refused(tmp_path, name, value, message):
    path = write(tmp_path / "s.h5")
    with h5py.File(path, "r+") as file:
        del file[name]
        if value is None:
            file.create_group(name)
        else:
            file[name] = value
    with pytest.raises(DataError, match=message):
        ScoresReader(path)


@pytest.mark.parametrize(
    ("key", "value"), [("dpc_schema", "a"), ("dpc_schema", [1, 1]), ("dpc_kind", [1, 2]), ("dpc_kind", 3)]
)
def test_bad_root_attributes_are_refused(tmp_path, key, value):
    path = write(tmp_path / "s.h5")
    with h5py.File(path, "r+") as file:
        file.attrs[key] = value
    with pytest.raises(DataError, match="schema" if key == "dpc_schema" else "expected 'scores'"):
        ScoresReader(path)


class Terminal(io.BytesIO):
    def isatty(self) -> bool:
        return True


def test_a_pipe_is_spooled_whole(tmp_path):
    data = write(tmp_path / "s.h5").read_bytes()
    with input_file("-", io.BytesIO(data)) as path:
        assert path.read_bytes() == data
    assert not path.exists()


def test_a_redirected_file_is_used_directly(tmp_path):
    path = write(tmp_path / "s.h5")
    with open(path, "rb") as stream, input_file("-", stream) as found:
        assert found.samefile(path)


def test_a_redirected_file_that_was_removed_is_read_all_the_same(tmp_path):
    path = write(tmp_path / "s.h5")
    data = path.read_bytes()
    with open(path, "rb") as stream:
        path.unlink()
        with input_file("-", stream) as found:
            assert found.read_bytes() == data


@pytest.mark.parametrize("error", [DataError, UsageError])
def test_a_message_names_the_stream_and_not_its_copy(error):
    with pytest.raises(error, match="^stdin: no; `dpc info -`$"), input_file("-", io.BytesIO(b"some")) as path:
        raise error(f"{path}: no; `dpc info {path}`")
    with pytest.raises(error, match="^stdout: not one$"), output_file("-", io.BytesIO()) as path:
        raise error(f"{path}: not one")


def test_empty_pipe_and_terminal_end_with_a_sentence():
    with pytest.raises(DataError, match="wrote nothing"), input_file("-", io.BytesIO(b"")):
        pass
    with pytest.raises(UsageError, match="stdin is a terminal"), input_file("-", Terminal()):
        pass
    with pytest.raises(UsageError, match="refusing to write HDF5"), output_file("-", Terminal()):
        pass


def test_output_reaches_stdout_only_when_whole(tmp_path):
    stream = io.BytesIO()
    with output_file("-", stream) as path:
        write(path)
        assert stream.getvalue() == b""
    assert stream.getvalue()[1:4] == b"HDF"
    stream = io.BytesIO()
    with pytest.raises(ZeroDivisionError), output_file("-", stream) as path:
        path.write_bytes(b"half")
        raise ZeroDivisionError
    assert stream.getvalue() == b""


@pytest.mark.parametrize(("name", "told"), [("s.h5", False), ("s.PNG", True), ("s.csv", True), ("s.scores", False)])
def test_a_name_of_another_form_is_told(name, told, tmp_path, capsys):
    with ScoresWriter(tmp_path / name, class_names=["a", "b"]) as writer:
        writer.write("v", np.array([0.5, 0.5], np.float32))
    assert ("is written as HDF5, not as" in capsys.readouterr().err) is told
    assert ScoresReader(tmp_path / name).names == ["v"]
