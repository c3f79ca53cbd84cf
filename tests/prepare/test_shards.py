"""A conversion cut into shards: any cut, merged in any order of the files, gives the bytes of one run."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dpcli.errors import DataError, UsageError
from dpcli.prepare.commands.merge import merge
from dpcli.prepare.pipeline import Conversion, convert
from dpcli.prepare.reader import Item
from dpcli.runtime.machines.shards import Shard, describe_shard, shard_of
from dpcli.runtime.provenance import command_line, file_digest
from dpcli.store import CloudsReader
from dpcli.store.file import read_positions
from tests.support.commands import told as dpc
from tests.support.prepare_helpers import ToyReader

SYNTHETIC = (
    "prepare",
    "synthetic",
    "gestures",
    "--frames",
    "4",
    "--size",
    "48",
    "--videos-per-class",
    "1",
    "--jobs",
    "1",
)


def cut(reader: ToyReader, folder: Path, count: int, **options) -> list[Path]:
    paths = [folder / f"{index}.h5" for index in range(count)]
    for index, path in enumerate(paths):
        convert(reader, path, Conversion(shard=Shard(index, count), points=20, **options))
    return paths


class Backwards(ToyReader):
    """Its items are not in the order of their names."""

    def items(self) -> list[Item]:
        return super().items()[::-1]


@settings(max_examples=9, deadline=None)
@given(count=st.integers(1, 9), bad=st.sets(st.integers(0, 6), max_size=6), data=st.data())
def test_any_cut_gives_the_same_bytes(tmp_path_factory, count, bad, data):
    """Also with bad samples, with shards that have none at all, and with the files in any order."""
    folder, reader = tmp_path_factory.mktemp("cut"), Backwards(count=7, bad=tuple(bad))
    whole = convert(reader, folder / "whole.h5", Conversion(points=20))
    paths = data.draw(st.permutations(cut(reader, folder, count)))
    merged = merge(paths, folder / "all.h5")
    assert file_digest(folder / "all.h5") == file_digest(folder / "whole.h5")
    assert (merged.written, merged.skipped) == (whole.written, whole.skipped)


def test_a_shard_tells_its_places_and_takes_every_nth(tmp_path):
    (path,) = cut(ToyReader(count=7, bad=(4,)), tmp_path, 3)[1:2]
    with CloudsReader(path) as reader:
        assert list(reader.names) == ["toy001"] and reader.provenance[-1]["config"]["shard"] == "1/3"
        assert read_positions(reader.file) == ([1], [4])
    assert convert(ToyReader(count=7, bad=(4,)), path, Conversion(shard=Shard(1, 3), points=20)).was_complete
    with pytest.raises(UsageError, match='shard "1/3", now "2/3"'):
        convert(ToyReader(count=7, bad=(4,)), path, Conversion(shard=Shard(2, 3), points=20))


@pytest.mark.parametrize("text", ["3/3", "1", "a/2", "-1/2", "0/0", "1/2/3", "0.5/2", "²/3"])
def test_wrong_shards(text):
    with pytest.raises(UsageError, match="expected i/n"):
        Shard.parse(text)


@given(st.integers(1, 50), st.integers(0, 200))
def test_shards_divide_the_places(count, total):
    places = [place for index in range(count) for place in Shard.parse(f"{index}/{count}").places(total)]
    assert sorted(places) == list(range(total))


def test_the_command_of_a_shard_is_that_of_the_whole():
    words = [
        "prepare",
        "x",
        "a b",
        "--shard",
        "1/3",
        "--points",
        "5",
        "--dask=local",
        "--dask",
        "tcp://a:1",
        "--shard=2/3",
    ]
    command = command_line(words)
    assert command == "dpc prepare x 'a b' --points 5"
    entry = {"command": command, "config": {"points": 5}}
    made = describe_shard(entry, Shard(1, 3))
    assert made["command"] == command and made["config"] == {"points": 5, "shard": "1/3"}
    assert shard_of(made) == (Shard(1, 3), describe_shard(entry, None))


def test_shards_that_do_not_belong_together_are_refused(tmp_path):
    reader = ToyReader(count=7)
    a, b, c = cut(reader, tmp_path, 3)
    (tmp_path / "copy.h5").write_bytes(b.read_bytes())
    convert(reader, tmp_path / "seed.h5", Conversion(shard=Shard(2, 3), points=20, seed=1))
    convert(reader, tmp_path / "four.h5", Conversion(shard=Shard(2, 4), points=20))
    convert(ToyReader(count=8), tmp_path / "longer.h5", Conversion(shard=Shard(2, 3), points=20))
    for paths, message in (
        ([a, c], "--shard 1/3: missing; make it first"),
        ([a, b, b], "named twice"),
        ([a, b, c, tmp_path / "copy.h5"], "as .*1.h5 is; each shard once"),
        ([a, b, tmp_path / "seed.h5"], "another run than .*seed 0, now 1"),
        ([a, b, tmp_path / "four.h5"], "another run than .*0/3 and 2/4"),
        ([a, b, tmp_path / "longer.h5"], "items 7, now 8"),
    ):
        with pytest.raises(UsageError, match=message):
            merge(paths, tmp_path / "all.h5")
    assert not (tmp_path / "all.h5").exists()
    empty = cut(ToyReader(count=2, bad=(0, 1)), tmp_path, 2, force=True)
    with pytest.raises(DataError, match="all 2 shards are empty"):
        merge(empty, tmp_path / "all.h5")


def test_the_commands_give_the_bytes_of_one_run(tmp_path):
    shards = [tmp_path / f"{index}.h5" for index in range(2)]
    for index, path in enumerate(shards):
        assert dpc(*SYNTHETIC, "--shard", f"{index}/2", "-o", path).returncode == 0
    assert dpc("prepare", "merge", *shards, "-o", tmp_path / "all.h5").returncode == 0
    assert dpc(*SYNTHETIC, "-o", tmp_path / "whole.h5").returncode == 0
    assert file_digest(tmp_path / "all.h5") == file_digest(tmp_path / "whole.h5")
    wrong = dpc(*SYNTHETIC, "--shard", "2/2", "-o", tmp_path / "x.h5")
    assert wrong.returncode == 2 and "0/16 ... 15/16" in wrong.stderr
