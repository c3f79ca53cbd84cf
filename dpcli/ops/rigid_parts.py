"""Rigid parts of points that are followed through all frames: patches are joined as long as their union moves rigidly."""

from __future__ import annotations

import heapq
import warnings
from dataclasses import dataclass

import numpy as np

_OF_PATCH = 3  # points, in the mean, from which on patches tell themselves how far they bend
_GROUP, _STIFF = 5, 0.25  # points beside one another that tell it else; which quantile of the groups does
_FEWEST = 6  # points that can be two parts
_FRAMES = 32  # of a long clip, evenly spaced
_NEIGHBORS = 8  # points whose patches touch
_TRAVEL = 3.0  # weight of motion beside position where patches and neighbors are chosen
_COMPACT = 0.002  # weight of a part's extent beside its residuals; chosen with _PRICE on clips of known parts
_SAME = 0.2  # share of the price that the residuals of two parts may grow by where their extent doesn't count
_MOVES = 1e-4  # squared diameters per point that one rigid motion leaves where a clip moves enough for _COMPACT
_PRICE = 5e-6  # squared diameters per point that joining two parts may cost, where they bend
_LEAST, _OF_BEND = 2e-7, 30.0  # the price where nothing bends; the price in squared bends of patches, between the two


@dataclass
class _Sums:
    """Holds weighted sums over the points of B patches, from which the residuals of any union follow; each can be added."""

    count: np.ndarray  # [B, T]
    start: np.ndarray  # [B, T, 3]
    start_squared: np.ndarray  # [B, T]
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
        extent = self.start_squared - np.square(self.start).sum(-1) / self.count
        spread = self.moved_squared - np.square(self.moved).sum(-1) / self.count
        covariance = self.product - self.moved[..., None] * self.start[..., None, :] / self.count[..., None, None]
        values = np.linalg.svd(covariance, compute_uv=False)
        values[..., 2] *= np.where(np.linalg.det(covariance) < 0, -1, 1)  # Kabsch: a mirror image is no motion
        residual = extent + spread - 2 * values.sum(-1)
        return residual.clip(0).mean(1) + compact * extent[:, 0]


def find_parts(
    frames: np.ndarray,
    trusted: np.ndarray,
    most: int,
    *,
    patches: int = 150,
    softness: float = 1.0,
    weights: np.ndarray | None = None,
) -> np.ndarray:
    """Returns the part i64 (N) of points whose places are f (T,N,3), found on the trusted ones (mask (N), any) alone.

    Points in one part move almost rigidly over the whole clip and lie together. Their number follows from what a further
    part explains, up to `most`; the first is the largest. Other points go with the trusted one that stays nearest.
    patches: how many are joined, at most, single points where there are no more; smaller parts than one are lost. softness:
    how far parts may bend, 1 as animals' skin does; of things that hardly bend within patches, smaller motions tell parts
    apart. weights: f (T,N) above 0, how much a point's place in a frame counts; in the first frame it always does in full.
    """
    from scipy.spatial import cKDTree

    few = np.linspace(0, len(frames) - 1, min(len(frames), _FRAMES)).round().astype(int)
    weights = np.ones(frames.shape[:2]) if weights is None else weights
    frames, weights = frames[few].astype(np.float64), weights[few][:, trusted]
    own = frames[:, trusted]
    diameter = np.linalg.norm(np.ptp(own[0], axis=0))
    if len(own[0]) < _FEWEST or most < 2 or not diameter > 0:
        return np.zeros(frames.shape[1], np.int64)
    own = (own - own.mean(1, keepdims=True)) / diameter
    label = _join(own, weights, _patches(own, patches), most, softness)
    order = np.argsort(-np.bincount(label), kind="stable")
    label = np.argsort(order)[label]
    few = frames[:: max(len(frames) // 8, 1)].transpose(1, 0, 2).reshape(len(trusted), -1)
    return label[cKDTree(few[trusted]).query(few)[1]]


def _join(
    own: np.ndarray,  # [T, M, 3], of diameter 1
    weights: np.ndarray,  # [T, M]
    patch: np.ndarray,  # [M]
    most: int,
    softness: float,
) -> np.ndarray:  # [M]
    """Returns the part of each point: patches joined by motion and extent, then parts that move alike by motion alone."""
    sums, touching = _sums(own, weights, patch), _touching(own, patch)
    most_price = _PRICE * softness**2
    price = float(np.clip(_OF_BEND * _bend(own, weights, sums), min(_LEAST, most_price), most_price))
    # where hardly anything moves or bends, extent would be all that counts
    compact = _COMPACT * price / _PRICE * min(sums.whole().cost(0.0)[0] / len(patch) / _MOVES, 1.0)
    part = _Joining(sums, touching, compact).run(price * len(patch), most)
    # a long body that moves as one has been cut by its extent
    pairs = {(min(part[[a, b]].tolist()), max(part[[a, b]].tolist())) for a, b in touching}
    joining = _Joining(_sums(own, weights, part[patch]), {(a, b) for a, b in pairs if a != b}, 0.0)
    return joining.run(_SAME * price * len(patch), most)[part][patch]


def _bend(own: np.ndarray, weights: np.ndarray, sums: _Sums) -> float:
    """Returns how far patches of these sums bend, or noise moves their points: what rigid motions leave, squared, per number.

    Patches of fewer points than hold a motion can't tell; then the stiffer ones of groups of five points do, a point and
    those that lie and go beside it.
    """
    from scipy.spatial import cKDTree

    if own.shape[1] >= _OF_PATCH * len(sums.count):
        free = 3 * sums.count.mean(1) - 6  # numbers of a patch that its rigid motion leaves
        return float(np.median((sums.cost(0.0) / free.clip(1))[free > 0])) if (free > 0).any() else 0.0
    feature = _feature(own)
    groups = cKDTree(feature).query(feature, _GROUP)[1]
    one = np.zeros(_GROUP, np.int64)
    left = [_sums(own[:, group], weights[:, group], one).cost(0.0)[0] for group in groups]
    return float(np.quantile(left, _STIFF)) / (3 * _GROUP - 6)


def _feature(own: np.ndarray) -> np.ndarray:  # [T, M, 3] -> [M, D]
    """Returns where points are in the first frame and how they travel, by which near ones lie and go together."""
    few = own[:: max(len(own) // 8, 1)]
    return np.concatenate([own[0], *(_TRAVEL / len(few) ** 0.5 * (few - few.mean(0)))], 1)


def _patches(own: np.ndarray, most: int) -> np.ndarray:  # [T, M, 3] -> [M]
    """Returns small patches of points that lie together and go together: k-means from spread places."""
    from scipy.cluster.vq import kmeans2

    from dpcli.ops import fps_numpy

    feature = _feature(own)
    if len(feature) <= most:
        return np.arange(len(feature))
    start = feature[fps_numpy(own[0], most)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a patch that lost all its points isn't missed
        label = kmeans2(feature, start, iter=10, minit="matrix")[1]
    return np.unique(label, return_inverse=True)[1]


def _touching(own: np.ndarray, patch: np.ndarray) -> set[tuple[int, int]]:
    """Returns the pairs of patches of which points are neighbors, in all of some frames together."""
    from scipy.spatial import cKDTree

    place = np.concatenate(list(own[:: max(len(own) // 4, 1)]), 1)
    count = min(_NEIGHBORS, len(patch) - 1)
    near = patch[cKDTree(place).query(place, count + 1)[1][:, 1:]]
    pairs = np.stack([np.repeat(patch, count), near.ravel()], 1)
    return {(int(a), int(b)) for a, b in np.unique(np.sort(pairs, 1), axis=0) if a != b}


def _sums(own: np.ndarray, weights: np.ndarray, patch: np.ndarray) -> _Sums:
    """Returns the sums of each patch over its points; they start where they are in the first frame."""
    rows = []
    for index in range(patch.max() + 1):
        inside = patch == index
        x, y, w = own[0, inside], own[:, inside], weights[:, inside]
        weighted = w[..., None] * y  # [T, M, 3]
        product = np.swapaxes(weighted, 1, 2) @ x
        squares = w @ np.square(x).sum(1), (w * np.square(y).sum(2)).sum(1)
        rows.append((w.sum(1), w @ x, squares[0], weighted.sum(1), squares[1], product))
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
