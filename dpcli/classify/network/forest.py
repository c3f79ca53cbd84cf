"""A forest of decision trees as tensors, which travels with a network's weights; scikit-learn grows it, torch asks it."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

_DEEPEST = 64  # levels: a forest that scikit-learn grew ends long before, a damaged one must end, too


class Forest(nn.Module):
    """Holds `trees` of at most `nodes` nodes each; without any it says nothing.

    Buffers (trees,nodes): the feature that a node asks for (below 0: a leaf), the largest value that goes left, the number
    of the left and of the right child, and the class of a leaf.
    """

    def __init__(self, trees: int, nodes: int, classes: int) -> None:
        super().__init__()
        self.classes = classes
        for name in ("feature", "left", "right", "label"):
            self.register_buffer(name, torch.full((trees, nodes), -1, dtype=torch.int32))
        self.register_buffer("largest", torch.zeros(trees, nodes))

    @classmethod
    def grown(cls, forest: Any, nodes: int, classes: int) -> Forest:
        """Returns a fitted forest of scikit-learn; nodes: allocated for each tree, at least the most that one of them has."""
        made = cls(len(forest.estimators_), nodes, classes)
        for number, one in enumerate(forest.estimators_):
            tree, count = one.tree_, one.tree_.node_count
            names = forest.classes_[tree.value[:, 0].argmax(1)]
            for buffer, values in (
                (made.feature, np.where(tree.children_left < 0, -1, tree.feature)),
                (made.left, tree.children_left),
                (made.right, tree.children_right),
                (made.label, names),
                (made.largest, _float32_below(tree.threshold)),
            ):
                buffer[number, :count] = torch.from_numpy(np.asarray(values)).to(buffer.dtype)
        return made

    def forward(self, descriptors: Tensor) -> Tensor:
        """Returns the share of the trees that vote for each class, f32 (B,C), each class with one vote more: none is ruled
        out. descriptors f32 (B,D)."""
        trees, nodes = self.feature.shape
        at = torch.zeros(trees, len(descriptors), dtype=torch.long, device=descriptors.device)
        for _ in range(_DEEPEST):
            feature = self.feature.gather(1, at).long()
            inner = feature >= 0
            if not inner.any():
                break
            asked = descriptors.T.gather(0, feature.clamp(0, descriptors.shape[1] - 1))
            child = torch.where(asked <= self.largest.gather(1, at), self.left.gather(1, at), self.right.gather(1, at))
            at = torch.where(inner, child.long().clamp(0, nodes - 1), at)
        votes = nn.functional.one_hot(self.label.gather(1, at).long().clamp(0, self.classes - 1), self.classes)
        return (votes.sum(0) + 1) / (trees + self.classes)


def _float32_below(thresholds: np.ndarray) -> np.ndarray:
    """Returns the largest float32 not above each threshold f64: the same float32 descriptors are at most as large as either."""
    rounded = thresholds.astype(np.float32)
    return np.where(rounded > thresholds, np.nextafter(rounded, np.float32(-np.inf)), rounded)
