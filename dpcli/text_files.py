"""Small text and JSON files of people and programs, read so that what is wrong with one is said with its name."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from dpcli.errors import DataError

_HALF = re.compile(r"\\u[dD][89a-fA-F]")


def read_text(path: Path) -> str:
    """Returns the text of a file in UTF-8, with or without a byte order mark. DataError when it is in another encoding.

    Errors of the system (no such file, no permission) pass.
    """
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(
            f"{path}: is not text in UTF-8 (byte {error.start} is {error.object[error.start]:#04x}); save it as UTF-8"
        ) from None


def read_json(path: Path) -> Any:
    """Returns what a JSON file says. DataError as `read_text` and `parse_json`."""
    return parse_json(read_text(path), path)


def parse_json(text: str | bytes, where: object) -> Any:
    """Returns what JSON text of `where` says. DataError when it is none, too deep, or has half a letter in a string."""
    try:
        if isinstance(text, bytes):
            text = text.decode("utf-8-sig")
        value = json.loads(text)
        if _HALF.search(text):
            json.dumps(value, ensure_ascii=False).encode()
    except UnicodeEncodeError:
        raise DataError(f"{where}: is not JSON (half of a letter, a lone surrogate, in a string)") from None
    except UnicodeDecodeError:
        raise DataError(f"{where}: is not JSON (its text is not UTF-8); save it as UTF-8") from None
    except (ValueError, RecursionError) as error:
        raise DataError(f"{where}: is not JSON ({error})") from None
    return value
