"""Texts of any encoding, told by their byte order marks, their zeros or their bytes."""

from __future__ import annotations

import codecs
from pathlib import Path

from dpcli.errors import DataError

_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)


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
        return data.decode(encoding or "utf-8").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError:
        if encoding:
            raise DataError(f"{path}: not readable as {encoding}, perhaps truncated; save it as UTF-8") from None
        return data.decode("latin-1").replace("\r\n", "\n").replace("\r", "\n")
