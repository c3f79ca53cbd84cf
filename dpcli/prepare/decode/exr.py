"""Depth in OpenEXR files, as renderers write it. OpenEXR is an extra."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.runtime.clips.images import require_plausible


def read_exr(path: Path) -> np.ndarray:
    """Reads one frame (H,W) f32 or u32 of an ``.exr``: its only channel, the one called Z or depth, or three equal ones;
    of several parts those of all, and beside others no alpha.

    Raises DataError when it can't be read, holds colors, or OpenEXR is not installed.
    """
    try:
        import OpenEXR
    except ImportError:
        raise DataError(f"{path}: OpenEXR is needed to read it; pip install 'dpc-toolkit[exr]'") from None
    try:
        for part in OpenEXR.File(str(path), True, True).parts:
            low, high = part.header["dataWindow"]
            require_plausible(path, *(int(b) - int(a) + 1 for a, b in zip(low, high)), path.stat().st_size)
        parts = OpenEXR.File(str(path), True).parts
        channels = {
            f"{part.name()}.{name}" if len(parts) > 1 else name: channel.pixels
            for part in parts
            for name, channel in part.channels.items()
        }
    except DataError:
        raise
    except Exception:  # RuntimeError, and of a file that lost its end ValueError
        raise DataError(f"{path}: not a readable OpenEXR image (empty, truncated, or of another kind)") from None
    named = [name for name in channels if name.rpartition(".")[2].lower() in ("z", "depth") or "depth" in name.lower()]
    opaque = [name for name in channels if name.rpartition(".")[2] != "A"] or list(channels)
    chosen = named if len(named) == 1 else opaque
    first = channels[chosen[0]]
    if any(not np.array_equal(first, channels[name]) for name in chosen[1:]):
        raise DataError(f"{path}: holds channels {', '.join(sorted(channels))}; expected one called Z or depth")
    return first.astype(np.float32) if first.dtype == np.float16 else first
