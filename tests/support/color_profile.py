"""ICC profiles of any RGB primaries, as cameras and editors put them into pictures, built by hand."""

from __future__ import annotations

import struct

import numpy as np

P3 = ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060))
BT709 = ((0.640, 0.330), (0.300, 0.600), (0.150, 0.060))
_D65, _D50 = (0.3127, 0.3290), np.array([0.9642, 1, 0.8249])
_CONES = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])  # of Bradford


def to_xyz(primaries) -> np.ndarray:
    """The matrix (3,3) from linear RGB to XYZ, under D65."""
    x, y = _D65
    red_green_blue = np.array([[a / b, 1, (1 - a - b) / b] for a, b in primaries]).T
    return red_green_blue * np.linalg.solve(red_green_blue, [x / y, 1, (1 - x - y) / y])


def color_profile(primaries, gamma: float = 2.2, name: bytes = b"wide") -> bytes:
    """A profile of version 2 by a matrix and one gamma."""
    matrix = to_xyz(primaries)
    white = matrix.sum(1)
    columns = np.linalg.inv(_CONES) @ np.diag((_CONES @ _D50) / (_CONES @ white)) @ _CONES @ matrix
    described = b"desc" + struct.pack(">II", 0, len(name) + 1) + name + bytes(1 + 4 + 4 + 2 + 1 + 67)
    curve = b"curv" + struct.pack(">IIH", 0, 1, round(gamma * 256)) + bytes(2)
    parts = {b"desc": described, b"cprt": b"text" + bytes(8), b"wtpt": _xyz(_D50)}
    parts |= {key: _xyz(column) for key, column in zip((b"rXYZ", b"gXYZ", b"bXYZ"), columns.T)}
    parts |= dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), curve)
    start = 128 + 4 + 12 * len(parts)
    table, body = struct.pack(">I", len(parts)), b""
    for key, part in parts.items():
        table += key + struct.pack(">II", start + len(body), len(part))
        body += part + bytes(-len(part) % 4)
    head = (
        struct.pack(">I4xI", start + len(body), 0x02400000) + b"mntrRGB XYZ " + struct.pack(">6H", 2020, 1, 1, 0, 0, 0)
    )
    head += b"acsp" + bytes(28) + _xyz(_D50)[8:]
    return head.ljust(128, bytes(1)) + table + body


def _xyz(values) -> bytes:
    return b"XYZ " + struct.pack(">I3i", 0, *(round(value * 65536) for value in values))
