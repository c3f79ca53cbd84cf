"""Which view of a prediction shows the same as which view of the truth: by camera, or by name."""

from __future__ import annotations

import numpy as np

from dpcli.errors import DataError
from dpcli.evaluate.classification.protocol import LeftOut, listing
from dpcli.evaluate.video.protocol import VideoProtocol
from dpcli.evaluate.video.sources import SceneSource, Source

_SAME_CAMERA = 1e-4  # relative: cameras that went through float32 still are the same


def match_views(
    said: Source, real: Source, protocol: VideoProtocol, intersect: bool, left_out: list[LeftOut]
) -> list[tuple[int, int]]:
    """(view of the prediction, view of the truth) of what is compared, in the truth's order.

    The protocol says which views of the truth; the others of either side go to `left_out`. DataError when one lacks a
    partner and `intersect` is off, or none has.
    """
    wanted = [i for i, view in enumerate(real.views) if protocol.views in ("all", view.role)]
    if not wanted and protocol.views == "test" or len(real.views) == 1:
        wanted = list(range(len(real.views)))
    if not wanted:
        raise DataError(f"{real.path}: no {protocol.views} view, which protocol {protocol.name} compares")
    found = {i: _partner(said, real, i) for i in wanted}
    unsaid = [real.views[i].title for i in wanted if found[i] is None]
    used = {_partner(said, real, i) for i in range(len(real.views))}
    unknown = [view.title for i, view in enumerate(said.views) if i not in used]
    if unsaid and not intersect:
        raise DataError(
            f"{said.path}: has no view {listing(unsaid)} of {real.path}; its views are "
            f"{listing([v.title for v in said.views])}; --intersect compares what both have"
        )
    if unknown and not intersect and protocol.views == "all":
        raise DataError(
            f"{real.path}: has no view {listing(unknown)}, which {said.path} has; --intersect compares what both have"
        )
    left_out += [
        LeftOut(reason, names)
        for reason, names in (("views not predicted", unsaid), ("views the truth doesn't have", unknown))
        if names
    ]
    pairs = [(found[i], i) for i in wanted if found[i] is not None]
    if not pairs:
        raise DataError(
            f"{said.path} and {real.path} have no view in common; the truth's are "
            f"{listing([view.title for view in real.views])}"
        )
    if not intersect:
        _same_cameras(said, real, pairs)
    return pairs


def _partner(said: Source, real: Source, index: int) -> int | None:
    """The prediction's view that shows the same as the truth's `index`: by camera between views files, else by name."""
    if len(said.views) == len(real.views) == 1:
        return 0
    if said.header is not None and real.header is not None:
        if index < len(said.views) and _same_camera(said, real, index, index):
            return index
        same = [i for i in range(len(said.views)) if _same_camera(said, real, i, index)]
        return same[0] if same else None
    names = [name.lower() for name in real.views[index].names]  # its own name counts before the others
    others = [{name.lower() for name in view.names} for view in said.views]
    return next((i for name in names for i, own in enumerate(others) if name in own), None)


def _same_camera(said: Source, real: Source, ours: int, theirs: int) -> bool:
    pose = np.abs(said.header.world_to_camera[ours] - real.header.world_to_camera[theirs]).max()
    scale = np.diag([1 / said.header.size[0], 1 / said.header.size[1], 1])  # the same camera at another size
    other = np.diag([1 / real.header.size[0], 1 / real.header.size[1], 1])
    lens = np.abs(scale @ said.header.intrinsics[ours] - other @ real.header.intrinsics[theirs]).max()
    reach = max(1.0, np.abs(real.header.world_to_camera[theirs]).max())
    return bool(pose <= _SAME_CAMERA * reach and lens <= _SAME_CAMERA)


def _same_cameras(said: Source, real: Source, pairs: list[tuple[int, int]]) -> None:
    """A lone view is compared whatever it is called, but not with another camera's."""
    if said.header is None or real.header is None or isinstance(said, SceneSource):
        return
    for ours, theirs in pairs:
        if not _same_camera(said, real, ours, theirs):
            raise DataError(
                f"{said.path}: view {said.views[ours].title!r} has another camera than view "
                f"{real.views[theirs].title!r} of {real.path}; the first that differs"
            )
