"""Text, JSON and TOML files of people and programs, read so that what is wrong with one is said with its name."""

from __future__ import annotations

import codecs
import json
import re
import sys
from collections import Counter
from pathlib import Path
from typing import Any

from dpcli.errors import DataError, DpcError

_DEEPEST = 100  # lists and mappings in each other
_TOO_DEEP = f"nested more than {_DEEPEST} deep, as no file of this kind is"
_MOST_PLACES = 1000  # of one list
_HALF = re.compile(r"\\u[dD][89a-fA-F]")
_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)


def read_text(path: Path) -> str:
    """Returns the text of a file in UTF-8, with or without a byte order mark. Raises DataError when it is in another encoding.

    Errors of the system (no such file, no permission) pass.
    """
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(
            f"{path}: is not text in UTF-8 (byte {error.start} is {error.object[error.start]:#04x}); save it as UTF-8"
        ) from None


def decode_text(path: Path) -> str:
    """Returns the text of a file in UTF-8, or in UTF-16 or 32 by its mark or its zeros; else byte by byte (Latin-1)."""
    data = path.read_bytes()
    encoding = next((name for mark, name in _MARKS if data.startswith(mark)), "")
    if not encoding and b"\0" in data[:200].rstrip(b"\0"):  # zeros at the end are what a crash leaves
        zeros = [data[:200][k::2].count(0) for k in (0, 1)]
        if min(zeros) > 5 or max(zeros) < len(data[:200]) // 4:
            raise DataError(f"{path}: not text; expected numbers in columns")
        encoding = "utf-16-be" if zeros[0] > zeros[1] else "utf-16-le"
    try:
        text = data.decode(encoding or "utf-8")
    except UnicodeDecodeError:
        if encoding:
            raise DataError(f"{path}: not readable as {encoding}, perhaps truncated; save it as UTF-8") from None
        text = data.decode("latin-1")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_json(path: Path) -> Any:
    """Returns what a JSON file says. Raises DataError as `read_text` and `parse_json`."""
    return parse_json(read_text(path), path)


def distinct_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Returns the mapping of what one in JSON says. Raises ValueError where a key has two values."""
    found = dict(pairs)
    if len(found) < len(pairs):
        twice = next(key for key, count in Counter(key for key, _ in pairs).items() if count > 1)
        raise ValueError(f"two values of the key {twice[:80]!r} in one mapping; keep one of them")
    return found


def parse_json(text: str | bytes, where: object, as_browsers: bool = False) -> Any:
    """Returns what JSON text of `where` says. ``as_browsers``: of two values of one key the last counts.

    Raises DataError when it is none, too deep, has half a letter in a string, or two values of one key.
    """
    try:
        if isinstance(text, bytes):
            text = text.decode("utf-8-sig")
        value = json.loads(text, object_pairs_hook=None if as_browsers else distinct_keys)
        if _HALF.search(text):
            json.dumps(value, ensure_ascii=False).encode()
    except UnicodeEncodeError:
        raise DataError(f"{where}: is not JSON (half of a letter, a lone surrogate, in a string)") from None
    except UnicodeDecodeError:
        raise DataError(f"{where}: is not JSON (its text is not UTF-8); save it as UTF-8") from None
    except RecursionError:
        raise DataError(f"{where}: {_TOO_DEEP}") from None
    except ValueError as error:
        raise DataError(f"{where}: is not JSON ({error})") from None
    check_depth(value, where)
    return value


def check_depth(value: Any, where: object) -> None:
    """Raises DataError where lists and mappings lie deeper in each other than any real file's, or in a circle, or one in
    so many places that a small file becomes a huge one, as YAML allows. What walks through them may then call itself.
    """
    level = [(value, 1)] if isinstance(value, (dict, list)) else []
    for _ in range(_DEEPEST):
        places: Counter[int] = Counter()
        inside: dict[int, Any] = {}
        for one, times in level:
            for child in one.values() if isinstance(one, dict) else one:
                if isinstance(child, (dict, list)):
                    inside[id(child)] = child
                    places[id(child)] += times
        if not inside:
            return
        if max(places.values()) > _MOST_PLACES:
            raise DataError(
                f"{where}: names one of its lists in more than {_MOST_PLACES} places; no file of this kind does"
            )
        level = [(child, places[key]) for key, child in inside.items()]
    raise DataError(f"{where}: {_TOO_DEEP}")


def read_toml(path: Path) -> dict[str, Any]:
    """Returns the content of a TOML file; raises DataError if it is none or not there. Before Python 3.11 the reader is a package
    of its own.
    """
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        try:
            import tomli as tomllib
        except ImportError:
            raise DpcError("reading TOML on Python 3.10 needs a package: pip install tomli") from None
    try:
        return tomllib.loads(read_text(path))
    except RecursionError:
        raise DataError(f"{path}: {_TOO_DEEP}") from None
    except IsADirectoryError:
        raise DataError(f"{path}: is a folder; expected a TOML file") from None
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except OSError as error:
        raise DataError(f"{path}: can't be read ({(error.strerror or str(error)).lower()})") from None
    except tomllib.TOMLDecodeError as error:
        raise DataError(f"{path}: not TOML ({error})") from None
    except ValueError:
        raise DataError(f"{path}: not TOML (it holds a number too long to be one)") from None
