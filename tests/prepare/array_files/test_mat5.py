"""MATLAB files: what SciPy writes is read as SciPy reads it; damaged ones end with a sentence, never with the process."""

from __future__ import annotations

import itertools
import struct
import subprocess
import sys
import zlib

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from dpcli.errors import DataError
from dpcli.prepare.array_files.mat5 import read_mat5, read_variables
from tests.support.commands import told as dpc
from tests.support.prepare_helpers import write_msr

RNG = np.random.default_rng(0)
TYPES = ["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8"]


@pytest.mark.parametrize("compressed", [True, False])
@pytest.mark.parametrize("kind", TYPES)
def test_arrays_are_read_as_scipy_reads_them(tmp_path, kind, compressed):
    for shape in [(2, 3, 4), (1, 1), (5, 0, 2), (3, 2), (40, 30, 7)]:
        values = RNG.integers(0, 100, shape).astype(kind)
        others = {"before": np.arange(9.0), "text": "abc", "depth": values, "z": [[1, 2]]}
        savemat(tmp_path / "a.mat", others, do_compression=compressed)
        found, known = read_mat5(tmp_path / "a.mat", "depth"), loadmat(tmp_path / "a.mat")["depth"]
        assert found.dtype == known.dtype and found.shape == known.shape and np.array_equal(found, known)


@pytest.mark.parametrize("compressed", [True, False])
def test_fields_of_structs_are_read_as_matlab_7_3_has_them(tmp_path, compressed):
    """A struct, one in it, an array of structs whose fields become lists, or arrays of single numbers; texts are passed over."""
    frames = [RNG.normal(size=(count, 3)) for count in (4, 9, 1)]
    structs = np.array(
        [(frame, t / 10, "x") for t, frame in enumerate(frames)], [(n, object) for n in ("xyz", "t", "who")]
    )
    cell = np.empty(3, object)
    cell[:] = frames
    one = {
        "points": RNG.normal(size=(2, 5, 3)),
        "name": "walk",
        "deep": {"deeper": {"a": 1.0, "b": cell}},
        "cell": cell,
        "a_rather_long_name": 7,
    }
    savemat(tmp_path / "a.mat", {"one": one, "many": structs, "none": {}, "plain": [1, 2]}, do_compression=compressed)
    found = read_variables(tmp_path / "a.mat")
    deep = {"one/deep/deeper/a", "one/deep/deeper/b"}
    assert set(found) == {"one/points", "one/cell", "one/a_rather_long_name", "many/xyz", "many/t", "plain", *deep}
    assert np.array_equal(found["one/points"], one["points"]) and found["one/a_rather_long_name"] == 7
    assert all(
        np.array_equal(a, b)
        for name in ("one/cell", "many/xyz", "one/deep/deeper/b")
        for a, b in zip(found[name], frames, strict=True)
    )
    assert isinstance(found["many/t"], np.ndarray) and np.allclose(found["many/t"], [0, 0.1, 0.2])


def test_damaged_structs_end_with_a_sentence(tmp_path):
    points = np.arange(30.0).reshape(2, 5, 3)
    savemat(tmp_path / "a.mat", {"one": {"points": points, "t": [0.1, 0.2]}})
    whole, read = (tmp_path / "a.mat").read_bytes(), 0
    for _ in range(3000):
        data = bytearray(whole)
        for at in RNG.integers(128, len(data), RNG.integers(1, 4)):
            data[at] = RNG.integers(256)
        (tmp_path / "a.mat").write_bytes(data[: RNG.integers(130, 2 * len(data))])
        try:
            read += "one/points" in read_variables(tmp_path / "a.mat")
        except DataError:
            pass
    assert 100 < read < 3000


def test_big_endian_and_numbers_stored_in_fewer_bytes(tmp_path):
    """As a Sun wrote a double array whose values are small: stored as bytes."""

    def element(kind: int, content: bytes) -> bytes:
        return struct.pack(">II", kind, len(content)) + content + bytes(-len(content) % 8)

    head = b"MATLAB 5.0".ljust(124) + b"\x01\x00MI"
    inside = element(6, struct.pack(">II", 6, 0)) + element(5, struct.pack(">iii", 2, 1, 3)) + element(1, b"depth")
    path = tmp_path / "a.mat"
    path.write_bytes(head + element(14, inside + element(2, bytes([1, 2, 3, 4, 5, 6]))))
    assert read_mat5(path, "depth").tolist() == [[[1.0, 3.0, 5.0]], [[2.0, 4.0, 6.0]]]
    assert np.array_equal(read_mat5(path, "depth"), loadmat(path)["depth"])


def little(kind: int, content: bytes) -> bytes:
    return struct.pack("<II", kind, len(content)) + content + bytes(-len(content) % 8)


HEAD = b"MATLAB 5.0".ljust(124) + b"\x00\x01IM"
FLAGS, NAME = little(6, struct.pack("<II", 9, 0)), little(1, b"depth")


def packed(content: bytes) -> bytes:
    squeezed = zlib.compress(content)
    return struct.pack("<II", 15, len(squeezed)) + squeezed  # not filled up to a multiple of 8


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (b"", "no variable 'depth'; found none"),
        (b"\x0e\0\0\0\xff\xff\xff\x7f", "an element of 2147483647 bytes"),
        (little(14, FLAGS + little(5, struct.pack("<iii", -2, -3, 1)) + NAME), "of shape"),
        (little(14, FLAGS + little(5, struct.pack("<iii", 2, 3, 4)) + NAME + little(2, b"abc")), "has 3 numbers"),
        (little(14, FLAGS + little(5, struct.pack("<iii", 1 << 20, 1 << 20, 9)) + NAME), "takes more than"),
        (little(14, FLAGS + little(5, b"abcd") + NAME), "without type or shape"),
        (little(14, little(14, FLAGS * 3)), "without type or shape"),
        (little(15, b"no zlib stream"), "incorrect header"),
        (packed(bytes(1 << 26)), "no variable"),
        (little(14, FLAGS + little(5, struct.pack("<ii", 1, 3)) + NAME + little(77, b"abc")), "has no numbers"),
    ],
)
def test_damaged_files_end_with_a_sentence(tmp_path, body, said):
    (tmp_path / "a.mat").write_bytes(HEAD + body)
    with pytest.raises(DataError, match=said):
        read_mat5(tmp_path / "a.mat", "depth")


@pytest.mark.parametrize("content", [b"", b"MATLAB", bytes(127), bytes(400)])
def test_what_is_no_such_file_is_refused(tmp_path, content):
    (tmp_path / "a.mat").write_bytes(content)
    with pytest.raises(DataError, match="not a MATLAB file of version 5 or 7.3"):
        read_mat5(tmp_path / "a.mat", "depth")


_FUZZ = """
import sys
from pathlib import Path
from dpcli.errors import DataError
from dpcli.prepare.array_files.mat5 import read_mat5
from tests.prepare.array_files.test_mat5 import mutants
path, read = Path(sys.argv[1]), 0
for mutant in mutants(path.parent, int(sys.argv[2])):
    path.write_bytes(mutant)
    try:
        read += read_mat5(path, "depth").size >= 0
    except DataError:
        pass
print(read)
"""


def mutants(folder, count):
    """Yields files with words, bytes and lengths exchanged, or cut."""
    rng, seeds = np.random.default_rng(count), []
    for compressed, kind in itertools.product((True, False), ("u2", "f8")):
        savemat(folder / "seed.mat", {"depth": np.ones((4, 5, 3), kind), "b": "x"}, do_compression=compressed)
        seeds.append((folder / "seed.mat").read_bytes())
    for _ in range(count):
        data = bytearray(seeds[rng.integers(4)])
        for _ in range(rng.integers(1, 5)):
            at = int(rng.integers(120, len(data)))
            if rng.random() < 0.5:
                data[at & ~3 : (at & ~3) + 4] = struct.pack(
                    "<I", int(rng.choice([0, 1, 14, 15, 0x20001, 1 << 31, 0xFFFFFFFF, 8, 77]))
                )
            else:
                data[at] = rng.integers(256)
        yield bytes(data[: len(data) if rng.random() < 0.8 else int(rng.integers(len(data)))])


def test_a_fuzz_never_ends_the_process(tmp_path):
    done = subprocess.run([sys.executable, "-c", _FUZZ, tmp_path / "a.mat", "2000"], capture_output=True, timeout=200)
    assert done.returncode == 0, done.stderr[-2000:]
    assert 100 < int(done.stdout) < 2000


def test_one_damaged_file_is_one_sample_lost(tmp_path):
    raw = write_msr(tmp_path / "raw", ["a01_s01_e01", "a02_s02_e02"])
    (raw / "a03_s03_e01_sdepth.mat").write_bytes(
        HEAD + little(14, FLAGS + little(5, struct.pack("<iii", 2, 3, 4)) + NAME)
    )
    done = dpc("prepare", "msraction3d", raw, "-o", tmp_path / "o.h5", "--jobs", "2")
    assert done.returncode == 0 and "a03_s03_e01: " in done.stderr and "2 sequences" in done.stdout
