"""Frames of videos as their file says they are shown: turned by quarters, mirrored, two views in each, or a panorama."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

# a, b, c, d: what is stored at (x, y) from the middle is shown at (ax + cy, bx + dy)
Matrix = tuple[int, int, int, int]
_BESIDE = {1: "side by side", 2: "one above the other", 4: "pixel by pixel", 5: "side by side", 6: "line by line"}
_BESIDE |= {7: "column by column"}
_FLAT = 4  # a projection that is none
_NEWER = 16  # kinds of what stands beside frames that FFmpeg may know and PyAV not
_KINDS = ("DISPLAYMATRIX", "STEREO3D", "SPHERICAL")
_TURNED = ((1, 0, 0, 1), (0, -1, 1, 0), (-1, 0, 0, -1), (0, 1, -1, 0))  # by quarters, counterclockwise


def display_matrix(frame) -> Matrix:  # frame: av.VideoFrame
    """Returns the display matrix of a frame; the one that changes nothing where it has none."""
    told = _told_beside(frame)
    if told is None:
        return _TURNED[round(frame.rotation / 90) % 4]
    if "DISPLAYMATRIX" not in told:
        return _TURNED[0]
    a, b, _, c, d = told["DISPLAYMATRIX"][:5]
    return a, b, c, d


def more_than_a_picture(frame) -> str:  # frame: av.VideoFrame
    """Returns what a frame holds that is no plain picture, as its file says: two views, or a panorama; "" where it doesn't."""
    told = _told_beside(frame) or {}
    beside = _BESIDE.get(next(iter(told.get("STEREO3D", [])), 0))
    round_about = next(iter(told.get("SPHERICAL", [])), _FLAT) != _FLAT
    return f"two views {beside}" if beside else "a panorama" if round_about else ""


def _told_beside(frame) -> dict[str, list[int]] | None:
    """Returns what a file tells beside a frame, as whole numbers by kind; None where PyAV can't tell."""
    import av

    try:
        beside = _readable_beside(frame).side_data
        told = {kind: bytes(one) for kind in _KINDS if (one := beside.get(kind)) is not None}
        return {kind: np.frombuffer(data, "<i4", len(data) // 4).tolist() for kind, data in told.items()}
    except (ValueError, av.FFmpegError):  # such as pixels that filters don't know
        return None


def _readable_beside(frame):  # -> av.VideoFrame
    """Returns the frame without what PyAV can't read beside it: a color profile, whose name it frees twice, which ends the
    process, and kinds that are newer than it, such as EXIF.
    """
    import av
    from av.sidedata.sidedata import Type

    graph = av.filter.Graph()
    nodes = [graph.add_buffer(width=frame.width, height=frame.height, format=frame.format, time_base=Fraction(1, 1000))]
    for kind in ("ICC_PROFILE", *range(len(Type), len(Type) + _NEWER)):
        nodes.append(graph.add("sidedata", f"mode=delete:type={kind}"))
    nodes.append(graph.add("buffersink"))
    for node, following in zip(nodes, nodes[1:]):
        node.link_to(following)
    graph.configure()
    nodes[0].push(frame)
    return nodes[-1].pull()


def as_it_plays(picture: np.ndarray, matrix: Matrix) -> np.ndarray:
    """Returns the picture (H,W,C) turned and mirrored, its rows in order in memory."""
    a, b, c, d = matrix
    if abs(b) > abs(a):
        picture, a, d = picture.transpose(1, 0, 2), c, b
    return np.ascontiguousarray(picture[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1])
