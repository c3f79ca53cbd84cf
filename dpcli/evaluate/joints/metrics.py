"""Errors of the joints of one sequence, as PARIS (Liu et al. 2023) and DigitalTwinArt (Weng et al. 2024) define them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from dpcli.evaluate.segmentation.part_matching import IOU_THRESHOLD, hungarian_matching
from dpcli.evaluate.segmentation.part_overlap import overlap
from dpcli.store.joints import AXIS, PARENT, POINT, PRISMATIC, REVOLUTE, TYPE, VALUE

_NEAR = 5.0  # degrees


@dataclass
class JointStatistics:
    """Holds sums over the true joints of one or more sequences.

    joints: true joints of parts that are seen; edges: those whose two parts a predicted joint connects, of `predicted`
    predicted ones; types: those of the right type, too; axes: true hinges and slides; near: those whose predicted axis is of
    the right type and within 5 degrees. visible, visible_types, visible_axes, visible_near: the same of the joints that
    move visibly. angles (degrees), distances (hinges, length_unit), turns (degrees) and slides (length_unit): errors of the
    joints of the right type.
    """

    joints: int = 0
    predicted: int = 0
    edges: int = 0
    types: int = 0
    axes: int = 0
    near: int = 0
    visible: int = 0
    visible_types: int = 0
    visible_axes: int = 0
    visible_near: int = 0
    angles: list[float] = field(default_factory=list)
    distances: list[float] = field(default_factory=list)
    turns: list[float] = field(default_factory=list)
    slides: list[float] = field(default_factory=list)

    def __add__(self, other: JointStatistics) -> JointStatistics:
        """Returns the sums of both."""
        return JointStatistics(*(getattr(self, key) + getattr(other, key) for key in self.__dataclass_fields__))


def joint_statistics(
    true_part: np.ndarray,
    true_joint: np.ndarray,
    part: np.ndarray,
    joint: np.ndarray,
    moves_visibly: Callable[[int, int], bool] = lambda child, parent: False,
) -> JointStatistics:
    """Returns the errors of a sequence's predicted joints f64 (T,K,9), of parts i (P), beside the true ones f64 (T,G,9).

    Predicted parts are matched to true ones over all frames by IoU, one to one, at 0.5 or more. An edge counts in either
    direction: which of two parts holds the other can't be seen. moves_visibly: of a true child and its parent.
    """
    name = _true_names(true_part, part)
    seen = set(np.unique(true_part[true_part >= 0]).tolist())
    true_edges = _edges(true_joint, {k: k for k in seen})
    edges = _edges(joint, name)
    present = set(np.unique(part[part >= 0]).tolist())
    predicted = sum(joint[0, k, PARENT] >= 0 for k in present)
    found = JointStatistics(joints=len(true_edges), predicted=int(predicted))
    for edge, child in true_edges.items():
        truth = true_joint[:, child]
        moves = int(truth[0, TYPE]) in (REVOLUTE, PRISMATIC)
        types, near = found.types, found.near
        found.axes += moves
        if edge in edges:
            found.edges += 1
            guess = joint[:, edges[edge]]
            found.types += int(truth[0, TYPE] == guess[0, TYPE])
            if moves and found.types > types:
                _compare(truth, guess, name[edges[edge]] == child, found)
        if moves_visibly(child, int(truth[0, PARENT])):
            found.visible += 1
            found.visible_axes += moves
            found.visible_types += found.types - types
            found.visible_near += found.near - near
    return found


def _true_names(true_part: np.ndarray, part: np.ndarray) -> dict[int, int]:
    """Returns the true id of each predicted id that has a partner."""
    shared = overlap(true_part, part)
    iou = shared.shared / shared.union
    rows, columns = hungarian_matching(np.where(iou >= IOU_THRESHOLD, iou, 0.0))
    return {
        int(shared.ids[column]): int(shared.truth_ids[row])
        for row, column in zip(rows, columns, strict=True)
        if iou[row, column] >= IOU_THRESHOLD
    }


def _edges(joint: np.ndarray, name: dict[int, int]) -> dict[frozenset[int], int]:
    """Returns the child, in the joints' own numbers, of each edge between two parts that have a (true) name."""
    edges = {}
    for child, row in enumerate(joint[0]):
        parent = int(row[PARENT])
        if parent >= 0 and parent in name and child in name:
            edges[frozenset((name[parent], name[child]))] = child
    return edges


def _compare(truth: np.ndarray, guess: np.ndarray, same_child: bool, found: JointStatistics) -> None:
    """Adds the errors of one joint of the right type: axis and place in frame 0, value in all frames after frame 0.

    Values count from frame 0, where both are 0 by definition, so that frame says nothing of the error.
    """
    first, second = truth[0, AXIS], guess[0, AXIS]
    cosine = float(np.clip(first @ second, -1, 1))
    angle = float(np.degrees(np.arccos(abs(cosine))))
    found.angles.append(angle)
    found.near += angle <= _NEAR
    sign = (1 if cosine >= 0 else -1) * (1 if same_child else -1)
    apart = truth[1:, VALUE] - truth[0, VALUE] - sign * (guess[1:, VALUE] - guess[0, VALUE])
    turns = truth[0, TYPE] == REVOLUTE
    if turns:
        found.distances.append(line_distance(truth[0, POINT], first, guess[0, POINT], second))
    if len(apart):
        errors = np.degrees(np.abs((apart + np.pi) % (2 * np.pi) - np.pi)) if turns else np.abs(apart)
        (found.turns if turns else found.slides).append(float(errors.mean()))


def line_distance(first: np.ndarray, direction: np.ndarray, second: np.ndarray, other: np.ndarray) -> float:
    """Returns the least distance between two lines in space, each given by a point (3) and a unit direction (3).

    >>> up, along = np.array([0.0, 0, 1]), np.array([1.0, 0, 0])
    >>> line_distance(np.zeros(3), up, np.array([5.0, 2, 7]), along)
    2.0
    """
    normal = np.cross(direction, other)
    length = float(np.linalg.norm(normal))
    if length < 1e-6:  # parallel
        return float(np.linalg.norm(np.cross(second - first, direction)))
    return float(abs((second - first) @ normal) / length)
