"""Size and density of training videos, and a warning where a model is asked about quite others.

A network answers anyway: millimeters where it learned meters, or a lidar where it learned a radar, give scores like any others.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dpcli.classify.network.model_file import SHIPPED, ModelInfo, find_model
from dpcli.runtime.progress import log
from dpcli.store import CloudsReader

NOTE = "learned_from"  # in a model's notes: `like`
_VIDEOS, _FRAMES = 50, 8  # looked at, evenly over a file and over a video
_OTHER_UNIT, _OTHER_SENSOR = 3.0, 10.0  # times as large, times as many points
_REPEATED = 8  # times that a point is drawn, at which nothing is left of a shape
_SHIPPED = 0.233  # extent of MSR-Action3D's training videos: the shipped networks' files don't say it
_EXPECT = "; expect fewer right than in its training (another sensor?)"


def like(frames: Sequence[np.ndarray]) -> dict[str, float]:
    """Returns the median distance of points f32 (N,3) of some frames from their median, and the median number of points of a
    frame; {} where no frame has any."""
    points = np.concatenate(frames) if len(frames) else np.zeros((0, 3))
    if not len(points):
        return {}
    distance = np.linalg.norm(points - np.median(points, 0), axis=1)
    return {"extent": float(np.median(distance)), "points": float(np.median([len(frame) for frame in frames]))}


def file_like(reader: CloudsReader, sequences: Sequence[int]) -> dict[str, float]:
    """Returns `like` in the median of some videos of a file."""
    found = []
    for number in list(sequences)[:: -(-len(sequences) // _VIDEOS) or 1]:
        count = int(reader.frame_counts[number])
        shown = range(0, count, -(-count // _FRAMES))
        video = reader.read(number, shown, fields=())
        found.append(like([video.frame(t) for t in range(video.num_frames)]))
    found = [one for one in found if one]
    return {key: float(np.median([one[key] for one in found])) for key in (found[0] if found else ())}


def tell_unlike(what: str, theirs: dict[str, float], info: ModelInfo, model: str | Path) -> None:
    """Warns where videos are much larger, smaller, denser or sparser than those that a model learned from.

    what: the file or stream. theirs: `like` of it. model: its name or file.
    """
    own = info.notes.get(NOTE) or ({"extent": _SHIPPED} if find_model(model).parent == SHIPPED else {})
    size = own.get("extent") if isinstance(own, dict) else None
    far = theirs.get("extent")
    in_units = info.config.normalize not in ("height", "unit")
    if size and far is not None and in_units and not size / _OTHER_UNIT < far < size * _OTHER_UNIT:
        log.warn(
            f"{what}: half of the points lie within {far:.3g} of the middle, within {size:.3g} in what {model} learned from:"
            " another unit of length? The scores mean nothing then; `dpc prepare clouds --scale` brings both to the same"
        )
    if info.timing == "slots" and size and theirs:
        many, count = theirs["points"], own["points"]
        if not count / _OTHER_SENSOR < many < count * _OTHER_SENSOR:
            log.warn(
                f"{what}: a frame has {many:g} points in the median, {count:g} in what {model} learned from{_EXPECT}"
            )
    elif theirs and theirs["points"] * _REPEATED < info.config.points_per_frame:
        drawn = info.config.points_per_frame
        log.warn(
            f"{what}: a frame has {theirs['points']:g} points in the median, {model} takes {drawn}: repeated{_EXPECT}"
        )
