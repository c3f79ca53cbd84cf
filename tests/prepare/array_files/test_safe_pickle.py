"""Pickles of arrays: all honest ones load as NumPy loads them; forged and broken ones reach no name, no memory and no crash."""

from __future__ import annotations

import io
import itertools
import pickle
import struct
import subprocess
import sys

import numpy as np
import pytest

from dpcli.prepare.array_files import safe_pickle
from dpcli.prepare.array_files.safe_pickle import load_arrays

RNG = np.random.default_rng(0)
HONEST = {
    "numbers": np.arange(12, dtype=np.float32).reshape(3, 4),
    "columns": np.asfortranarray(RNG.normal(size=(3, 5))),
    "big endian": np.arange(4, dtype=">i2"),
    "truth": np.array([True, False]),
    "texts": np.array(["ab", "çd"]),
    "bytes": np.array([b"ab", b"c"]),
    "complex": np.array([1 + 2j]),
    "nothing": np.zeros((0, 3)),
    "of arrays": np.array([np.ones((2, 3)), np.zeros((1, 3), np.float32), None], dtype=object),
    "dict": {"cam": [np.eye(4)] * 4, 1: np.eye(4), "n": np.float32(2.5), "names": ("a", b"b", 2**70)},
}


def stack(*steps: bytes) -> bytes:
    return b"\x80\x02" + b"".join(steps) + b"."


def name(module: str, attribute: str) -> bytes:
    return f"c{module}\n{attribute}\n".encode()


def pickled(value: object) -> bytes:
    return pickle.dumps(value, protocol=2)[2:-1]


ARRAY, DTYPE = name("numpy", "ndarray"), name("numpy", "dtype")
RECONSTRUCT = name("numpy.core.multiarray", "_reconstruct")
EMPTY = RECONSTRUCT + ARRAY + pickled((0,)) + pickled("b") + b"\x87R"
FIELDS = pickled((3, "|", None, ("a",)))[:-1]  # without the end of its tuple


def dtype(code: str, state: object = None) -> bytes:
    return DTYPE + pickled((code, 0, 1)) + b"R" + (pickled(state) + b"b" if state is not None else b"")


def array(shape: object, element: bytes, values: object) -> bytes:
    return EMPTY + b"(" + pickled(1) + pickled(shape) + element + pickled(False) + pickled(values) + b"tb"


FORGED = {
    "a field far outside the array": stack(
        DTYPE,
        pickled(("V8", 0, 1)),
        b"R(",
        pickled(3),
        pickled("|"),
        pickled(None),
        pickled(("f",)),
        b"}",
        pickled("f"),
        b"(",
        dtype("f8"),
        pickled(1 << 30),
        b"ts",
        pickled(8),
        pickled(1),
        pickled(16),
        b"tb",
    ),
    "fields put into a plain type": stack(
        DTYPE,
        pickled(("f8", 0, 1)),
        b"R(",
        pickled(3),
        pickled("<"),
        pickled(None),
        pickled(("f",)),
        b"}",
        pickled("f"),
        b"(",
        dtype("O8"),
        pickled(0),
        b"ts",
        pickled(8),
        pickled(1),
        pickled(0),
        b"tb",
    ),
    "another size": stack(dtype("f8", (3, "<", None, None, None, 1 << 30, 8, 0))),
    "a shape in the type": stack(dtype("f8", (3, "<", (3,), None, None, -1, -1, 0))),
    "a composed code": stack(dtype("f4,O8")),
    "a type of a type": stack(DTYPE, b"(", DTYPE, b"tR"),
    "a type of a list": stack(DTYPE, pickled(([("a", "O")], 0, 1)), b"R"),
    "bytes as objects": stack(array((1,), dtype("O8"), b"AAAAAAAA")),
    "numbers as objects": stack(array((1,), dtype("f8"), [0.0])),
    "too few bytes": stack(array((1 << 40,), dtype("f8"), b"AAAAAAAA")),
    "a negative side": stack(array((-1, -1), dtype("f8"), b"AAAAAAAA")),
    "sides that overflow": stack(array((1 << 62, 4), dtype("u1"), b"")),
    "a number of an object": stack(
        name("numpy.core.multiarray", "scalar"), dtype("O8"), pickled(b"AAAAAAAA"), b"\x86R"
    ),
    "a number of few bytes": stack(name("numpy.core.multiarray", "scalar"), dtype("f8"), pickled(b"A"), b"\x86R"),
    "a buffer of objects": stack(
        name("numpy.core.numeric", "_frombuffer"),
        b"(",
        pickled(b"AAAAAAAA"),
        dtype("O8"),
        pickled((1,)),
        pickled("C"),
        b"tR",
    ),
    "a state for a function": stack(RECONSTRUCT, pickled({"__doc__": "no"}), b"b"),
    "attributes for a function": stack(RECONSTRUCT, pickled((None, {"__defaults__": (1,)})), b"b"),
    "an array without a state": stack(ARRAY, pickled((4,)), b"R"),
    "a new object of a class": stack(ARRAY, pickled((4,)), b"\x81"),
    "another encoding": stack(name("_codecs", "encode"), pickled(("x", "zlib")), b"R"),
    "a function of the same module": stack(
        name("numpy.core.multiarray", "fromfile"), pickled(("/etc/hostname",)), b"R"
    ),
    "the system": stack(name("os", "system"), pickled(("true",)), b"R"),
    "a path of attributes": stack(name("numpy", "dtype.__init__.__globals__")),
    "room for a thousand million places": stack(b"N" + b"r" + struct.pack("<I", 1 << 30)),
    "room, written in digits": stack(b"Np1073741824\n"),
    "more bytes than there are": b"\x80\x04\x8e" + struct.pack("<Q", 1 << 40) + b"abc.",
    "an array of bytes that aren't there": b"\x80\x05\x96" + struct.pack("<Q", 1 << 40) + b"abc.",
}


def same(one: object, other: object) -> bool:
    if isinstance(one, (list, tuple)):
        return type(one) is type(other) and len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, dict):
        return list(one) == list(other) and same(list(one.values()), list(other.values()))
    if isinstance(one, np.ndarray) and one.dtype == object:
        return one.shape == other.shape and same(list(one.flat), list(other.flat))
    if isinstance(one, (np.ndarray, np.generic)):
        return one.dtype == other.dtype and one.shape == other.shape and np.array_equal(one, other)
    return type(one) is type(other) and one == other


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize("kind", HONEST)
def test_honest_pickles_load_as_numpy_loads_them(kind, protocol):
    written = pickle.dumps(HONEST[kind], protocol=protocol)
    assert same(pickle.loads(written), load_arrays(io.BytesIO(written)))


def test_a_pickle_of_python_2_loads():
    """As NumPy 1.16 under Python 2.7 wrote np.arange(2.0): values as text."""
    values = b"U\x10" + np.arange(2.0).tobytes()
    old = stack(
        EMPTY,
        b"(K\x01K\x02\x85",
        DTYPE,
        b"U\x02f8K\x00K\x01\x87R(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb",
        b"\x89",
        values,
        b"tb",
    )
    assert load_arrays(io.BytesIO(old)).tolist() == [0.0, 1.0]


@pytest.mark.parametrize("kind", FORGED)
def test_forged_pickles_are_refused(kind):
    with pytest.raises((pickle.UnpicklingError, ValueError)):
        load_arrays(io.BytesIO(FORGED[kind]))


def test_names_of_the_allow_list_are_no_classes_and_take_no_state():
    """NEWOBJ asks for a class, BUILD for something whose attributes can be set."""
    for module, attribute in safe_pickle._ALLOWED:
        found = load_arrays(io.BytesIO(stack(name(module, attribute))))
        assert not isinstance(found, type) and not hasattr(found, "__dict__")
        for state in ({}, {"x": 1}, (None, {"x": 1})):
            with pytest.raises(pickle.UnpicklingError, match="state into a function"):
                load_arrays(io.BytesIO(stack(name(module, attribute), pickled(state), b"b")))


_FUZZ = """
import io, random, sys
import numpy as np
from dpcli.prepare.array_files.safe_pickle import load_arrays
from tests.prepare.array_files.test_safe_pickle import mutants
loaded = 0
for mutant in mutants(int(sys.argv[1]), int(sys.argv[2])):
    try:
        found = load_arrays(io.BytesIO(mutant))
    except (Exception, MemoryError):
        continue
    loaded += 1
    stack = [found]
    for value in stack:  # every array that came out can be read to its last byte
        if isinstance(value, np.ndarray):
            value.tobytes() if value.dtype != object else stack.extend(value.flat)
            str(value)
        elif isinstance(value, (list, tuple)) and len(stack) < 10000:
            stack.extend(value)
print(loaded)
"""


def mutants(seed: int, count: int):
    """Yields damaged and recombined pickles: calls of the allow list on each other's results, states from elsewhere, flipped bytes."""
    rng = np.random.default_rng(seed)
    parts = [name(*known) for known in safe_pickle._ALLOWED] + [
        dtype("f8"),
        dtype("O8"),
        EMPTY,
        array((2,), dtype("f8"), bytes(16)),
    ]
    parts += [
        pickled(value)
        for value in (0, -1, 1 << 31, None, "f8", b"12345678", (2,), (1 << 33,), (), {}, [1.0], ("f8", 0, 1))
    ]
    parts += [
        pickled((3, "<", None, None, None, -1, -1, 0)),
        b"(",
        b"t",
        b"R",
        b"b",
        b"\x81",
        b"\x85",
        b"\x86",
        b"\x87",
        b"q\x00",
        b"h\x00",
        b"0",
        b"2",
        b"s",
        b"a",
    ]
    whole = [*FORGED.values(), *(pickle.dumps(value, protocol=2 + n % 4) for n, value in enumerate(HONEST.values()))]
    for turn in itertools.islice(itertools.count(), count):
        if turn % 2:
            yield stack(*(parts[n] for n in rng.integers(len(parts), size=rng.integers(2, 14))))
            continue
        broken = bytearray(whole[rng.integers(len(whole))])
        for _ in range(rng.integers(1, 5)):
            place, piece = int(rng.integers(len(broken))), parts[rng.integers(len(parts))]
            broken[place : place + int(rng.integers(3))] = piece if rng.random() < 0.4 else bytes([rng.integers(256)])
        yield bytes(broken)


def test_a_fuzz_of_the_allow_list_never_ends_the_process():
    done = subprocess.run([sys.executable, "-c", _FUZZ, "30", "6000"], capture_output=True, timeout=240)
    assert done.returncode == 0, done.stderr[-2000:]
    assert int(done.stdout) > 100  # some are whole, or the fuzz would be of the first byte only
