"""Rigid parts found on the whole motion of a fitted scene: patches are joined as long as their union moves rigidly.

The partition network of the fit sees two frames a step and has one number of parts. Here all frames speak at once, and
only Gaussians that a camera sees: what hides behind them moves as the network happens to continue.
"""

from __future__ import annotations

import heapq
import warnings
from dataclasses import dataclass

import numpy as np

_PATCHES = 150  # small enough to lie within one part each
_FRAMES = 32  # of a long clip, evenly spaced
_NEIGHBORS = 8  # Gaussians whose patches touch
_TRAVEL = 3.0  # weight of motion beside position where patches and neighbors are chosen
_COMPACT = 0.002  # weight of a part's extent beside its residuals; chosen with _PRICE on clips of known parts
_SAME = 1e-6  # what the residuals of two parts may grow by where their extent doesn't count
_MOVES = 1e-4  # squared diameters per Gaussian that one rigid motion leaves where a clip moves enough for _COMPACT
_PRICE = 5e-6  # squared diameters per Gaussian that joining two parts may cost
_SEEN, _ENOUGH = 0.3, 0.15  # share of the frames that shows a Gaussian; share of such Gaussians that speaks for all
_CELLS, _BEHIND = 96, 0.02  # of the depth buffer along a side; depth in diameters within which a surface is seen


@dataclass
class _Sums:
    """Holds sums over the Gaussians of B patches, from which the residuals of any union follow; each can be added."""

    count: np.ndarray  # [B]
    start: np.ndarray  # [B, 3]
    start_squared: np.ndarray  # [B]
    moved: np.ndarray  # [B, T, 3]
    moved_squared: np.ndarray  # [B, T]
    product: np.ndarray  # [B, T, 3, 3]

    def pick(self, index: list[int]) -> _Sums:
        """Returns the sums of some patches, in this order."""
        return _Sums(*(value[index] for value in vars(self).values()))

    def plus(self, other: _Sums) -> _Sums:
        """Returns the sums of the unions, patch by patch."""
        return _Sums(*(a + b for a, b in zip(vars(self).values(), vars(other).values())))

    def whole(self) -> _Sums:
        """Returns the sums of the union of all."""
        return _Sums(*(value.sum(0, keepdims=True) for value in vars(self).values()))

    def put(self, place: int, own: _Sums) -> None:
        """Replaces one patch."""
        for value, new in zip(vars(self).values(), vars(own).values()):
            value[place] = new[0]

    def cost(self, compact: float) -> np.ndarray:  # [B]
        """Returns what the best rigid motions leave of each patch, a mean over frames, plus `compact` times its extent."""
        count = self.count[:, None]
        extent = self.start_squared - np.square(self.start).sum(-1) / self.count
        spread = self.moved_squared - np.square(self.moved).sum(-1) / count
        covariance = self.product - self.moved[..., None] * self.start[:, None, None] / count[..., None, None]
        values = np.linalg.svd(covariance, compute_uv=False)
        values[..., 2] *= np.where(np.linalg.det(covariance) < 0, -1, 1)  # Kabsch: a mirror image is no motion
        residual = extent[:, None] + spread - 2 * values.sum(-1)
        return residual.clip(0).mean(1) + compact * extent


def find_parts(frames: np.ndarray, trusted: np.ndarray, most: int) -> np.ndarray:
    """Returns the part i64 (N) of points whose places are f (T,N,3), found on the trusted ones (mask (N), any) alone.

    Points in one part move almost rigidly over the whole clip and lie together. Their number follows from what a further
    part explains, up to `most`; the first is the largest. Other points go with the trusted one that stays nearest.
    """
    from scipy.spatial import cKDTree

    frames = frames[np.linspace(0, len(frames) - 1, min(len(frames), _FRAMES)).round().astype(int)].astype(np.float64)
    own = frames[:, trusted]
    diameter = np.linalg.norm(np.ptp(own[0], axis=0))
    if len(own[0]) < 2 * _NEIGHBORS or most < 2 or not diameter > 0:
        return np.zeros(frames.shape[1], np.int64)
    own = (own - own.mean(1, keepdims=True)) / diameter
    label = _trusted_parts(own, most)
    order = np.argsort(-np.bincount(label), kind="stable")
    label = np.argsort(order)[label]
    few = frames[:: max(len(frames) // 8, 1)].transpose(1, 0, 2).reshape(len(trusted), -1)
    return label[cKDTree(few[trusted]).query(few)[1]]


def _trusted_parts(own: np.ndarray, most: int) -> np.ndarray:  # [T, M, 3] diameter 1 -> [M]
    """Returns the part of each point: patches joined by motion and extent, then parts that move alike by motion alone."""
    patch = _patches(own)
    sums, touching = _sums(own, patch), _touching(own, patch)
    # where hardly anything moves, extent would be all that counts
    compact = _COMPACT * min(sums.whole().cost(0.0)[0] / len(patch) / _MOVES, 1.0)
    part = _Joining(sums, touching, compact).run(_PRICE * len(patch), most)
    # a long body that moves as one has been cut by its extent
    pairs = {(min(part[[a, b]].tolist()), max(part[[a, b]].tolist())) for a, b in touching}
    joining = _Joining(_sums(own, part[patch]), {(a, b) for a, b in pairs if a != b}, 0.0)
    return joining.run(_SAME * len(patch), most)[part][patch]


def _patches(own: np.ndarray) -> np.ndarray:  # [T, M, 3] -> [M]
    """Returns small patches of points that lie together and go together: k-means from spread places."""
    from scipy.cluster.vq import kmeans2

    from dpcli.ops import fps_numpy

    few = own[:: max(len(own) // 8, 1)]
    travel = few - few.mean(0)
    feature = np.concatenate([own[0], *(_TRAVEL / len(few) ** 0.5 * travel)], 1)
    start = feature[fps_numpy(own[0], min(_PATCHES, len(feature) // _NEIGHBORS))]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a patch that lost all its points isn't missed
        label = kmeans2(feature, start, iter=10, minit="matrix")[1]
    return np.unique(label, return_inverse=True)[1]


def _touching(own: np.ndarray, patch: np.ndarray) -> set[tuple[int, int]]:
    """Returns the pairs of patches of which points are neighbors, in all of some frames together."""
    from scipy.spatial import cKDTree

    place = np.concatenate(list(own[:: max(len(own) // 4, 1)]), 1)
    near = patch[cKDTree(place).query(place, _NEIGHBORS + 1)[1][:, 1:]]
    pairs = np.stack([np.repeat(patch, _NEIGHBORS), near.ravel()], 1)
    return {(int(a), int(b)) for a, b in np.unique(np.sort(pairs, 1), axis=0) if a != b}


def _sums(own: np.ndarray, patch: np.ndarray) -> _Sums:
    """Returns the sums of each patch over its points; they start where they are in the first frame."""
    start, rows = own[0], []
    for index in range(patch.max() + 1):
        x, y = start[patch == index], own[:, patch == index]
        product = np.swapaxes(y, 1, 2) @ x
        rows.append((len(x), x.sum(0), np.square(x).sum(), y.sum(1), np.square(y).sum((1, 2)), product))
    return _Sums(*(np.array(column, np.float64) for column in zip(*rows)))


class _Joining:
    """Joins patches pair by pair, the two first whose union costs least."""

    def __init__(self, sums: _Sums, touching: set[tuple[int, int]], compact: float) -> None:
        count = len(sums.count)
        self.sums, self.compact = sums, compact
        self.cost, self.version = sums.cost(compact), np.zeros(count, int)
        self.near: dict[int, set[int]] = {index: set() for index in range(count)}
        for a, b in touching:
            self.near[a].add(b)
            self.near[b].add(a)
        self.part = np.arange(count)
        self.offers: list[tuple] = []  # what joining would cost more, the two, and their versions
        self._offer(sorted(touching))

    def run(self, price: float, most: int) -> np.ndarray:
        """Returns the part of each patch, once a further union would cost more than the price and no more than `most` are left."""
        while len(self.near) > 1:
            if not self.offers and len(self.near) > most:
                first, *others = sorted(self.near)  # parts that don't touch
                self.near[first].update(others)
                self._offer([(first, other) for other in others])
            if not self.offers:
                break
            more, a, b, *then = heapq.heappop(self.offers)
            if a not in self.near or b not in self.near or then != [self.version[a], self.version[b]]:
                continue
            if more > price and len(self.near) <= most:
                break
            self._unite(a, b)
        return np.unique(self.part, return_inverse=True)[1]

    def _unite(self, a: int, b: int) -> None:
        """Lets b become one with a."""
        self.sums.put(a, self.sums.pick([a]).plus(self.sums.pick([b])))
        self.cost[a] = self.sums.pick([a]).cost(self.compact)[0]
        self.version[a] += 1
        self.part[self.part == b] = a
        self.near[a] = (self.near[a] | self.near.pop(b)) - {a, b}
        for other in self.near[a]:
            self.near[other] = self.near[other] - {b} | {a}
        self._offer([(a, other) for other in sorted(self.near[a])])

    def _offer(self, pairs: list[tuple[int, int]]) -> None:
        if not pairs:
            return
        first, second = (list(side) for side in zip(*pairs))
        together = self.sums.pick(first).plus(self.sums.pick(second)).cost(self.compact)
        for a, b, both in zip(first, second, together):
            heapq.heappush(self.offers, (both - self.cost[a] - self.cost[b], a, b, self.version[a], self.version[b]))


def trust(
    frames: np.ndarray, solid: np.ndarray, poses: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int]
) -> np.ndarray:
    """Returns which Gaussians may speak for the motion, bool (N): solid ones (mask (N)) that some view often sees.

    frames: f (T,N,3); poses (V,4,4), intrinsics (V,3,3) and the size of pictures are those of the fitted views. Where
    they see too small a share, as from an animal's front, all solid ones do; where nothing is solid, all do.
    """
    solid = solid if solid.any() else np.ones_like(solid)
    shown = np.zeros(frames.shape[1])
    for places in frames:
        shown[solid] += np.any([_front(places[solid], *view, size) for view in zip(poses, intrinsics)], 0)
    often = solid & (shown > _SEEN * len(frames))
    return often if often.sum() >= _ENOUGH * solid.sum() else solid


def _front(points: np.ndarray, pose: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Returns which points (N,3) no other hides from a camera, bool (N), by the nearest depth in each cell and around it."""
    from scipy.ndimage import minimum_filter

    camera = points @ pose[:3, :3].T + pose[:3, 3]
    depth = camera[:, 2].clip(1e-6)
    cell = (camera @ intrinsics.T)[:, :2] / depth[:, None] * (_CELLS / max(size))
    column, row = np.moveaxis(np.clip(cell, 0, _CELLS - 1).astype(int), -1, 0)
    nearest = np.full((_CELLS, _CELLS), np.inf)
    np.minimum.at(nearest, (row, column), depth)
    nearest = minimum_filter(nearest, 3)
    return depth <= nearest[row, column] + _BEHIND * np.linalg.norm(np.ptp(points, axis=0))
