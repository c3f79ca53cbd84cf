"""Frames whose points have an identity: parts are patches of tracks that move as one rigid body through all frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dpcli.ops.rigid_parts import find_parts
from dpcli.segment.multibody.settings import MultibodySettings
from dpcli.segment.rigid_motions import HOLD, fit_motions, move_each

_PATCHES = 300  # that are joined to parts; the smallest part is one of them
_SOFT = 0.02  # the setting `flexible` at which parts bend as animals' skin does
_AROUND = 8  # tracks that carry one that a frame doesn't show
_GUESSED = 0.02  # weight of a place where no frame shows the track
_ROUNDS, _OWN = 3, 0.7  # in which tracks choose their parts again; share of their own deviation beside their neighbors'
_WIDE, _STIFF = 9.0, 0.1  # squared deviation that counts one half: of the median; of the setting `flexible`, at least
_WIDE_PAIR, _STIFF_PAIR = 4.0, 0.05  # the same where two parts may be one
_JUMP, _ARRIVED = 1.5, 0.5  # spacings of tracks that one jumps at least, and within which it is at another's place
_SETTLED = 5.0  # such distances in how far tracks are off in the median, where noise is more than spacing tells
_CANDIDATES = 8  # frames, evenly spaced, whose places are compared with all others
_REFITS, _LOST = 4, 0.2  # fits of one motion, without its outliers; share of a part's tracks that a union may lose


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
        return self.motions(inside, t, [u])[0]

    def motions(
        self, inside: np.ndarray, t: int, frames: slice | list[int] = slice(None), weights: np.ndarray | float = 1.0
    ) -> np.ndarray:
        """Returns the rigid motions (F,3,4) of tracks, mask or index, from frame t to each of some; weights: f (n), of these.

        Tracks that one of both frames doesn't show don't count, unless too few are left to hold a motion.
        """
        places, both = self.places[frames][:, inside], self.shown[frames][:, inside] & self.shown[t, inside]
        weights = np.where(both.sum(1, keepdims=True) >= HOLD, both, 1.0) * weights
        return fit_motions(np.broadcast_to(self.places[t, inside], places.shape), places, weights)


def follow_tracks(clouds: list[np.ndarray], tracks: list[np.ndarray]) -> Tracks:
    """Returns the tracks of frames f (n_t,3) whose points have the identities i64 (n_t); tracks may begin and end.

    A track that a frame doesn't show goes on as the nearest eight that both frames show, by their rigid motion.
    """
    identities, found = np.unique(np.concatenate(tracks), return_inverse=True)
    index = np.split(found.reshape(-1), np.cumsum([len(own) for own in tracks])[:-1])
    places, shown = np.zeros((len(clouds), len(identities), 3)), np.zeros((len(clouds), len(identities)), bool)
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
    return move_each(fit_motions(start[near], end[near]), before[missing])


def undo_exchanges(tracks: Tracks, part: np.ndarray) -> tuple[list[np.ndarray], int]:
    """Returns `index` where tracks that exchanged their identities have them back, and how many points that concerns.

    A track that goes with a part around it in most frames, by the parts i64 (M) that were found with the exchanges, has a
    place in all frames. Two that are each at the other's place in a frame have exchanged their identities there.
    """
    from scipy.spatial import cKDTree

    first = int(tracks.shown.sum(1).argmax())
    place, index, undone = tracks.places[first], [], 0
    spacing = float(np.median(cKDTree(place).query(place, 2)[0][:, -1])) if len(place) > 1 else 0.0
    if not spacing > 0:
        return tracks.index, 0
    home, away = _places_in_parts(tracks, part, first, _JUMP * spacing)
    usual = np.median(np.median(away, 0))
    elsewhere = tracks.shown & (away > max(_JUMP * spacing, _SETTLED * usual))
    elsewhere &= 2 * elsewhere.sum(0) <= tracks.shown.sum(0)
    for t, own in enumerate(tracks.index):
        names, moved = np.arange(len(part)), np.flatnonzero(elsewhere[t])
        if len(moved):
            gaps, taken = cKDTree(tracks.places[t, moved]).query(home[t, moved])
            pairs = (taken[taken] == np.arange(len(moved))) & (np.maximum(gaps, gaps[taken]) < _ARRIVED * spacing)
            names[moved[taken[pairs]]] = moved[pairs]
        index.append(names[own])
        undone += int((index[t] != own).sum())
    return index, undone


def _places_in_parts(tracks: Tracks, part: np.ndarray, first: int, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns where every track would be in all frames if it went with the part around it with which it goes in most, f64 (F,M,3).

    And how far it is from there, f64 (F,M), 0 where a frame doesn't show it. reach: as of `_most_frequent`.
    """
    several = {first, 0, len(tracks.places) // 2, len(tracks.places) - 1}  # in one of them a track may be elsewhere
    near, sizes = part[np.concatenate([_near(tracks, t) for t in sorted(several)], 1)], np.bincount(part)
    home, away, least = tracks.places.copy(), np.zeros(tracks.shown.shape), np.full(len(part), np.inf)
    for k in np.flatnonzero(sizes >= HOLD):
        inside, weights = np.flatnonzero(part == k), np.ones(sizes[k])
        for _ in range(_REFITS):
            motions = tracks.motions(inside, first, weights=weights)
            deviation = _deviation(tracks, motions, inside)
            weights = (1 - _doubt(deviation, max(_WIDE_PAIR * np.median(deviation), 1e-12))) ** 2
        beside = np.flatnonzero((near == k).any(1))
        shown, back = tracks.shown[:, beside], (tracks.places[:, beside] - motions[:, None, :, 3]) @ motions[:, :, :3]
        rest, cost = _most_frequent(back, shown, reach)
        better = cost < least[beside]
        least[beside[better]], rest = cost[better], rest[better]
        away[:, beside[better]] = shown[:, better] * np.linalg.norm(back[:, better] - rest, axis=-1)
        home[:, beside[better]] = np.einsum("fij,nj->fni", motions[:, :, :3], rest) + motions[:, None, :, 3]
    return home, away


def _most_frequent(places: np.ndarray, shown: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns where each of n points is in most frames, f64 (n,3), of its places (F,n,3) in those that show it (F,n).

    And how far it is from there, f64 (n): a mean over frames of distances, none counted as more than `reach`.
    """
    rest, cost = places[0].copy(), np.full(places.shape[1], np.inf)
    for f in np.unique(np.linspace(0, len(places) - 1, min(len(places), _CANDIDATES)).round().astype(int)):
        gaps = np.linalg.norm(places - places[f], axis=-1).clip(max=reach)
        mean = np.where(shown[f], (shown * gaps).sum(0) / shown.sum(0), np.inf)
        better = mean < cost
        cost[better] = mean[better]
        near = shown * (gaps < reach)
        rest[better] = ((near[..., None] * places).sum(0) / near.sum(0).clip(1)[:, None])[better]
    return rest, cost


def parts_of_tracks(tracks: Tracks, settings: MultibodySettings) -> np.ndarray:
    """Returns the part i64 (M) of each track, the largest first: patches that bend little when they move as one.

    They are joined from the frame that shows most tracks; those that it doesn't show follow the ones that go beside them.
    Then each track chooses among the parts around it by how well they explain where it was seen, and parts become one
    where one motion explains nearly all tracks of both.
    """
    first = int(tracks.shown.sum(1).argmax())
    order = [first, *(t for t in range(len(tracks.places)) if t != first)]
    weights = np.where(tracks.shown[order], 1.0, _GUESSED)
    options = {"patches": _PATCHES, "softness": settings.flexible / _SOFT, "weights": weights}
    part = find_parts(tracks.places[order], tracks.shown[first], settings.max_bodies, **options)
    part = _join_again(tracks, _choose_again(tracks, part, first, settings.flexible), first, settings.flexible)
    order = np.argsort(-np.bincount(part), kind="stable")
    return np.argsort(order)[part]


def _choose_again(tracks: Tracks, part: np.ndarray, first: int, flexible: float) -> np.ndarray:
    """Returns the part of each track after three rounds in which it takes the one that explains it and its neighbors best."""
    near = _near(tracks, first)
    rows = np.arange(len(part))
    for _ in range(_ROUNDS):
        cost = np.stack([_deviation(tracks, tracks.motions(part == k, first)) for k in range(part.max() + 1)], 1)
        cost = _doubt(cost, max(_WIDE * np.median(cost[rows, part]), (_STIFF * flexible) ** 2))
        cost = _OWN * cost + (1 - _OWN) * cost[near].mean(1)
        around = np.zeros(cost.shape, bool)
        np.put_along_axis(around, part[near], True, 1)
        new = np.where(around, cost, np.inf).argmin(1)
        if (new == part).all():
            break
        part = np.unique(new, return_inverse=True)[1]
    return part


def _join_again(tracks: Tracks, part: np.ndarray, first: int, flexible: float) -> np.ndarray:
    """Returns the part of each track after neighbors have become one, the two first whose union explains nearly all of both.

    The sums that joined patches count the outliers of a long, bending body in full and cut it; here they count as one each.
    """
    inside = {k: np.flatnonzero(part == k) for k in range(part.max() + 1)}
    own = np.concatenate([_deviation(tracks, tracks.motions(of, first), of) for of in inside.values()])
    scale = max(_WIDE_PAIR * np.median(own), (_STIFF_PAIR * flexible) ** 2)
    lost = {k: _lost(tracks, of, first, scale) for k, of in inside.items()}
    near = part[_near(tracks, first)]
    beside = np.stack([np.broadcast_to(part[:, None], near.shape), near], 2).reshape(-1, 2)
    pairs, offers = {(a, b) for a, b in np.unique(np.sort(beside, 1), axis=0).tolist() if a != b}, {}
    while pairs:
        for a, b in pairs - offers.keys():
            more = _lost(tracks, np.concatenate([inside[a], inside[b]]), first, scale) - lost[a] - lost[b]
            offers[a, b] = more / min(len(inside[a]), len(inside[b]))
        kept, gone = min(offers, key=lambda pair: (offers[pair], pair))
        if offers[kept, gone] > _LOST:
            break
        inside[kept] = np.concatenate([inside[kept], inside.pop(gone)])
        lost[kept] = _lost(tracks, inside[kept], first, scale)
        part[inside[kept]] = kept
        renamed = {tuple(sorted(kept if k == gone else k for k in pair)) for pair in pairs}
        pairs = {pair for pair in renamed if pair[0] != pair[1]}
        offers = {pair: offer for pair, offer in offers.items() if not {kept, gone} & set(pair)}
    return np.unique(part, return_inverse=True)[1]


def _lost(tracks: Tracks, inside: np.ndarray, first: int, scale: float) -> float:
    """Returns how many of the tracks (index (n)) one rigid motion doesn't explain, fitted again without them."""
    weights = np.ones(len(inside))
    for _ in range(_REFITS):
        deviation = _deviation(tracks, tracks.motions(inside, first, weights=weights), inside)
        weights = (1 - _doubt(deviation, scale)) ** 2
    return float(_doubt(deviation, scale).sum())


def _doubt(deviation: np.ndarray, scale: float) -> np.ndarray:
    """Returns from 0 to 1 how little a motion explains tracks of a squared deviation: Geman and McClure's estimator."""
    return deviation / (deviation + scale)


def _near(tracks: Tracks, first: int) -> np.ndarray:
    """Returns for each track itself and the eight nearest, i64 (M,9); fewer where there are few."""
    from scipy.spatial import cKDTree

    place = tracks.places[first]
    return cKDTree(place).query(place, min(_AROUND + 1, len(place)))[1].reshape(len(place), -1)


def _deviation(tracks: Tracks, motions: np.ndarray, inside: np.ndarray | slice = slice(None)) -> np.ndarray:
    """Returns the mean squared distance f64 (n) of tracks, where they are seen, from how motions (F,3,4) would take them."""
    places, shown = tracks.places[:, inside], tracks.shown[:, inside]
    back = (places - motions[:, None, :, 3]) @ motions[:, :, :3]
    seen = shown.sum(0)
    middle = (shown[..., None] * back).sum(0) / seen[:, None]
    return (shown * ((back - middle) ** 2).sum(-1)).sum(0) / seen
