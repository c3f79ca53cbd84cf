"""Tells which true joints move visibly; type and axis of the others can't be seen."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from dpcli.errors import DataError
from dpcli.evaluate.segmentation.rigid_motion import true_motion
from dpcli.store import CloudSequence

VISIBLE = 2.0  # times the sampling distance
_FEWEST = 5  # points that a child needs in a frame
_FRAMES = 12  # of a sequence that are looked at


def joint_visibility(truth: CloudSequence, pose: np.ndarray, child: int, parent: int) -> float:
    """Returns how far a joint's motion takes the child, in sampling distances; below about 1.15 it can't be told from none.

    The child's points of one frame, carried to another by the parent's motion instead of their own, land farther from that
    frame's points: mean nearest distance of the one over that of the other, the largest over all pairs of (up to 12) frames.
    pose (T,parts,4,4): part to world. Raises DataError for poses that are no motions.
    """
    if max(child, parent) >= pose.shape[1]:
        raise DataError(f"{truth.name!r}: part {max(child, parent)}, but there are poses of {pose.shape[1]} parts")
    count = truth.num_frames
    chosen = np.unique(np.linspace(0, count - 1, min(count, _FRAMES)).astype(int)).tolist()
    trees = {frame: cKDTree(truth.frame(frame)) for frame in chosen}
    parts = np.split(truth.part, truth.frame_offsets[1:-1])
    largest = 0.0
    for source in chosen:
        own = truth.frame(source)[parts[source] == child].astype(np.float64)
        for target in chosen if len(own) >= _FEWEST else ():
            if source == target or not trees[target].n:
                continue
            motion = true_motion(pose[:, [child, parent]].astype(np.float64), source, target)
            near, far = (trees[target].query(own @ m[:3, :3].T + m[:3, 3])[0].mean() for m in motion)
            largest = max(largest, float(far / max(near, 1e-9)))
    return largest
