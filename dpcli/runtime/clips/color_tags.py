"""Color tags of images that Pillow passes over: cICP of PNG and nclx of AVIF, by the numbers of H.273."""

from __future__ import annotations

from pathlib import Path

_NCLX = b"colrnclx"
_SEARCHED = 1 << 16  # bytes of an AVIF that hold the boxes before its pictures


def color_tags(path: Path, kind: str | None) -> tuple[int, int] | None:
    """Returns transfer function and primaries that a file of this kind, as Pillow names it, is tagged with; None without."""
    if kind not in ("PNG", "AVIF"):
        return None
    with path.open("rb") as file:
        if kind == "AVIF":
            head = file.read(_SEARCHED)
            at = head.find(_NCLX) + len(_NCLX)
            found = head[at : at + 4] if at >= len(_NCLX) else b""
            return (int.from_bytes(found[2:4], "big"), int.from_bytes(found[:2], "big")) if len(found) == 4 else None
        file.seek(8)
        while len(start := file.read(8)) == 8 and start[4:] != b"IDAT":
            if start[4:] == b"cICP" and len(found := file.read(2)) == 2:
                return found[1], found[0]
            file.seek(int.from_bytes(start[:4], "big") + 4, 1)
    return None
