"""Frames whose points have an identity: parts are patches of tracks that move as one rigid body through all frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dpcli.ops.rigid_parts import find_parts
from dpcli.segment.multibody.settings import MultibodySettings

_PATCHES = 300  # that are joined to parts; the smallest part is one of them
_SOFT = 0.02  # the setting `flexible` at which parts bend as animals' skin does
_FEWEST = 4  # common points that can hold a motion
_AROUND = 8  # tracks that carry one that a frame doesn't show
_GUESSED = 0.02  # weight of a place where no frame shows the track
_ROUNDS, _OWN = 3, 0.7  # in which tracks choose their parts again; share of their own deviation beside their neighbors'
_WIDE, _STIFF = 9.0, 0.1  # squared deviation that counts one half: of the median; of the setting `flexible`, at least


@dataclass(frozen=True)
class Tracks:
    """Holds the places f64 (F,M,3) of M tracks in F frames, where frames show them, bool (F,M), and elsewhere by what lies around.

    index: for each frame, the track of each of its points, i64 (n_t).
    """

    places: np.ndarray
    shown: np.ndarray
    index: list[np.ndarray]

    def motion(self, inside: np.ndarray, t: int, u: int) -> np.ndarray:
        """Returns the rigid motion (3,4) from frame t to frame u of the tracks that the mask (M) names."""
        both = inside & self.shown[t] & self.shown[u]
        chosen = both if both.sum() >= _FEWEST else inside
        return fit_motions(self.places[t, chosen][None], self.places[u, chosen][None])[0]


def follow_tracks(clouds: list[np.ndarray], tracks: list[np.ndarray]) -> Tracks:
    """Returns the tracks of frames f (n_t,3) whose points have the identities i64 (n_t); tracks may begin and end.

    A track that a frame doesn't show goes on as the nearest eight that both frames show, by their rigid motion.
    """
    _, found = np.unique(np.concatenate(tracks), return_inverse=True)
    index = np.split(found.reshape(-1), np.cumsum([len(own) for own in tracks])[:-1])
    count = max(map(int, found)) + 1 if len(found) else 0
    places, shown = np.zeros((len(clouds), count, 3)), np.zeros((len(clouds), count), bool)
    for t, own in enumerate(index):
        places[t, own], shown[t, own] = clouds[t], True
    known = shown.copy()
    steps = [(t - 1, t) for t in range(1, len(clouds))] + [(t + 1, t) for t in reversed(range(len(clouds) - 1))]
    for before, now in steps:
        missing = known[before] & ~known[now]
        places[now, missing] = _carried(places[before], places[now], known[before] & shown[now], missing)
        known[now] |= missing
    return Tracks(places, shown, index)


def _carried(before: np.ndarray, now: np.ndarray, both: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """Returns where the missing tracks (mask (M)) are now, as the nearest of those that are known in both frames went."""
    from scipy.spatial import cKDTree

    if not missing.any() or not both.any():
        return before[missing]
    start, end = before[both], now[both]
    near = cKDTree(start).query(before[missing], min(_AROUND, len(start)))[1].reshape(missing.sum(), -1)
    motion = fit_motions(start[near], end[near])
    return np.einsum("mij,mj->mi", motion[:, :, :3], before[missing]) + motion[:, :, 3]


def fit_motions(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Returns the rigid motions (B,3,4) that take source (B,n,3) nearest to target (B,n,3), in the least squares.

    Fewer than four points, which hold no turn surely, are shifted.
    """
    a, b = source.mean(1), target.mean(1)
    rotation = np.tile(np.eye(3), (len(source), 1, 1))
    if source.shape[1] >= _FEWEST:
        left, _, right = np.linalg.svd(np.swapaxes(target - b[:, None], 1, 2) @ (source - a[:, None]))
        left[:, :, 2] *= np.where(np.linalg.det(left @ right) < 0, -1, 1)[:, None]
        rotation = left @ right
    return np.concatenate([rotation, (b - (rotation @ a[..., None])[..., 0])[..., None]], 2)


def parts_of_tracks(tracks: Tracks, settings: MultibodySettings) -> np.ndarray:
    """Returns the part i64 (M) of each track, the largest first: patches that bend little when they move as one.

    They are joined from the frame that shows most tracks; those that it doesn't show follow the ones that go beside them.
    Then each track chooses among the parts around it by how well they explain where it was seen.
    """
    first = int(tracks.shown.sum(1).argmax())
    order = [first, *(t for t in range(len(tracks.places)) if t != first)]
    weights = np.where(tracks.shown[order], 1.0, _GUESSED)
    options = {"patches": _PATCHES, "softness": settings.flexible / _SOFT, "weights": weights}
    part = find_parts(tracks.places[order], tracks.shown[first], settings.most_bodies, **options)
    return _choose_again(tracks, part, first, settings.flexible)


def _choose_again(tracks: Tracks, part: np.ndarray, first: int, flexible: float) -> np.ndarray:
    """Returns the part of each track after three rounds in which it takes the one that explains it and its neighbors best."""
    from scipy.spatial import cKDTree

    place = tracks.places[first]
    near = cKDTree(place).query(place, min(_AROUND + 1, len(place)))[1].reshape(len(place), -1)
    rows = np.arange(len(part))
    for _ in range(_ROUNDS):
        cost = np.stack([_deviation(tracks, part == k, first) for k in range(part.max() + 1)], 1)
        scale = max(_WIDE * np.median(cost[rows, part]), (_STIFF * flexible) ** 2)
        cost = cost / (cost + scale)  # Geman and McClure's
        cost = _OWN * cost + (1 - _OWN) * cost[near].mean(1)
        around = np.zeros(cost.shape, bool)
        np.put_along_axis(around, part[near], True, 1)
        new = np.where(around, cost, np.inf).argmin(1)
        if (new == part).all():
            break
        part = np.unique(new, return_inverse=True)[1]
    order = np.argsort(-np.bincount(part), kind="stable")
    return np.argsort(order)[part]


def _deviation(tracks: Tracks, inside: np.ndarray, first: int) -> np.ndarray:
    """Returns the mean squared distance f64 (M) of all tracks, where they are seen, from how one part moves."""
    motion = np.stack([tracks.motion(inside, first, t) for t in range(len(tracks.places))])
    back = np.einsum("tji,tmj->tmi", motion[:, :, :3], tracks.places - motion[:, None, :, 3])
    weights, seen = tracks.shown[..., None], tracks.shown.sum(0)
    middle = (weights * back).sum(0) / seen[:, None]
    return (tracks.shown * ((back - middle) ** 2).sum(-1)).sum(0) / seen
