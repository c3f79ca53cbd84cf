"""Holds what every file of the contract has in common: the root attributes, safe opening, provenance."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np

from dpcli import __version__
from dpcli.errors import DataError, first_line, reading
from dpcli.path_names import as_utf8
from dpcli.runtime.whole_file import refuse_folder, refuse_pipe
from dpcli.store.heap_check import check_heaps
from dpcli.store.schema import KINDS, SCHEMA, Field, fields_of, find_field

MAGIC = b"\x89HDF\r\n\x1a\n"
_TEXT = np.dtype([("length", "<u4"), ("heap", "<u8"), ("number", "<u4")])  # what stands for a text of variable length
_AT_ONCE = 1 << 16
_PACKED_AT_MOST = 1100  # times that zlib makes anything smaller: 258 bytes in 2 bits, and headers
_OBJECTS = 4096  # groups and data sets of a file at most
_CHUNK = 1 << 26  # bytes that a chunk of any data set may have
_TEXTS = ("dpc_version", "command", "source", "length_unit", "name", "metrics")  # attributes, by what they hold
_NUMBERS = ("seed", "skipped", "reference", "num_parts", "num_points")
STRING = h5py.string_dtype("utf-8")
PACKED = {"compression": "gzip", "compression_opts": 4, "shuffle": True}  # of labels, offsets and pictures

_FROM_RAW = "`dpc prepare` makes them from raw data"
_CACHE = 1 << 20  # bytes, HDF5's own choice


class StoreFile(h5py.File):
    """Opens a file of the contract as a context whose block turns what HDF5 raises for damaged content into DataError."""

    def __exit__(self, kind: type | None, error: BaseException | None, trace: object) -> None:
        path = self.filename if self.id.valid else "an HDF5 file"
        super().__exit__(kind, error, trace)
        if error is not None:
            with reading(path):
                raise error


def open_store(path: str | Path, kinds: Sequence[str] = KINDS, cache: int = _CACHE) -> StoreFile:
    """Opens a file of the contract for reading; HDF5 keeps at most `cache` bytes of chunks of each of its data sets.

    Raises DataError when it isn't HDF5, is truncated, is not ours, is of another schema or kind, or refers to data
    outside itself (external links, virtual data sets, external storage) or to Python objects.
    """
    path = Path(path)
    refuse_folder(path)
    refuse_pipe(path)
    with open(path, "rb") as raw:
        magic = raw.read(8)
    if not magic:
        raise DataError(f"{path}: the file is empty, expected HDF5; did the command that writes it fail?")
    if magic != MAGIC:
        makers = [f"dpcli.store.{kind.capitalize()}Writer" for kind in kinds if kind in ("scores", "parts")]
        made = f"what another program predicted, {makers[0]} writes" if len(kinds) == len(makers) else _FROM_RAW
        raise DataError(f"{path}: not an HDF5 file (starts with {magic!r}); {made}")
    check_heaps(path)
    try:
        file = StoreFile(path, "r", rdcc_nbytes=cache)
    except Exception as error:
        raise DataError(_opening_problem(path, error)) from None
    try:
        with reading(path):
            _check_root(file, path, kinds)
            _refuse_outside(file, path)
            _check_types(file, path)
    except BaseException:
        file.close()
        raise
    return file


def _opening_problem(path: Path, error: Exception) -> str:
    text = str(error)
    if "truncated" in text or "end of file" in text:
        return f"{path}: the HDF5 file is truncated ({path.stat().st_size} bytes are left); make or copy it again"
    if "unable to lock file" in text:  # not any "lock": there is a superblock, too
        return f"{path}: locked by a writer, or on a file system without locks (then set HDF5_USE_FILE_LOCKING=FALSE)"
    return f"{path}: the HDF5 file is damaged ({first_line(error)}); make or copy it again"


def _check_root(file: h5py.File, path: Path, kinds: Sequence[str]) -> None:
    for name, value in file.attrs.items():
        if (name in _TEXTS and not isinstance(value, str)) or (isinstance(value, str) and not _is_utf8(value)):
            raise DataError(f"{path}: attribute {name} is {value!r:.80}, expected UTF-8 text; make the file again")
        if name in _NUMBERS and (np.ndim(value) or not isinstance(value, (int, np.integer))):
            raise DataError(f"{path}: attribute {name} is {value!r:.80}, expected a whole number; make the file again")
    kind, schema = file.attrs.get("dpc_kind"), file.attrs.get("dpc_schema")
    if kind is None or schema is None:
        raise DataError(f"{path}: an HDF5 file, but not one of dpc's (no dpc_kind attribute); see `dpc prepare --help`")
    if not isinstance(schema, (int, np.integer)) or schema != SCHEMA:
        raise DataError(f"{path}: schema {schema}, this dpc {__version__} reads schema {SCHEMA}")
    if not isinstance(kind, str) or kind not in kinds:
        raise DataError(
            f"{path}: holds {kind!r}, expected {' or '.join(repr(k) for k in kinds)}; `dpc info {path}` shows more"
        )


def _is_utf8(text: str) -> bool:
    """Returns whether a text has no lone surrogates, which is how h5py hands out bytes that are not UTF-8."""
    return as_utf8(text) == text


def _refuse_outside(file: h5py.File, path: Path) -> None:
    """Raises DataError for what lies outside the file, or is no number and no text: hostile files could name others, or pickles.

    Also for many objects, and for one under several names: groups that hold each other twice would be looked at forever.
    """
    seen = {h5py.h5o.get_info(file.id).addr}

    def visit(group: h5py.Group) -> None:
        if len(group) > _OBJECTS or len(seen) > _OBJECTS:
            raise DataError(f"{path}: holds more than {_OBJECTS} groups and data sets; another program made it")
        for name in group:
            link = group.get(name, getlink=True)
            if not isinstance(link, h5py.HardLink):
                raise DataError(
                    f"{path}: {group.name}/{name} is a link to elsewhere; a dpc file must be self-contained"
                )
            item = group[name]
            place = h5py.h5o.get_info(item.id).addr
            if place in seen:
                raise DataError(f"{path}: {item.name} is there under another name, too; another program changed it")
            seen.add(place)
            if isinstance(item, h5py.Group):
                visit(item)
            elif item.is_virtual or item.external:
                raise DataError(
                    f"{path}: {item.name} keeps its data in another file; a dpc file must be self-contained"
                )
            elif item.dtype.kind not in "fiub" and h5py.check_string_dtype(item.dtype) is None:
                raise DataError(f"{path}: {item.name} has type {item.dtype}, expected numbers or strings")
            else:
                refuse_claim(item, path)
                _refuse_lengths(item, path)

    visit(file)


def _refuse_lengths(item: h5py.Dataset, path: Path) -> None:
    """Raises DataError where a text of variable length claims more bytes than the file has: libhdf5 allocates it first."""
    text = h5py.check_string_dtype(item.dtype)
    if text is None or text.length is not None or item.id.get_create_plist().get_nfilters() or not item.size:
        return
    if item.chunks is None:
        places = [(item.id.get_offset(), item.size)]
    else:
        chunks: list = []
        item.id.chunk_iter(chunks.append)  # asked for one by one, HDF5 would go through all of them for each
        places = [(chunk.byte_offset, chunk.size // _TEXT.itemsize) for chunk in chunks]
    size = path.stat().st_size
    with path.open("rb") as file:
        for place, count in places:
            if place is None:  # nothing was written
                continue
            file.seek(place)
            for start in range(0, count, _AT_ONCE):
                found = np.fromfile(file, _TEXT, min(_AT_ONCE, count - start))
                if len(found) and found["length"].max() > size:
                    raise DataError(
                        f"{path}: a text of {item.name} claims {found['length'].max()} bytes, a file of {size} bytes can't"
                        " hold it; make or copy it again"
                    )


def refuse_claim(item: h5py.Dataset, path: Path) -> None:
    """Raises DataError for a data set of a shape that its stored bytes can't fill, before anybody makes room for it."""
    stored = item.id.get_storage_size()
    packed = item.chunks is not None and item.id.get_create_plist().get_nfilters() > 0
    if math.prod(item.shape or ()) * item.dtype.itemsize > stored * (_PACKED_AT_MOST if packed else 1) and item.ndim:
        raise DataError(
            f"{path}: {item.name} claims {math.prod(item.shape)} values, {stored} bytes of a file of"
            f" {path.stat().st_size} bytes can't hold them; make or copy it again"
        )
    chunk = math.prod(item.chunks or ()) * item.dtype.itemsize  # unpacked whole, for a single value even
    if packed and chunk > max(_CHUNK, math.prod(item.shape or ()) * item.dtype.itemsize):
        raise DataError(
            f"{path}: {item.name} has {math.prod(item.shape)} values, and claims {chunk} bytes for a chunk of them; make or"
            " copy it again"
        )


def _check_types(file: h5py.File, path: Path) -> None:
    """Raises DataError where a data set has another type or shape than its kind has under that name; unknown names pass.

    The lengths that a file may choose are the readers' to compare.
    """
    known = fields_of(str(file.attrs["dpc_kind"]))
    for name, item in file.items():
        field = find_field(known, name)
        if field is None:
            continue
        streams = field.group and isinstance(item, h5py.Group)
        for one in item.values() if streams else (item,):
            if streams != field.group or not _holds(one, field):
                found = f"{one.dtype} {one.shape}" if isinstance(one, h5py.Dataset) else "a group"
                expected = f"{'' if streams == field.group else 'a group of '}{field.in_words()}"
                raise DataError(
                    f"{path}: {one.name[1:]!r} holds something else ({found}), expected {expected}; another program"
                    " changed it, make it again"
                )


def _holds(item: h5py.Group | h5py.Dataset, field: Field) -> bool:
    """Returns whether something in a file has the type and the shape of a field, but for the lengths that have letters."""
    if not isinstance(item, h5py.Dataset) or len(item.shape or ()) != len(field.shape):
        return False
    text = h5py.check_string_dtype(item.dtype) is not None
    right = text if field.kind == "str" else item.dtype == field.dtype
    return right and all(isinstance(there, str) or there == here for there, here in zip(field.shape, item.shape))


def is_hdf5(path: Path) -> bool:
    """Returns whether a file begins as HDF5 does."""
    with open(path, "rb") as file:
        return file.read(len(MAGIC)) == MAGIC


def file_kind(path: str | Path) -> str:
    """Returns the kind of a file of the contract, such as `clouds`; DataError as `open_store`."""
    with open_store(path) as file:
        return str(file.attrs["dpc_kind"])


def root_attributes(file: h5py.File) -> dict:
    """Returns the root attributes as plain Python values, without the long ones (`class_names`, `provenance` are data sets)."""
    return {key: value.item() if isinstance(value, np.generic) else value for key, value in file.attrs.items()}


def read_provenance(file: h5py.File) -> list[dict]:
    """Returns the commands that led to this file, oldest first."""
    if "provenance" not in file:
        return []
    try:
        # half letters too: of names of files; NaN of other programs as text, which JSON can write again
        found = [json.loads(entry, parse_constant=str) for entry in file["provenance"].asstr()[:]]
    except (ValueError, TypeError, RecursionError):
        raise DataError(f"{file.filename}: provenance is not JSON; the file was changed by another program") from None
    for entry in found:
        if not isinstance(entry, dict):
            raise DataError(
                f"{file.filename}: provenance holds {entry!r:.80}, expected a command's JSON object;"
                " the file was changed by another program"
            )
    return found


def write_skipped(file: h5py.File, skipped: Sequence[tuple[str, str]]) -> None:
    """Writes the samples that were passed over, (name, reason): how many as an attribute, who and why as a data set (n,2).

    A data set, because an attribute ends at 64 KiB. Nothing is written when there are none.
    """
    if not skipped:
        return
    clean = [[text.encode("utf-8", "replace").decode().replace("\0", " ") for text in row] for row in skipped]
    file.attrs["skipped"] = len(clean)
    write_strings(file, "skipped", clean)


def read_skipped(file: h5py.File) -> list[tuple[str, str]]:
    """Returns (name, reason) of the samples that were passed over when the file was made."""
    if "skipped" not in file:
        return []
    return [(str(name), str(reason)) for name, reason in file["skipped"].asstr()[:]]


def write_positions(file: h5py.File, positions: tuple[Sequence[int], Sequence[int]] | None) -> None:
    """Writes the places that a shard's samples, those written and those skipped, have in the list of all, i64 each.

    `dpc prepare merge` needs them to restore the order. Nothing is written for None, a file that is no shard.
    """
    if positions is not None:
        for name, values in zip(("position", "skipped_position"), positions):
            file.create_dataset(name, data=np.array(values, np.int64))


def read_positions(file: h5py.File) -> tuple[list[int], list[int]] | None:
    """Returns the places that `write_positions` wrote; None when the file is no shard."""
    if "position" not in file or "skipped_position" not in file:
        return None
    with reading(file.filename):
        return file["position"][:].tolist(), file["skipped_position"][:].tolist()


def read_strings(file: h5py.File, name: str, *, optional: bool = False) -> list[str]:
    """Returns a string data set as a list; when it is absent, none where that is `optional`, else DataError."""
    if optional and name not in file:
        return []
    try:
        return list(data_set(file, name).asstr()[:])
    except UnicodeDecodeError:
        raise DataError(f"{file.filename}: {name!r} is not UTF-8; the file was changed by another program") from None


def data_set(file: h5py.File, name: str) -> h5py.Dataset:
    """Returns a data set, or a group of some, that a file should have; of its type and shape `open_store` has made sure.

    Raises DataError where it is absent.
    """
    if name not in file:
        raise DataError(f"{file.filename}: data set {name!r} is missing; the file is incomplete, make it again")
    return file[name]


def write_strings(file: h5py.File, name: str, texts: Sequence) -> None:
    """Writes texts, or rows of texts, as a data set."""
    file.create_dataset(name, data=np.array(texts, dtype=object), dtype=STRING)


def history_of(provenance: dict | Sequence[dict] | None) -> list[dict]:
    """Returns provenance as a list of entries; one entry, or none, may be given by itself."""
    return [provenance] if isinstance(provenance, dict) else list(provenance or [])


def write_root(
    file: h5py.File,
    kind: str,
    *,
    length_unit: str,
    source: str,
    seed: int,
    class_names: Sequence[str],
    provenance: Sequence[dict],
) -> None:
    """Writes root attributes, class names and provenance (docs/format.md). No clock time, so bytes repeat.

    Raises DataError for a class name with NUL, which HDF5 can't hold.
    """
    for name in class_names:
        if "\0" in name:
            raise DataError(
                f"{source}: the class name {name[:80]!r} holds NUL; expected text, copy the list of classes again"
            )
    last = provenance[-1] if provenance else {}
    file.attrs.update(
        {
            "dpc_kind": kind,
            "dpc_schema": SCHEMA,
            "dpc_version": __version__,
            "seed": int(seed),
            "command": as_utf8(str(last.get("command", ""))),
            "source": as_utf8(source),
            "length_unit": length_unit,
        }
    )
    write_strings(file, "class_names", list(class_names))
    write_strings(file, "provenance", [json.dumps(entry, sort_keys=True) for entry in provenance])
