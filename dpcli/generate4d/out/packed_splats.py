"""Gaussians in the packed files of players: SuperSplat's `.compressed.ply` and Niantic's `.spz`. gsply is an extra."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.generate4d.out.splat_files import Splats
from dpcli.runtime.whole_file import not_writable, whole_file, write_whole

_BITS = (16, 12, 8, 4)  # of 24 a coordinate, behind the point: steps of 1/65536, of 1/4096 ...
_LOG_SIZES = -10.0, 5.95  # logarithms of the least and the largest size, which is written as a byte of sixteenths
_REACH = 120.0  # units up to which the finest do, which end at 128; each other ones 16 times as far


def write_compressed_ply(path: Path, splats: Splats) -> None:
    """Writes one .compressed.ply: chunks of 256 Gaussians, 16 bytes each and the chunk's ranges.

    Raises DataError when it can't be written or gsply is not installed.
    """
    gsply = _gsply(path)
    # not its plywrite, which imports torch and its compiler to look at what it was given
    write_whole(path, gsply.compress_to_bytes(_data(gsply, splats)))


def write_spz(path: Path, splats: Splats) -> None:
    """Writes one .spz of version 3: 24 bits a coordinate, a byte for each size, color and opacity, 4 for the orientation.

    The format's axes are x right, y up, z back, as the scene's own are. Raises DataError when it can't be written, of
    coordinates and sizes that the format doesn't hold, or when gsply is not installed.
    """
    gsply = _gsply(path)
    farthest = float(np.abs(splats.mean).max())
    bits = next((bits for bits in _BITS if farthest < _REACH * 2 ** (_BITS[0] - bits)), None)
    if bits is None:
        raise DataError(f"{path}: .spz holds no coordinate of {farthest:g}; write --as compressed.ply or ply")
    longest = splats.log_scale.max(1)
    if longest.max() > _LOG_SIZES[1] or np.median(longest) < _LOG_SIZES[0]:
        bounds, own = np.exp(_LOG_SIZES), np.exp([longest.min(), longest.max()])
        raise DataError(
            f"{path}: .spz holds sizes of {bounds[0]:.2g} to {bounds[1]:.3g}, but the Gaussians have {own[0]:.2g} to {own[1]:.3g};"
            " write --as compressed.ply or ply"
        )
    try:
        with whole_file(path) as part:
            gsply.write_spz(part, _data(gsply, splats), fractional_bits=bits)
            content = gzip.decompress(part.read_bytes())
            part.write_bytes(gzip.compress(content, mtime=0))  # equal scenes give equal bytes
    except OSError as error:
        raise not_writable(path, error) from None


def _gsply(path: Path) -> Any:
    try:
        import gsply
    except ImportError:
        raise DataError(f"{path}: gsply is needed to write it; pip install 'dpc-toolkit[splats]'") from None
    return gsply


def _data(gsply: Any, splats: Splats) -> Any:
    rest = splats.sh[:, 1:] if splats.sh.shape[1] > 1 else None
    arrays = (splats.mean, splats.log_scale, splats.quaternion, splats.opacity_logit, splats.sh[:, 0], rest)
    means, scales, quaternions, opacities, colors, terms = (
        None if values is None else np.ascontiguousarray(values, np.float32) for values in arrays
    )
    return gsply.GSData.from_arrays(means, scales, quaternions, opacities, colors, terms, format="ply")
