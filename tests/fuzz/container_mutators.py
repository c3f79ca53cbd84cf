"""Damage inside containers: taken apart, one field changed, put together again with right lengths and checksums."""

from __future__ import annotations

import io
import pickletools
import random
import re
import struct
import warnings
import zipfile
import zlib
from collections.abc import Iterator

import numpy as np

from tests.fuzz.hdf5_mutators import hdf5
from tests.fuzz.mutators import (
    NAMES,
    NUMBERS,
    Mutator,
    glb,
    json_text,
    odd_integer,
    odd_name,
    raw,
    safetensors,
    text,
    text_head,
)

DTYPES = "<f8 <f4 <i8 >u2 |u1 |S5 <U3 |O <c16 <M8[s] |V9 |b1 <f2 <f16 nonsense".split()


def structured(data: bytes, rng: random.Random) -> bytes:
    """The bytes changed as their own format allows; raises where the format is none of those known here."""
    for begin, mutator in KINDS:
        if re.match(begin, data, re.DOTALL):
            return mutator(data, rng)
    return (text if b"\0" not in data else odd_fields)(data, rng)


def odd_fields(data: bytes, rng: random.Random) -> bytes:
    """One to three aligned numbers among the first 400 bytes replaced: headers of LAS, TIFF, bags, raw depth."""
    made = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 3))):
        size = rng.choice((1, 2, 4, 4, 8))
        at = rng.randrange(max(1, min(len(data), 400) // size)) * size
        made[at : at + size] = odd_integer(rng, size, rng.choice(("little", "little", "big")))
    return bytes(made)


def npy(data: bytes, rng: random.Random) -> bytes:
    """An array whose header says another dtype, shape or order, or whose values are others."""
    size = struct.unpack_from("<H", data, 8)[0]
    head, body = data[10 : 10 + size].decode("latin-1"), data[10 + size :]
    change = rng.randrange(5)
    if change == 0:
        head = re.sub(r"'descr': [^,]+,", f"'descr': '{rng.choice(DTYPES)}',", head)
    elif change == 1:
        shape = ", ".join(
            rng.choice((*NUMBERS[:3], "5", "12", "99999999999", "2**40")) for _ in range(rng.randrange(5))
        )
        head = re.sub(r"'shape': \([^)]*\)", f"'shape': ({shape},)", head)
    elif change == 2:
        head = head.replace("False", "True")
    elif change == 3:
        head = text(head.encode(), rng).decode("latin-1")
    else:
        body = _odd_values(head, body, rng)
    return data[:8] + struct.pack("<H", len(head.encode()) % 65536) + head.encode() + body


def _odd_values(head: str, body: bytes, rng: random.Random) -> bytes:
    found = re.search(r"'descr': '([^']+)'", head)
    if found is None or "O" in found[1]:
        return pickled(body, rng)
    values = np.frombuffer(body, found[1]).copy()
    odd = (np.nan, np.inf, -np.inf, 1e38) if values.dtype.kind == "f" else (0, 1, -1, 2**31, 2**63 - 1)
    with np.errstate(all="ignore"):
        places = rng.choice((slice(None), slice(0, 1), slice(0, len(values) // 2)))
        values[places] = np.array(rng.choice(odd)).astype(values.dtype)
    return values.tobytes()


def zipped(data: bytes, rng: random.Random) -> bytes:
    """An archive (ZIP, NPZ, torch's) with a member changed, renamed, doubled or left out, its checksums right."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [[one.filename, archive.read(one)] for one in archive.infolist()]
    at, change = rng.randrange(len(members)), rng.randrange(8)
    if change == 0:
        members[at][0] = rng.choice(NAMES).encode("utf-8", "replace").decode()
    elif change == 1:
        members.append(list(members[at]))
    elif change == 2:
        del members[at]
    elif change == 3:
        members[at][1] = b"\0" * rng.choice((0, 1, 50 << 20))
    else:
        members[at][1] = (structured if change > 5 else raw)(members[at][1], rng)
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # names that are there twice are meant
                archive.writestr(zipfile.ZipInfo(name or "x"), content, zipfile.ZIP_DEFLATED)
    return made.getvalue()


def png(data: bytes, rng: random.Random) -> bytes:
    """A picture with a field of IHDR, a chunk, or its unpacked rows changed, every CRC right."""
    chunks = [list(one) for one in _png_chunks(data)]
    at = rng.randrange(len(chunks))
    change = rng.randrange(5)
    if change == 0:
        chunks[0][1] = _field(chunks[0][1], rng)
    elif change == 1:
        chunks.insert(at, list(rng.choice(chunks)))
    elif change == 2:
        del chunks[at]
    elif change == 3:
        chunks[at][0] = rng.choice((b"tRNS", b"PLTE", b"acTL", b"fcTL", b"fdAT", b"eXIf", b"zTXt", b"IDAT", b"XXXX"))
    else:
        rows = [one for one in chunks if one[0] == b"IDAT"]
        rows[0][1] = zlib.compress(raw(zlib.decompress(b"".join(one[1] for one in rows)), rng))
    return data[:8] + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in chunks
    )


def _png_chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    at = 8
    while at < len(data):
        length = struct.unpack_from(">I", data, at)[0]
        yield data[at + 4 : at + 8], data[at + 8 : at + 8 + length]
        at += 12 + length


def _field(head: bytes, rng: random.Random) -> bytes:
    at, size = rng.choice(((0, 4), (4, 4), (8, 1), (9, 1), (10, 1), (11, 1), (12, 1)))
    new = odd_integer(rng, size, "big") if size == 4 else bytes([rng.choice((0, 1, 2, 3, 4, 6, 8, 16, 255))])
    return head[:at] + new + head[at + size :]


def riff(data: bytes, rng: random.Random) -> bytes:
    """AVI, MP4, MKV: the length after or before a four-letter name, or the name itself, changed; or fields after it."""
    names = [found.start() for found in re.finditer(rb"[A-Za-z0-9 ]{4}", data[:4096])]
    at = rng.choice(names) + rng.choice((-4, 0, 4, 4, 8, 12, 16))
    at = max(at, 0)
    return data[:at] + odd_integer(rng, 4, rng.choice(("little", "big"))) + data[at + 4 :]


def matlab(data: bytes, rng: random.Random) -> bytes:
    """A MATLAB 5 file with its first compressed element unpacked, changed, and packed again."""
    kind, length = struct.unpack_from("<II", data, 128)
    if kind != 15:
        return odd_fields(data, rng)
    inside = zlib.decompress(data[136 : 136 + length])
    inside = rng.choice((raw, odd_fields))(inside, rng)
    packed = zlib.compress(inside)
    return data[:128] + struct.pack("<II", 15, len(packed)) + packed + data[136 + length :]


def pickled(data: bytes, rng: random.Random) -> bytes:
    """A pickle with an operation left out, doubled, moved, or its text replaced by another name."""
    places = [at for _, _, at in pickletools.genops(data)] + [len(data)]
    pieces = [data[a:b] for a, b in zip(places, places[1:])]
    at, change = rng.randrange(len(pieces)), rng.randrange(4)
    if change == 0:
        del pieces[at]
    elif change == 1:
        pieces.insert(rng.randrange(len(pieces)), pieces[at])
    elif change == 2:
        pieces[at] = raw(pieces[at], rng)
    else:
        pieces[at] = rng.choice(
            (b"cnumpy\ndtype\n", b"cbuiltins\neval\n", b"cos\nsystem\n", b"b", b"R", b"s", b"u", b"0")
        )
    return b"".join(pieces) + data[places[-1] :]


def gif(data: bytes, rng: random.Random) -> bytes:
    """A GIF with a block's field changed: sizes of the screen, of frames, delays, code sizes, the order of blocks."""
    blocks = [found.start() for found in re.finditer(rb"\x21[\xf9\xff]|\x2c", data)] or [6]
    at = rng.choice((6, 8, 10, rng.choice(blocks) + rng.randrange(12)))
    return data[:at] + odd_integer(rng, rng.choice((1, 2))) + data[at + 2 :]


def renamed_words(data: bytes, rng: random.Random) -> bytes:
    """A binary file with one of its readable names replaced: topics, columns, chunk names."""
    found = rng.choice(list(re.finditer(rb"[A-Za-z_/][\w/.]{3,}", data)))
    return data[: found.start()] + odd_name(rng)[: len(found[0])].ljust(len(found[0]), b"_") + data[found.end() :]


def either(*mutators: Mutator) -> Mutator:
    return lambda data, rng: rng.choice(mutators)(data, rng)


KINDS: tuple[tuple[bytes, Mutator], ...] = (
    (rb"\x89HDF", hdf5),
    (rb"\x93NUMPY", npy),
    (rb"PK\x03\x04", zipped),
    (rb"\x89PNG", png),
    (rb"glTF", glb),
    (rb"GIF8", gif),
    (rb"RIFF|\x1aE\xdf\xa3|....ftyp", riff),
    (rb"MATLAB", matlab),
    (rb"ply|#|VERSION", either(text_head, text_head, raw)),
    (rb"\s*[\[{]", either(json_text, json_text, text)),
    (rb".{8}\{\"", safetensors),
    (rb"\x80[\x02-\x05]", pickled),
    (rb"#ROSBAG|\x89MCAP|SQLite|PAR1", either(renamed_words, odd_fields)),
)
