"""The shards of one run into the file that the run would have written whole, whatever kind of file that is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.config_diff import differences
from dpcli.errors import DataError, UsageError
from dpcli.path_names import first_names
from dpcli.runtime.machines.shards import Shard, shard_of
from dpcli.runtime.machines.spread import Workers
from dpcli.store import CloudsReader, CloudsWriter, PartsReader, PartsWriter, ScoresReader, ScoresWriter
from dpcli.store.file import file_kind
from dpcli.store.statistics import StatisticsReader, StatisticsWriter
from dpcli.store.writing.already_made import WORK, already_made
from dpcli.store.writing.item_pass import ItemPass, Wording
from dpcli.store.writing.open_readers import OpenReaders, Reader

_OPEN = 256  # files held open at a time; shards are read in turn, and there may be a thousand
_CACHE = 64 << 10  # bytes of chunks that each of their data sets may keep: a chunk is read from the disk's cache again


def _same(given: list[Any]) -> list[Any]:
    return given


def _clouds(reader: Reader, path: Path, **options: Any) -> CloudsWriter:
    compression = str(options["provenance"][-1]["config"].get("compression", "none"))
    fields, unit = reader.fields, reader.length_unit
    return CloudsWriter(path, fields=fields, length_unit=unit, compression=compression, **options)


def _parts(reader: Reader, path: Path, **options: Any) -> PartsWriter:
    parts, fields, unit = reader.num_parts, reader.fields, reader.length_unit
    return PartsWriter(path, num_parts=parts, fields=fields, length_unit=unit, **options)


def _scores(reader: Reader, path: Path, **options: Any) -> ScoresWriter:
    return ScoresWriter(path, streams=reader.stream_names, rejects=reader.rejected is not None, **options)


def _statistics(reader: Reader, path: Path, **options: Any) -> StatisticsWriter:
    return StatisticsWriter(path, length_unit=reader.length_unit, **options)


KINDS: dict[str, tuple[Callable[[Path], Reader], Callable[..., Any]]] = {
    "clouds": (CloudsReader, _clouds),
    "parts": (PartsReader, _parts),
    "scores": (ScoresReader, _scores),
    "statistics": (StatisticsReader, _statistics),
}  # how a file is read (all readers have names, skipped, positions, provenance, given()), and how the writer of one like it is made


@dataclass
class _Piece:
    """Holds one shard: its reader, which piece it is, and the provenance that the whole has."""

    reader: Reader
    shard: Shard
    history: list[dict[str, Any]]

    @property
    def path(self) -> Path:
        return self.reader.path


def is_shard(reader: Reader) -> bool:
    """Returns whether the last command that made a file made a shard of something."""
    return bool(reader.provenance) and shard_of(reader.provenance[-1]) is not None


def join_shards(paths: Sequence[Path], output: Path, *, force: bool = False, resume: bool = True) -> Reader:
    """Joins all shards of one run, one item in memory at a time, into the file of a single run, byte for byte; returns its reader.

    Goes on where a stopped or killed join ended; does nothing where it is done. resume: off where nobody could run it again
    (a pipe). Raises UsageError for missing, repeated or mixed shards, and where `output` is there and another; DataError
    where their samples don't make up the whole; Stopped after a stop signal.
    """
    kinds = {file_kind(path): path for path in paths}
    if len(kinds) > 1:
        (a, one), (b, two), *_ = kinds.items()
        raise UsageError(f"{two}: holds {b}, {one} holds {a}; join files of one kind")
    kind = next(iter(kinds))
    if kind not in KINDS:
        raise UsageError(f"{paths[0]}: holds {kind}; only files of {', '.join(KINDS)} have shards")
    open_file, make_writer = KINDS[kind]
    pieces = [_read_piece(open_file(path)) for path in paths]
    history = _common_history(pieces)
    if not force and already_made(output, history[-1], open_file, keys=WORK):
        return open_file(output)
    owner, row = _find_places(pieces, output, history[-1])
    pattern = next((piece.reader for piece in pieces if len(piece.reader.names)), pieces[0].reader)
    root = {"seed": int(pattern.attributes.get("seed", 0)), "source": str(pattern.attributes.get("source", ""))}
    root |= {"class_names": pattern.class_names, "provenance": history, "force": force, "resume": resume}
    with make_writer(pattern, output, **root) as writer:
        _copy(pieces, owner, row, writer)
        writer.skipped = _skipped(pieces)
    return open_file(output)


def _read_piece(reader: Reader) -> _Piece:
    if not is_shard(reader):
        raise UsageError(
            f"{reader.path}: is not a shard (--shard i/n); only the shards of one run can be merged, or clouds of any origin"
        )
    shard, entry = shard_of(reader.provenance[-1])  # type: ignore[misc]
    written, skipped = reader.positions or ([], [])
    if (len(written), len(skipped)) != (len(reader.names), len(reader.skipped)):
        raise DataError(f"{reader.path}: its positions don't fit its samples; make this shard again")
    reader.close()
    reader.cache = _CACHE
    return _Piece(reader, shard, [*reader.provenance[:-1], entry])


def _common_history(pieces: list[_Piece]) -> list[dict[str, Any]]:
    """Returns the provenance that all shards share. Raises UsageError unless they are the pieces of one whole."""
    first, seen = pieces[0], {}
    for piece in pieces:
        if _work(piece) != _work(first) or piece.shard.count != first.shard.count:
            what = _differing_facts(first, piece) or f"{first.shard} and {piece.shard}"
            raise UsageError(f"{piece.path}: is a shard of another run than {first.path} ({what})")
        if piece.shard.index in seen:
            raise UsageError(f"{piece.path}: is shard {piece.shard}, as {seen[piece.shard.index]} is; each shard once")
        seen[piece.shard.index] = piece.path
    missing = [f"{index}/{first.shard.count}" for index in range(first.shard.count) if index not in seen]
    if missing:
        raise UsageError(f"--shard {first_names(missing, 8)}: missing; make {'them' if missing[1:] else 'it'} first")
    return first.history


def _work(piece: _Piece) -> list[dict[str, Any]]:
    """Returns what made the shard, step by step, without the words of the commands: they may be spelled otherwise."""
    return [{key: entry.get(key) for key in WORK} for entry in piece.history]


def _differing_facts(one: _Piece, other: _Piece) -> str:
    for before, now in zip(_work(one), _work(other)):
        found = differences(
            *({**work.pop("config"), **work} for work in (dict(before), dict(now)) if isinstance(work["config"], dict))
        )
        if found:
            return "; ".join(found[:3])
    return "" if len(one.history) == len(other.history) else "their files were made in other steps"


def _find_places(pieces: list[_Piece], output: Path, entry: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Returns for each sample of the whole, in order, its shard's number i32 and its row there i64."""
    written = [np.asarray(piece.reader.positions[0], np.int64) for piece in pieces]
    lost = [np.asarray(piece.reader.positions[1], np.int64) for piece in pieces]
    places, count = np.concatenate([*written, *lost]), sum(map(len, written)) + sum(map(len, lost))
    total = entry["config"].get("items", count)
    if not np.array_equal(np.sort(places), np.arange(total)):
        raise DataError(f"{output}: the shards hold {count} of {total} places; make them again")
    if not any(map(len, written)):
        raise DataError(f"{output}: all {len(pieces)} shards are empty; their samples were all skipped")
    owner = np.repeat(np.arange(len(pieces), dtype=np.int32), [len(own) for own in written])
    row = np.concatenate([np.arange(len(own)) for own in written])
    order = np.argsort(np.concatenate(written), kind="stable")
    return owner[order], row[order]


def _skipped(pieces: list[_Piece]) -> list[tuple[str, str]]:
    lost = [pair for piece in pieces for pair in zip(piece.reader.positions[1], piece.reader.skipped)]
    return [said for _, said in sorted(lost, key=lambda pair: pair[0])]


def _copy(pieces: list[_Piece], owner: np.ndarray, row: np.ndarray, writer: Any) -> None:
    """Writes the samples in the order of the whole; goes on where a stopped join ended."""

    def load(place: int) -> list[Any]:
        return opened.use(pieces[owner[place]].reader).given(int(row[place]))

    def write(place: int, given: list[Any]) -> dict[str, float]:
        writer.write_again(given)
        return {}

    names = [pieces[own].reader.names[index] for own, index in zip(owner.tolist(), row.tolist())]
    with OpenReaders(_OPEN) as opened:
        ItemPass(writer, names, Wording("prepare merge", "sample", "copied")).run(_same, load, write, Workers())
