"""Damage to files: bytes as they are, texts by their words, containers by their fields (container_mutators.py).

Every mutator takes the bytes and a generator and returns other bytes; it raises where the bytes are not of its kind.
"""

from __future__ import annotations

import json
import random
import re
import struct
from collections.abc import Callable
from typing import Any

Mutator = Callable[[bytes, random.Random], bytes]

INTEGERS = (0, 1, -1, 2, 127, 128, 255, 256, 32767, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63 - 1, 2**64 - 1)
NUMBERS = (
    "-1 0 1 nan inf -inf 1e309 1e30 1e-320 99999999999 20000000 2147483648 9223372036854775808 0x10 1_0 +3 .".split()
)
NAMES = (
    "", ".", "..", "../../outside/x", "/outside/x", "file:///outside/x", "a\x1b[31mRED\x1b[0m", "a\0b", "\ud800", "é",
    "a\nb", "a" * 300, "<b>x</b>", "|a|", "-o", "~", "C:\\x", "\u202ereversed", "nan", "%s%n", "{0}", "__class__",
)  # fmt: skip
VALUES = (
    None, True, False, 0, -1, 1e308, 2**31, 2**63, 10**30, float("nan"), float("inf"), "", "x", "../../outside/x",
    "\x1b[31mRED", "\0", "\ud800", [], {}, [[]], [0] * 1000, {"": 0}, "9" * 400,
)  # fmt: skip


def odd_name(rng: random.Random) -> bytes:
    return rng.choice(NAMES).encode("utf-8", "surrogatepass")


def odd_integer(rng: random.Random, size: int, order: str = "little") -> bytes:
    return (rng.choice(INTEGERS) % (1 << 8 * size)).to_bytes(size, order)


def raw(data: bytes, rng: random.Random) -> bytes:
    """One of the plain damages: bits, numbers, parts that are lost, doubled, zeroed or foreign."""
    return rng.choice(_RAW)(data, rng)


def _place(data: bytes, rng: random.Random) -> int:
    """A place in the bytes, half of the time near the begin, where headers are."""
    return rng.randrange(min(len(data), rng.choice((64, 512, 1 << 30))) or 1)


def _piece(data: bytes, rng: random.Random) -> tuple[int, int]:
    start = _place(data, rng)
    return start, start + rng.choice((1, 2, 4, 8, 16, 64, 256, len(data)))


def _flip(data: bytes, rng: random.Random) -> bytes:
    made = bytearray(data or b"\0")
    for _ in range(rng.choice((1, 1, 2, 8, 64))):
        made[_place(data, rng)] ^= 1 << rng.randrange(8)
    return bytes(made)


def _number(data: bytes, rng: random.Random) -> bytes:
    size = rng.choice((1, 2, 4, 4, 8))
    at = _place(data, rng) // size * size
    return data[:at] + odd_integer(rng, size, rng.choice(("little", "big"))) + data[at + size :]


def _truncate(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.choice((_place(data, rng), len(data) - 1, len(data) // 2))]


def _delete(data: bytes, rng: random.Random) -> bytes:
    start, stop = _piece(data, rng)
    return data[:start] + data[stop:]


def _double(data: bytes, rng: random.Random) -> bytes:
    start, stop = _piece(data, rng)
    return data[:stop] + data[start:stop] * rng.choice((1, 1, 3)) + data[stop:]


def _fill(data: bytes, rng: random.Random) -> bytes:
    start, stop = _piece(data, rng)
    stop = min(stop, len(data))
    return data[:start] + rng.choice((b"\0", b"\xff", b" ", b"A")) * (stop - start) + data[stop:]


def _insert(data: bytes, rng: random.Random) -> bytes:
    at = _place(data, rng)
    return data[:at] + rng.choice((rng.randbytes(8), odd_name(rng), b"\0" * 64)) + data[at:]


_RAW: tuple[Mutator, ...] = (_flip, _flip, _number, _number, _truncate, _delete, _double, _fill, _insert)

_NUMBER_IN_TEXT = re.compile(rb"(?<![A-Za-z_])[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_WORD_IN_TEXT = re.compile(rb"[A-Za-z_][\w./-]*")


def text(data: bytes, rng: random.Random) -> bytes:
    """A text with one number, word or line changed, other separators, or another encoding."""
    return rng.choice(_TEXT)(data, rng)


def text_head(data: bytes, rng: random.Random) -> bytes:
    """A file that begins with lines of text (PLY, PCD) with the text changed and the payload kept."""
    end = re.search(rb"end_header\s*?\n|^DATA .*\n|\n\n", data, re.MULTILINE)
    if end is None:
        raise ValueError("no text at the head")
    return text(data[: end.end()], rng) + data[end.end() :]


def _replace_match(pattern: re.Pattern[bytes], data: bytes, new: bytes, rng: random.Random) -> bytes:
    found = rng.choice(list(pattern.finditer(data)))
    return data[: found.start()] + new + data[found.end() :]


def _text_number(data: bytes, rng: random.Random) -> bytes:
    return _replace_match(_NUMBER_IN_TEXT, data, rng.choice(NUMBERS).encode(), rng)


def _text_word(data: bytes, rng: random.Random) -> bytes:
    others = _WORD_IN_TEXT.findall(data)
    new = rng.choice(others) if rng.random() < 0.4 else odd_name(rng)
    return _replace_match(_WORD_IN_TEXT, data, new, rng)


def _text_line(data: bytes, rng: random.Random) -> bytes:
    lines = data.splitlines(keepends=True)
    at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    change = rng.randrange(4)
    if change == 0:
        del lines[at]
    elif change == 1:
        lines.insert(other, lines[at])
    elif change == 2:
        lines[at], lines[other] = lines[other], lines[at]
    else:
        lines[at] = lines[at][: len(lines[at]) // 2]
    return b"".join(lines)


def _text_separator(data: bytes, rng: random.Random) -> bytes:
    old = rng.choice((b" ", b",", b"\n", b'"', b":", b"=", b"."))
    return data.replace(old, rng.choice((b"", b" ", b",", b";", b"\t", b"\r", b"\r\n", b"\0")))


def _text_encoding(data: bytes, rng: random.Random) -> bytes:
    said = data.decode("latin-1")
    return rng.choice((b"\xef\xbb\xbf" + data, said.encode("utf-16"), said.encode("utf-32-le"), b"\xff\xfe" + data))


_TEXT: tuple[Mutator, ...] = (_text_number, _text_number, _text_number, _text_word, _text_word, _text_line,
                              _text_separator, _text_encoding)  # fmt: skip


def json_text(data: bytes, rng: random.Random) -> bytes:
    """JSON with one value replaced, removed, doubled, renamed, or very deep."""
    return json.dumps(changed(json.loads(data), rng)).encode("utf-8", "surrogatepass")


def changed(tree: Any, rng: random.Random) -> Any:
    """The tree of lists and dictionaries with one node changed."""
    places = list(_places(tree))
    if not places or rng.random() < 0.05:
        return rng.choice(VALUES)
    parent, key = rng.choice(places)
    change = rng.randrange(8)
    if change == 0:
        del parent[key]
    elif change == 1 and isinstance(parent, dict):
        parent[rng.choice(NAMES)] = parent.pop(key)
    elif change == 2:
        parent[key] = [parent[key]]
    elif change == 3:
        for _ in range(rng.choice((50, 900))):
            parent[key] = [parent[key]]
    else:
        parent[key] = _like(parent[key], rng)
    return tree


def _places(tree: Any) -> Any:
    entries = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in entries:
        yield tree, key
        yield from _places(value)


def _like(value: Any, rng: random.Random) -> Any:
    """An odd value, half of the time of the same kind."""
    if rng.random() < 0.5:
        return rng.choice(VALUES)
    if isinstance(value, (int, float)):
        return rng.choice((-value, value + 1, value * 1000, *INTEGERS))
    return rng.choice(NAMES) if isinstance(value, str) else rng.choice(VALUES)


def glb(data: bytes, rng: random.Random) -> bytes:
    """A binary glTF whose JSON is changed, with the lengths made right again."""
    length = struct.unpack_from("<I", data, 12)[0]
    tree = json_text(data[20 : 20 + length], rng)
    tree += b" " * (-len(tree) % 4)
    rest = data[20 + length :]
    return data[:8] + struct.pack("<III", 20 + len(tree) + len(rest), len(tree), 0x4E4F534A) + tree + rest


def safetensors(data: bytes, rng: random.Random) -> bytes:
    """Weights whose header of JSON is changed, metadata inside it too, with its length made right again."""
    length = struct.unpack_from("<Q", data)[0]
    head = json.loads(data[8 : 8 + length])
    about = head.get("__metadata__", {})
    if about and rng.random() < 0.7:
        key = rng.choice(sorted(about))
        about[key] = (json_text if about[key][:1] in "[{" else text)(about[key].encode(), rng).decode(errors="replace")
    else:
        head = changed(head, rng)
    made = json.dumps(head).encode("utf-8", "surrogatepass")
    return struct.pack("<Q", len(made)) + made + data[8 + length :]
