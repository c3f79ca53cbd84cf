"""Depth in OpenEXR files, as renderers write it. OpenEXR is an extra."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.runtime.clips.images import require_plausible


def read_exr(path: Path) -> np.ndarray:
    """Reads one frame (H,W) f32 or u32 of an ``.exr``: its only channel, the one called Z or depth, or three equal ones.

    Raises DataError when it can't be read, holds colors, or OpenEXR is not installed.
    """
    try:
        import OpenEXR
    except ImportError:
        raise DataError(f"{path}: OpenEXR is needed to read it; pip install 'dpc-toolkit[exr]'") from None
    try:
        low, high = OpenEXR.File(str(path), True, True).header()["dataWindow"]
        require_plausible(path, *(int(b) - int(a) + 1 for a, b in zip(low, high)), path.stat().st_size)
        channels = {name: channel.pixels for name, channel in OpenEXR.File(str(path), True).channels().items()}
    except DataError:
        raise
    except Exception:  # RuntimeError, and of a file that lost its end ValueError
        raise DataError(f"{path}: not a readable OpenEXR image (empty, truncated, or of another kind)") from None
    named = [name for name in channels if name.rpartition(".")[2].lower() in ("z", "depth") or "depth" in name.lower()]
    chosen = next((choice for choice in (list(channels), named) if len(choice) == 1), list(channels))
    first = channels[chosen[0]]
    if any(not np.array_equal(first, channels[name]) for name in chosen[1:] if not name.endswith("A")):
        raise DataError(f"{path}: holds channels {', '.join(sorted(channels))}; expected one called Z or depth")
    return first.astype(np.float32) if first.dtype == np.float16 else first
