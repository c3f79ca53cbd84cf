"""Pairs the views of a prediction with those of the truth that show the same: by camera, or by name."""

from __future__ import annotations

import numpy as np

from dpcli.counted import counted
from dpcli.errors import DataError
from dpcli.evaluate.results import LeftOut, left_out, list_names
from dpcli.evaluate.video.protocol import VideoProtocol
from dpcli.evaluate.video.sources.source import Source
from dpcli.evaluate.video.sources.stored import SceneSource

_SAME_CAMERA = 1e-4  # relative: cameras that went through float32 still are the same


def match_views(
    predicted: Source, truth: Source, protocol: VideoProtocol, intersect: bool
) -> tuple[list[tuple[int, int]], list[LeftOut]]:
    """Returns (view of the prediction, view of the truth) of what is compared, in the truth's order, and views that aren't.

    The protocol says which views of the truth. Raises DataError when one lacks a partner and `intersect` is off, or none has.
    """
    compared = [i for i, view in enumerate(truth.views) if protocol.views in ("all", view.role)]
    if not compared and protocol.views == "test" or len(truth.views) == 1:
        compared = list(range(len(truth.views)))
    if not compared:
        raise DataError(f"{truth.path}: no {protocol.views} view, which protocol {protocol.name} compares")
    partners = {i: _partner_view(predicted, truth, i) for i in compared}
    not_predicted = [truth.views[i].title for i in compared if partners[i] is None]
    used = {_partner_view(predicted, truth, i) for i in range(len(truth.views))}
    unknown = [view.title for i, view in enumerate(predicted.views) if i not in used]
    by_camera = predicted.header is not None and truth.header is not None
    if by_camera and len(not_predicted) == len(compared) and not intersect:
        raise DataError(
            f"{predicted.path}: no camera of its {counted(len(predicted.views), 'view')} stands, looks and sees as one of"
            f" {truth.path}, by which views are matched; is the world moved, or in another unit?"
        )
    if not_predicted and not intersect:
        raise DataError(
            f"{predicted.path}: has no view {list_names(not_predicted)} of {truth.path}; its views are "
            f"{list_names([v.title for v in predicted.views])}; --intersect compares what both have"
        )
    if unknown and not intersect and protocol.views == "all":
        raise DataError(
            f"{truth.path}: has no view {list_names(unknown)}, which {predicted.path} has; --intersect compares what both have"
        )
    pairs = [(partners[i], i) for i in compared if partners[i] is not None]
    if not pairs:
        raise DataError(
            f"{predicted.path} and {truth.path} have no view in common; the truth's are "
            f"{list_names([view.title for view in truth.views])}"
        )
    if not intersect:
        _check_cameras(predicted, truth, pairs)
    return pairs, left_out({"views not predicted": not_predicted, "views the truth doesn't have": unknown})


def _partner_view(predicted: Source, truth: Source, index: int) -> int | None:
    """Returns the prediction's view that shows the same as the truth's `index`: by camera between views files, else by name."""
    if len(predicted.views) == len(truth.views) == 1:
        return 0
    if predicted.header is not None and truth.header is not None:
        if index < len(predicted.views) and _same_camera(predicted, truth, index, index):
            return index
        same = [i for i in range(len(predicted.views)) if _same_camera(predicted, truth, i, index)]
        return same[0] if same else None
    names = [name.lower() for name in truth.views[index].names]  # its own name counts before the others
    others = [{name.lower() for name in view.names} for view in predicted.views]
    return next((i for name in names for i, own in enumerate(others) if name in own), None)


def _same_camera(predicted: Source, truth: Source, ours: int, theirs: int) -> bool:
    pose = np.abs(predicted.header.world_to_camera[ours] - truth.header.world_to_camera[theirs]).max()
    scale = np.diag([1 / predicted.header.size[0], 1 / predicted.header.size[1], 1])  # the same camera at another size
    other = np.diag([1 / truth.header.size[0], 1 / truth.header.size[1], 1])
    lens = np.abs(scale @ predicted.header.intrinsics[ours] - other @ truth.header.intrinsics[theirs]).max()
    reach = max(1.0, np.abs(truth.header.world_to_camera[theirs]).max())
    return bool(pose <= _SAME_CAMERA * reach and lens <= _SAME_CAMERA)


def _check_cameras(predicted: Source, truth: Source, pairs: list[tuple[int, int]]) -> None:
    """Raises DataError for a lone view of another camera; whatever it is called, it is compared."""
    if predicted.header is None or truth.header is None or isinstance(predicted, SceneSource):
        return
    for ours, theirs in pairs:
        if not _same_camera(predicted, truth, ours, theirs):
            raise DataError(
                f"{predicted.path}: view {predicted.views[ours].title!r} has another camera than view "
                f"{truth.views[theirs].title!r} of {truth.path}; the first that differs"
            )
