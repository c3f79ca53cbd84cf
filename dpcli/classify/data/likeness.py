"""Size and density of training videos, and a warning where a model is asked about quite others.

A network answers anyway: millimeters where it learned meters, or a lidar where it learned a radar, give scores like any others.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dpcli.classify.network.model_file import SHIPPED, ModelInfo, find_model
from dpcli.counted import counted
from dpcli.runtime.progress import log
from dpcli.store import CloudsReader
from dpcli.store.schema import kept_name

NOTE = "learned_from"  # in a model's notes: `like`
_VIDEOS, _FRAMES = 50, 8  # looked at, evenly over a file and over a video
_OTHER_UNIT, _OTHER_SENSOR = 3.0, 10.0  # times as large, times as many points
_MIXED_UNITS = 10.0  # times as large as the median video: people and gestures differ less, units more
ANY_UNIT = ("height", "unit")  # normalizations after which the unit makes no difference
_RESTING = 10.0  # times as little as in training that a column may vary: who moves little has low speeds
_MISSING = 0.5  # of a column's values, from which on it says nothing
_REPEATED = 8  # times that a point is drawn, at which nothing is left of a shape
_FEWER = 2.0  # times as many points in training: a model that learned from points repeated as often expects them
_OTHER_RATE = 1.5  # times as many frames a second
# of MSR-Action3D's training videos, which the shipped networks' files don't say
_SHIPPED = {"extent": 0.233, "frames": 76.0, "interval": 1 / 15, "x": 0.074, "y": 0.208, "z": 0.037} | {
    "at_x": -0.12,
    "at_y": 0.08,
    "at_z": 1.7,
}
_LONG = 2.0  # times as far along one axis as along the others, as a body that stands
_AHEAD = 1.5  # times as far from the origin along one axis as along the others: where a sensor there looks
_APART = 2.0  # extents from the origin, from which on that is no matter of the body itself
_ROUNDED = 0.05  # of the extent: coarser steps show
_SEVERAL = 5.0  # times as long as the longest training video: hardly one action
_PLACE = "at_x", "at_y", "at_z"
_FINE = 1e-5  # of coordinates up to 100: what lies in one point there is not rounded to it
_EXPECT = "; expect fewer right than in its training (another sensor?)"


def like(frames: Sequence[np.ndarray]) -> dict[str, float]:
    """Returns the median distance of points f32 (N,3) of some frames from their median, also along each axis, where that lies,
    the median number of points of a frame, and the step to which float32 rounds coordinates so far from the origin; {} where
    no frame has any."""
    points = np.concatenate(frames) if len(frames) else np.zeros((0, 3))
    if not len(points):
        return {}
    middle = np.median(points, 0)
    away = points - middle
    distance = np.linalg.norm(away, axis=1)
    along = dict(zip("xyz", np.median(np.abs(away), 0).tolist())) | dict(zip(_PLACE, middle.tolist()))
    sizes = [len(frame) for frame in frames]
    step = np.spacing(np.abs(points).max().astype(np.float32))
    return {"extent": float(np.median(distance)), "points": float(np.median(sizes)), "step": float(step), **along}


def _ahead(found: dict[str, float]) -> str:
    """Returns the direction, such as +z, in which what `like` saw lies from the origin, "" where it isn't clearly one."""
    place = {key: found.get(key, 0.0) for key in _PLACE}
    other, ahead = sorted(place, key=lambda key: abs(place[key]))[1:]
    clear = abs(place[ahead]) > max(_AHEAD * abs(place[other]), _APART * found.get("extent", np.inf))
    return f"{'-' if place[ahead] < 0 else '+'}{ahead[-1]}" if clear else ""


def _longest_axis(found: dict[str, float]) -> str:
    """Returns the axis along which the points of `like` reach much farther than along both others, "" where none is."""
    other, longest = sorted((found.get(axis, 0.0), axis) for axis in "xyz")[1:]
    return longest[1] if longest[0] > _LONG * other[0] else ""


def tell_upright(what: str, found: dict[str, float], normalize: str) -> None:
    """Warns where bodies, as `like` saw them, are to be made equally tall along y, and seem to stand along another axis."""
    ahead, longest = _ahead(found), _longest_axis(found)
    if normalize != "height" or longest == "y" or not (longest or ahead[1:] in ("x", "y")):
        return
    seen = (
        f"is longest along {longest}"
        if longest
        else f"lies along {ahead} from the origin, as before sensors whose z is upright"
    )
    log.warn(
        f"{what}: what is seen {seen}, and normalize=height makes bodies equally tall along y: is another axis the upright one? Then"
        " their sizes would depend on what they do; exchange the axes in the raw data, or take --set normalize=unit"
    )


def file_like(reader: CloudsReader, sequences: Sequence[int]) -> dict[str, float]:
    """Returns `like` in the median of some videos of a file, and of all of them the frames of the longest and, where their times
    are known, the median seconds from frame to frame."""
    found = list(_looks(reader, sequences).values())
    middle = {key: float(np.median([one[key] for one in found])) for key in (found[0] if found else ())}
    intervals = list(_intervals(reader, sequences).values())
    rate = {"interval": float(np.median(intervals))} if intervals else {}
    return {**middle, **rate, "frames": float(reader.frame_counts[list(sequences)].max(initial=0))}


def _looks(reader: CloudsReader, sequences: Sequence[int]) -> dict[int, dict[str, float]]:
    """Returns `like` of some videos, evenly over these, by sequence; those without points are left out."""
    found = {}
    for number in list(sequences)[:: -(-len(sequences) // _VIDEOS) or 1]:
        count = int(reader.frame_counts[number])
        shown = range(0, count, -(-count // _FRAMES))
        video = reader.read(number, shown, fields=())
        found[number] = like([video.frame(t) for t in range(video.num_frames)])
    return {number: one for number, one in found.items() if one}


def tell_mixed_sizes(reader: CloudsReader, sequences: Sequence[int]) -> None:
    """Warns where some videos of a file are so much larger or smaller than its median one that they have another unit."""
    extents = {i: one["extent"] for i, one in _looks(reader, sequences).items() if one["extent"] > 0}
    usual = float(np.median(list(extents.values()))) if extents else 0.0
    others = [i for i, own in extents.items() if not usual / _MIXED_UNITS < own < usual * _MIXED_UNITS]
    if others:
        one = others[0]
        log.warn(
            f"{reader.path}: {len(others)} of {counted(len(extents), 'video')} looked at {'is' if len(others) == 1 else 'are'} over"
            f" {_MIXED_UNITS:g} times as large or small as the median one (half of the points of {reader.names[one]} lie within"
            f" {extents[one]:.3g} of the middle, {usual:.3g} in the median): is their unit of length another one? Bring all into one:"
            " prepare the others again, clouds with --scale, depth videos with --depth-scale"
        )


def _intervals(reader: CloudsReader, sequences: Sequence[int]) -> dict[int, float]:
    """Returns the median seconds from frame to frame of the videos whose times rise, by sequence."""
    found = {}
    for i in sequences:
        times = reader.times(i)
        steps = np.diff(times) if times is not None else np.zeros(0)
        if len(steps) and np.median(steps) > 0:
            found[i] = float(np.median(steps))
    return found


def _own(info: ModelInfo, model: str | Path) -> dict[str, float]:
    """Returns `file_like` of the videos that a model learned from, as far as it is known."""
    own = info.notes.get(NOTE) or (_SHIPPED if find_model(model).parent == SHIPPED else {})
    numbers = own if isinstance(own, dict) else {}
    file = SHIPPED / f"{model}.safetensors"  # elsewhere for the absolute path of another model
    if numbers and file.parent == SHIPPED and file.is_file():  # its notes may be older than those of axes and places
        numbers = _SHIPPED | numbers
    return {key: value for key, value in numbers.items() if isinstance(value, int | float)}


def tell_rounded(what: str, found: dict[str, float]) -> None:
    """Warns where places are rounded so much, as float32 does far from the origin, that bodies lose their shape."""
    if found.get("step", 0) > max(_ROUNDED * found.get("extent", np.inf), _FINE):
        log.warn(
            f"{what}: coordinates are so large, as on a map, that float32 rounds them to {found['step']:.2g}, while half of the"
            f" points lie within {found['extent']:.2g} of the middle: shapes are lost; subtract a nearby position before the file is"
            " written, as `dpc prepare clouds` does"
        )


def tell_long(reader: CloudsReader, sequences: Sequence[int], info: ModelInfo, model: str | Path) -> None:
    """Warns where videos last much longer than any that the model learned from: they get one label, and may show many actions."""
    longest = _own(info, model).get("frames")
    long = [i for i in sequences if longest and reader.frame_counts[i] > _SEVERAL * longest]
    if long:
        log.warn(
            f"{reader.path}: {len(long)} of {counted(len(sequences), 'video')} over {_SEVERAL:g} times as long as any that {model} learned"
            f" from ({reader.names[long[0]]}: {reader.frame_counts[long[0]]} frames after {longest:g}), and each gets one label:"
            " --segments cuts recordings of several actions"
        )


def tell_rate(reader: CloudsReader, sequences: Sequence[int], info: ModelInfo, model: str | Path) -> None:
    """Warns where frames follow each other faster or slower than in what a model of consecutive frames learned from."""
    usual = _own(info, model).get("interval")
    if usual and info.timing == "clips":
        _tell_rate(reader, sequences, usual, f"in what {model} learned from")


def tell_pace(what: str, seconds: float, info: ModelInfo, model: str | Path) -> None:
    """Warns where frames of a stream, so many seconds apart, come faster or slower than in what a model of consecutive frames learned
    from."""
    usual = _own(info, model).get("interval")
    if usual and info.timing == "clips" and not _same_rate(seconds, usual):
        fewer = f"send one of {round(usual / seconds)}" if seconds < usual else "send more of them"
        log.warn(
            f"{what}: frames come {seconds:.3g} s apart, {usual:.3g} in what {model} learned from; clips are consecutive frames, so actions"
            f" are {'slower' if seconds < usual else 'faster'} in them: {fewer}, or train with --timing uniform and give --window"
        )


def _same_rate(seconds: float, usual: float) -> bool:
    return usual / _OTHER_RATE < seconds < usual * _OTHER_RATE


def tell_mixed_rates(reader: CloudsReader, sequences: Sequence[int], looks: dict[str, float], timing: str) -> None:
    """Warns where some training videos have another frame rate than most, of which clips of consecutive frames know nothing.

    looks: `file_like` of them.
    """
    if timing == "clips" and "interval" in looks:
        _tell_rate(reader, sequences, looks["interval"], "in the median video")


def _tell_rate(reader: CloudsReader, sequences: Sequence[int], usual: float, where: str) -> None:
    found = _intervals(reader, sequences)
    others = [i for i, own in found.items() if not _same_rate(own, usual)]
    if others:
        log.warn(
            f"{reader.path}: another frame rate in {len(others)} of {counted(len(sequences), 'video')} (frames of"
            f" {reader.names[others[0]]} are {found[others[0]]:.3g} s apart, {usual:.3g} {where}); clips are consecutive frames, so"
            " actions are faster or slower in them: prepare the faster videos with --stride, or train with --timing uniform"
        )


def tell_columns(reader: CloudsReader, sequences: Sequence[int], info: ModelInfo, model: str | Path) -> None:
    """Warns where the columns that a network reads lack most of their values, or spread much more or less than in its training."""
    some = list(sequences)[:: -(-len(sequences) // _VIDEOS) or 1]
    for name in info.config.columns:
        field = kept_name(name)
        values = np.concatenate([reader.read(i, fields=(field,)).extra[field] for i in some])
        tell_values(str(reader.path), name, values, info, model)


def tell_values(
    what: str, name: str, values: np.ndarray, info: ModelInfo, model: str | Path, resting: bool = False
) -> None:
    """Warns where the values (N) of a column lack, or spread unlike those that a network learned from. resting: they are of so
    short a time that nobody may have moved."""
    known = values[np.isfinite(values)]
    if not len(values):
        return
    if len(known) <= _MISSING * len(values):
        log.warn(
            f"{what}: {len(values) - len(known)} of {counted(len(values), 'value')} of column {name} are missing, which {model}"
            f" reads of every point and takes for average{_EXPECT}"
        )
        return
    spread = info.config.scales[2 + 2 * info.config.columns.index(name)]
    low, high = np.quantile(known, [0.1, 0.9])
    own = float(high - low) / 2
    if own >= spread * _OTHER_UNIT or (own <= spread / _RESTING and not resting):
        log.warn(
            f"{what}: four fifths of column {name} lie within {2 * own:.3g}, within {2 * spread:.3g} in what {model} learned from: is"
            " its unit another one, or was nothing measured? The scores would be meaningless; bring the raw column into the unit of"
            " the training, and prepare it again"
        )


def tell_unlike_file(reader: CloudsReader, sequences: Sequence[int], info: ModelInfo, model: str | Path) -> None:
    """Warns where videos of a file are unlike what a model learned from: in size and density, columns, or frame rate."""
    tell_unlike(str(reader.path), file_like(reader, sequences), info, model)
    if info.config.normalize not in ANY_UNIT:
        tell_mixed_sizes(reader, sequences)
    tell_columns(reader, sequences, info, model)
    tell_rate(reader, sequences, info, model)


def tell_unlike(what: str, theirs: dict[str, float], info: ModelInfo, model: str | Path) -> None:
    """Warns where videos are much larger, smaller, denser or sparser than those that a model learned from.

    what: the file or stream. theirs: `like` of it. model: its name or file.
    """
    tell_rounded(what, theirs)
    own = _own(info, model)
    size, far = own.get("extent"), theirs.get("extent")
    in_units = info.config.normalize not in ANY_UNIT
    if size and far is not None and in_units and not size / _OTHER_UNIT < far < size * _OTHER_UNIT:
        log.warn(
            f"{what}: half of the points lie within {far:.3g} of the middle, within {size:.3g} in what {model} learned from:"
            " is the unit of length another one, or is the background still there? The scores would be meaningless; prepare the raw"
            " data again, clouds with --scale, depth videos with --depth-scale or --background"
        )
    if far is None:
        return
    forward, ahead = _ahead(own), _ahead(theirs)
    if forward and ahead and forward != ahead:
        log.warn(
            f"{what}: what is seen lies along {ahead} from the origin, what {model} learned from along {forward}: has the sensor other"
            " axes? Then expect fewer right; exchange the axes in the raw data to those of its training"
        )
        return
    up, longest = _longest_axis(own), _longest_axis(theirs)
    if up and longest and up != longest:
        log.warn(
            f"{what}: what is seen is longest along {longest}, what {model} learned from along {up}: is another axis the"
            " upright one? Then the scores would be meaningless; exchange the axes in the raw data to those of its training"
        )
    if info.timing == "slots" and "points" in own:
        many, count = theirs["points"], own["points"]
        if not count / _OTHER_SENSOR < many < count * _OTHER_SENSOR:
            log.warn(
                f"{what}: a frame has {many:g} points in the median, {count:g} in what {model} learned from{_EXPECT}"
            )
    elif (
        info.timing != "slots"
        and theirs["points"] * _REPEATED < info.config.points_per_frame
        and theirs["points"] * _FEWER < own.get("points", np.inf)
    ):
        drawn = info.config.points_per_frame
        log.warn(
            f"{what}: a frame has {theirs['points']:g} points in the median, {model} takes {drawn}: repeated{_EXPECT}"
        )
