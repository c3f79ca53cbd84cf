"""Frames of videos turned by quarters and mirrored, as the display matrix of their file says."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

Matrix = tuple[
    int, int, int, int
]  # a, b, c, d: what is stored at (x, y) from the middle is shown at (ax + cy, bx + dy)
_TURNED = ((1, 0, 0, 1), (0, -1, 1, 0), (-1, 0, 0, -1), (0, 1, -1, 0))  # by quarters, counterclockwise


def display_matrix(frame) -> Matrix:  # frame: av.VideoFrame
    """Returns the display matrix of a frame; the one that changes nothing where it has none."""
    import av

    try:
        stored = _without_profile(frame).side_data.get("DISPLAYMATRIX")
    except (ValueError, av.FFmpegError):  # side data that PyAV doesn't know, or pixels that filters don't
        return _TURNED[round(frame.rotation / 90) % 4]
    if stored is None:
        return _TURNED[0]
    a, b, _, c, d = np.frombuffer(bytes(stored), "<i4")[:5].tolist()
    return a, b, c, d


def _without_profile(frame):  # -> av.VideoFrame
    """Returns the frame without a color profile, whose name PyAV frees twice, which ends the process."""
    import av

    graph = av.filter.Graph()
    source = graph.add_buffer(width=frame.width, height=frame.height, format=frame.format, time_base=Fraction(1, 1000))
    bare, sink = graph.add("sidedata", "mode=delete:type=ICC_PROFILE"), graph.add("buffersink")
    source.link_to(bare)
    bare.link_to(sink)
    graph.configure()
    source.push(frame)
    return sink.pull()


def as_it_plays(picture: np.ndarray, matrix: Matrix) -> np.ndarray:
    """Returns the picture (H,W,C) turned and mirrored, its rows in order in memory."""
    a, b, c, d = matrix
    if abs(b) > abs(a):
        picture, a, d = picture.transpose(1, 0, 2), c, b
    return np.ascontiguousarray(picture[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1])
