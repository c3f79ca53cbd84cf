"""RVL: what an independent writer packs is unpacked equal; damaged words are named and never read beyond their end."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from dpcli.errors import DataError
from dpcli.prepare.recordings.rvl import unpack_rvl
from tests.support.recording_helpers import pack_rvl

DEPTHS = st.tuples(st.integers(1, 9), st.integers(1, 9)).flatmap(
    lambda size: arrays(np.uint16, size, elements=st.one_of(st.just(0), st.integers(0, 65535), st.integers(900, 910)))
)


@settings(deadline=None)  # the first example compiles the kernel
@given(DEPTHS)
def test_what_was_packed_is_unpacked(depth):
    assert np.array_equal(unpack_rvl(Path("a.bag"), pack_rvl(depth)), depth)


def test_a_long_run_of_nothing_and_steps_over_the_whole_range():
    depth = np.zeros((200, 400), np.uint16)
    depth[-1, -3:] = 65535, 1, 65535
    assert np.array_equal(unpack_rvl(Path("a.bag"), pack_rvl(depth)), depth)


@given(DEPTHS, st.data())
def test_damaged_words_are_named(depth, data):
    packed = bytearray(pack_rvl(depth))
    cut = data.draw(st.integers(0, len(packed)))
    for at in data.draw(st.lists(st.integers(0, len(packed) - 1), max_size=3)):
        packed[at] ^= data.draw(st.integers(1, 255))
    try:
        unpack_rvl(Path("a.bag"), bytes(packed[:cut]))
    except DataError as error:
        assert "a.bag" in str(error)


@pytest.mark.parametrize(
    "data",
    [b"", b"\0" * 7, b"\0" * 8, b"\2\0\0\0\2\0\0\0", b"\2\0\0\0\xff\xff\xff\xff", b"\2\0\0\0\2\0\0\0" + b"\xff" * 8],
)
def test_what_holds_no_picture_is_named(data):
    with pytest.raises(DataError, match="it is damaged"):
        unpack_rvl(Path("a.bag"), data)
