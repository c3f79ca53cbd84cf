"""The table of seed streams: numbers that never change, none of them twice in a room, and none outside of the table."""

from __future__ import annotations

import ast
from enum import IntEnum
from pathlib import Path

import numpy as np
import pytest

from dpcli.runtime import seeds
from dpcli.runtime.seeds import ClassifyStream, Generate4DStream, PrepareStream, SegmentStream, generator, torch_seed

PACKAGE = Path(seeds.__file__).parents[1]
TABLES = [value for value in vars(seeds).values() if isinstance(value, type) and issubclass(value, IntEnum)][1:]


def literal_streams(text: str) -> list[str]:
    """The calls in a module that name a stream by a bare number."""
    calls = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call)]
    named = [call for call in calls if getattr(call.func, "id", getattr(call.func, "attr", "")) in NAMES]
    keys = [(call, key) for call in named for key in call.args + sum((getattr(a, "elts", []) for a in call.args), [])]
    return [ast.unparse(call) for call, key in keys if isinstance(key, ast.Constant) and key.value != 0]


NAMES = ("generator", "torch_seed", "SeedSequence", "default_rng")


def test_the_tables_are_found():
    assert TABLES == [PrepareStream, ClassifyStream, SegmentStream, Generate4DStream]


@pytest.mark.parametrize("table", TABLES)
def test_no_two_streams_of_a_room_collide(table):
    assert len(table.__members__) == len({int(stream) for stream in table})


def test_no_stream_is_a_bare_number_in_the_code():
    found = {path.name: literal_streams(path.read_text()) for path in PACKAGE.rglob("*.py")}
    assert {name: calls for name, calls in found.items() if calls} == {}
    assert literal_streams("a = generator(seed, 7004, k)") and literal_streams("np.random.SeedSequence([s, 4001])")


def test_streams_give_what_their_numbers_gave_and_keep_apart():
    same = generator(3, 7002, 5).random(4)
    np.testing.assert_array_equal(generator(3, SegmentStream.PAIR_ORDER, 5).random(4), same)
    assert torch_seed(3, SegmentStream.TURN, 9) == int(np.random.SeedSequence([3, 7003, 9]).generate_state(1)[0])
    assert generator(0, 1).random() != generator(0, 1, 0).random()
    assert generator(1, 2).random() != generator(2, 1).random()
