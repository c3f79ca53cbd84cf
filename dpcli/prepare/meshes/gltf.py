"""The container of glTF 2.0: .glb and .gltf files into checked numpy arrays (Khronos specification, sections 3.6 and
4).

The container is JSON beside a block of bytes, so the standard library reads it; `gltf_nodes` and
`gltf_mesh` say what it means.
"""

from __future__ import annotations

import base64
import binascii
import io
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from posixpath import normpath
from typing import Any
from urllib.parse import unquote, unquote_to_bytes

import numpy as np

from dpcli.errors import DataError
from dpcli.path_names import path_inside
from dpcli.prepare.meshes.other_formats import is_folder, not_gltf, refuse_other_formats
from dpcli.runtime.clips.images import as_rgba, require_plausible
from dpcli.text_files import parse_json

COMPONENTS = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_JSON, _BIN = 0x4E4F534A, 0x004E4942
_MOST = 1 << 27  # entries: a damaged count must not fill the memory
_ZEROS = 1 << 20  # entries without bytes, of sparse numbers
_ZEROS_PER_BYTE = 64  # further ones: as many as a compressed mesh may need
_SCHEME = re.compile(r"[a-zA-Z][a-zA-Z0-9+.-]*:")
MESHOPT = ("EXT_meshopt_compression", "KHR_meshopt_compression")
_UNPACKED = 4096  # bytes that one of compressed data may make


@dataclass
class Gltf:
    """Holds a glTF file: its JSON and, read when asked for, its buffers.

    `accessor` decodes numbers, `image` gives a texture's encoded bytes; decoded: what accessors (by index) hold that the
    compressed block of the primitive being read gave, (count, components); blocks: what such blocks hold, by buffer view.
    All errors are DataErrors that name the file. root: the folder that the files which it names must lie in, None for any.
    """

    path: Path
    tree: dict[str, Any]
    binary: bytes | None = None
    root: Path | None = None
    decoded: dict[int, np.ndarray] = field(default_factory=dict)
    blocks: dict[int, Any] = field(default_factory=dict)
    _buffers: dict[int, bytes] = field(default_factory=dict)
    _unpacked: dict[int, tuple[bytes, int]] = field(default_factory=dict)  # views that many accessors share
    _images: dict[int, np.ndarray] = field(default_factory=dict)  # which many materials share

    def fail(self, problem: str) -> DataError:
        """Returns the DataError that names the file and this fault."""
        return DataError(f"{self.path}: {problem}")

    def items(self, kind: str) -> list[dict[str, Any]]:
        """Returns the top-level list of this name, such as nodes; [] when absent."""
        return self._objects(kind, slice(None))

    def _objects(self, kind: str, which: slice) -> list[dict[str, Any]]:
        value = self.tree.get(kind, [])
        if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value[which]):
            raise self.fail(f"{kind} is not a list of objects; the file is damaged, export it again")
        return value

    def item(self, kind: str, index: Any) -> dict[str, Any]:
        """Returns one entry of a top-level list. Raises DataError when the index points at nothing."""
        entries = self._objects(kind, slice(0))  # all would be looked at again for each
        if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(entries):
            raise self.fail(
                f"refers to {kind}[{index}], but there are {len(entries)}; the file is damaged, export it again"
            )
        return self._objects(kind, slice(index, index + 1))[index]

    def accessor(self, index: Any, what: str, width: int | None = None, finite: bool = True) -> np.ndarray:
        """Returns numbers of an accessor: (count,) or (count, components), normalized integers as float32 in -1..1.

        what: named in errors. width: components expected, such as 3. finite: refuse NaN and infinite floats.
        """
        entry = self.item("accessors", index)
        dtype, columns = COMPONENTS.get(entry.get("componentType")), WIDTHS.get(entry.get("type"))
        count = entry.get("count")
        if dtype is None or columns is None or not isinstance(count, int) or not 1 <= count <= _MOST:
            raise self.fail(f"{what}: accessor {index} has no valid type or count; export the file again")
        if width is not None and columns != width:
            raise self.fail(f"{what}: accessor {index} is {entry['type']}, expected {width} components")
        if index in self.decoded:
            values = self._of_block(self.decoded[index], columns, dtype, what)
        elif "bufferView" in entry:
            values = self._elements(entry["bufferView"], entry.get("byteOffset", 0), count, columns, dtype, what)
        else:
            held = sum(map(len, (self.binary or b"", *self._buffers.values())))
            if count > _ZEROS + _ZEROS_PER_BYTE * held:
                raise self.fail(
                    f"{what}: accessor {index} claims {count} entries, and has no bytes; the file is damaged"
                )
            values = np.zeros((count, columns), dtype)
        if "sparse" in entry and index not in self.decoded:
            values = self._replaced(values, entry["sparse"], what)
        if dtype is not np.float32 and entry.get("normalized"):
            values = np.maximum(values.astype(np.float32) / np.iinfo(dtype).max, -1)
        if finite and values.dtype == np.float32 and not np.isfinite(values).all():
            row = int(np.argmax(~np.isfinite(values).all(1)))
            raise self.fail(f"{what}: NaN or infinite at entry {row} of {count}; repair the model, export it again")
        return values[:, 0] if columns == 1 else values

    def _of_block(self, values: np.ndarray, columns: int, dtype: type, what: str) -> np.ndarray:
        if values.shape[1] != columns or not len(values):
            raise self.fail(f"{what}: its Draco block has {values.shape[1]} components, expected {columns}")
        return values.astype(dtype)

    def view_bytes(self, index: Any) -> bytes:
        """Returns the bytes of a buffer view."""
        return bytes(self._view(index)[0])

    def _elements(self, view: Any, offset: int, count: int, columns: int, dtype: type, what: str) -> np.ndarray:
        data, stride = self._view(view)
        size = np.dtype(dtype).itemsize * columns
        stride = stride or size
        if offset < 0 or stride < size or offset + stride * (count - 1) + size > len(data):
            raise self.fail(
                f"{what}: needs {offset + stride * (count - 1) + size} bytes of bufferView {view}, which has "
                f"{len(data)}; the file is truncated or damaged"
            )
        values = np.ndarray(
            (count, columns), np.dtype(dtype).newbyteorder("<"), data, offset, (stride, size // columns)
        )
        return values.astype(dtype)

    def _replaced(self, values: np.ndarray, sparse: dict[str, Any], what: str) -> np.ndarray:
        try:
            where, what_else, count = sparse["indices"], sparse["values"], sparse["count"]
            kind, views = COMPONENTS[where["componentType"]], (where["bufferView"], what_else["bufferView"])
        except (KeyError, TypeError):
            raise self.fail(f"{what}: a sparse accessor lacks indices or values; export the file again") from None
        rows = self._elements(views[0], where.get("byteOffset", 0), count, 1, kind, what)[:, 0]
        if rows.max(initial=0) >= len(values):
            raise self.fail(f"{what}: a sparse accessor replaces entry {rows.max()} of {len(values)}")
        values = values.copy()
        values[rows] = self._elements(
            views[1], what_else.get("byteOffset", 0), count, values.shape[1], values.dtype.type, what
        )
        return values

    def _view(self, index: Any) -> tuple[bytes | memoryview, int]:
        """Returns the bytes of a buffer view, and its stride, 0 where the file names none."""
        entry = self.item("bufferViews", index)
        packed = next((entry["extensions"][name] for name in MESHOPT if name in entry.get("extensions", {})), None)
        if packed is None:
            return self._part(index, entry), entry.get("byteStride", 0)
        if index not in self._unpacked:
            self._unpacked[index] = self._unpack(index, packed)
        return self._unpacked[index]

    def _unpack(self, index: Any, packed: dict[str, Any]) -> tuple[bytes, int]:
        """Returns the bytes of a buffer view that meshopt compressed, and its stride, 0 for indices."""
        count, size, mode = (packed.get(key) for key in ("count", "byteStride", "mode"))
        data = self._part(index, packed)
        sizes = all(type(number) is int and number > 0 for number in (count, size))
        if not sizes or count * size > _UNPACKED * len(data) + (1 << 20):
            raise self.fail(
                f"bufferView {index} claims {count} rows of {size} bytes, which {len(data)} bytes can't hold; the file is damaged"
            )
        try:
            import meshopt
        except ImportError:
            raise self.fail(
                "is compressed by meshopt: pip install 'dpc-toolkit[meshopt]' (Python 3.11 or later), or export it without"
            ) from None
        try:
            rows = meshopt.decode_gltf_buffer(bytes(data), count, size, mode, packed.get("filter", "NONE"))
        except (ValueError, RuntimeError, TypeError) as error:
            raise self.fail(f"bufferView {index}: meshopt cannot decode it ({error}); export the file again") from None
        return rows.tobytes(), size if mode == "ATTRIBUTES" else 0

    def _part(self, index: Any, entry: dict[str, Any]) -> memoryview:
        """Returns the bytes of a buffer that a buffer view, or its compressed form, names."""
        data = self._buffer(entry.get("buffer"))
        start, length = entry.get("byteOffset", 0), entry.get("byteLength", 0)
        if not (0 <= start and 0 < length and start + length <= len(data)):
            raise self.fail(
                f"bufferView {index} needs bytes {start} to {start + length} of a buffer of {len(data)}; "
                "the file is truncated or damaged"
            )
        return memoryview(data)[start : start + length]

    def _buffer(self, index: Any) -> bytes:
        if index not in self._buffers:
            entry = self.item("buffers", index)
            if "uri" in entry:
                self._buffers[index] = self._resource(entry["uri"])
            elif index == 0 and self.binary is not None:
                self._buffers[index] = self.binary
            else:
                raise self.fail(f"buffer {index} has no data; export the file again")
        return self._buffers[index]

    def _resource(self, uri: str) -> bytes:
        """Returns the bytes of a data: URI or of a file below the root; anything else is refused, a file may be hostile.

        Names are read as browsers do: \\ is /, white space at the ends and line breaks don't count.
        """
        uri = re.sub(r"[\t\n\r]", "", uri.strip())
        if uri[:5].lower() == "data:":
            return self._embedded(uri)
        try:
            return self._place(uri).read_bytes()
        except OSError as error:
            raise self.fail(
                f"its file {uri[:80]!r} cannot be read ({error.strerror}); keep it beside the .gltf"
            ) from None

    def _place(self, uri: str) -> Path:
        """Returns where the file of a URI lies. Raises DataError unless that is below the root."""
        folder = self.path.parent
        if _SCHEME.match(uri):
            raise self.fail(f"refers to {uri[:80]!r} outside its folder; keep its files beside it")
        names = [unquote(uri), unquote(re.split("[?#]", uri)[0]), uri]
        try:
            places = [path_inside(self.root, folder, normpath(name.replace("\\", "/"))) for name in names]
        except DataError:
            raise self.fail(f"refers to {uri[:80]!r} outside its folder; keep its files beside it") from None
        return next((place for place in places if place.is_file()), places[0])

    def files_beside(self) -> list[Path]:
        """Returns the files of buffers and textures that it names, without those outside of the root, which are never read."""
        uris = [str(entry["uri"]) for kind in ("buffers", "images") for entry in self.items(kind) if "uri" in entry]
        found = []
        for uri in uris:
            with suppress(DataError):  # a data: URI is one of them
                found.append(self._place(re.sub(r"[\t\n\r]", "", uri.strip())))
        return found

    def _embedded(self, uri: str) -> bytes:
        head, _, body = uri.partition(",")
        if not head.lower().endswith(";base64"):
            return unquote_to_bytes(body)
        text = re.sub(r"\s", "", unquote(body)).rstrip("=")
        try:
            return base64.b64decode(text + "=" * (-len(text) % 4), validate=True)
        except (binascii.Error, ValueError):
            raise self.fail("a data: URI is not valid base64; export the file again") from None

    def image(self, index: Any) -> np.ndarray:
        """Returns pixels of images[index], u8 (H,W,4), decoded by Pillow."""
        entry = self.item("images", index)
        if index not in self._images:
            self._images[index] = self._decoded_image(index, entry)
        return self._images[index]

    def _decoded_image(self, index: int, entry: dict[str, Any]) -> np.ndarray:
        from PIL import Image, UnidentifiedImageError

        data = (
            self.view_bytes(entry["bufferView"]) if "bufferView" in entry else self._resource(str(entry.get("uri", "")))
        )
        try:
            with Image.open(io.BytesIO(data)) as picture:
                require_plausible(self.path, *picture.size, len(data))
                return np.array(as_rgba(picture))
        except UnidentifiedImageError:
            kind = "KTX2" if data.startswith(b"\xabKTX 20\xbb") else entry.get("mimeType", "of an unknown kind")
            raise self.fail(f"texture {index} is {kind}, which is not read; export it as PNG or JPEG") from None
        except (OSError, ValueError, Image.DecompressionBombError) as error:
            raise self.fail(f"texture {index} ({entry.get('mimeType', 'image')}) cannot be read: {error}") from None


@contextmanager
def well_formed(path: Path) -> Iterator[None]:
    """Turns what a damaged file makes of our assumptions (a text for a number, a missing key) into a DataError."""
    try:
        yield
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError, MemoryError) as error:
        raise DataError(
            f"{path}: not built as glTF 2.0 asks ({type(error).__name__}: {error}); export it again"
        ) from error


def read_gltf(path: Path) -> Gltf:
    """Opens a .glb or .gltf file, whose other files lie beside it. Raises DataError unless it is whole and of version 2."""
    try:
        data = Path(path).read_bytes()
    except IsADirectoryError:
        raise is_folder(Path(path)) from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from None
    refuse_other_formats(path, data)
    text, binary = _split_glb(path, data) if data[:4] == b"glTF" else (data, None)
    try:
        tree = parse_json(text.rstrip(b"\0"), path, as_browsers=True)  # some exporters fill the chunk up with them
        version = str(tree["asset"]["version"])
    except (DataError, KeyError, TypeError):
        raise not_gltf(Path(path)) from None
    if not version.startswith("2"):
        raise DataError(f"{path}: glTF version {version}; version 2 is read, convert the file")
    return Gltf(Path(path), tree, binary, Path(path).parent)


def _split_glb(path: Path, data: bytes) -> tuple[bytes, bytes | None]:
    """Returns JSON and binary chunk of a .glb (section 4)."""
    version, length = struct.unpack_from("<II", data, 4) if len(data) >= 12 else (0, 0)
    if version == 1:
        raise DataError(f"{path}: glTF version 1; version 2 is read, convert the file")
    if version != 2 or length > len(data):
        raise DataError(
            f"{path}: a .glb of version {version} and {length} bytes, of which {len(data)} are left; "
            "truncated, or not glTF 2: copy or export it again"
        )
    chunks, start = {}, 12
    while start + 8 <= length:
        size, kind = struct.unpack_from("<II", data, start)
        if start + 8 + size > length:
            raise DataError(f"{path}: a chunk of {size} bytes does not fit into the file; copy or export it again")
        chunks.setdefault(kind, data[start + 8 : start + 8 + size])
        start += 8 + size
    if _JSON not in chunks:
        raise DataError(f"{path}: a .glb without its JSON chunk; copy or export it again")
    return chunks[_JSON], chunks.get(_BIN)
