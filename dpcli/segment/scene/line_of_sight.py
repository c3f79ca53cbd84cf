"""Lines of sight: the places that a frame looked through, so that nothing was there."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from dpcli.segment.thinning import thin_evenly

_NEIGHBORS = 6
_SAMPLE = 4000  # points that tell where the sensor stood
_ROWS = 1.2  # distances between rows that beams lie beside a place: the rows below and above it, of which one may see over an edge
_AIMED = 0.1  # distances between rows up to which a single row meets a place
_NO_ROWS = 2.0  # times the distance between rows that even beams have from which on there are no rows
_SAME_ROW = 0.8  # the same for beams of one row


class LineOfSight:
    """Tells which places a sensor looked through. Points are f64 (N,3), z up, in the sensor's frame; `origin` (3) is its eye.

    Directions are compared in units of the distance between beams, along rows and across them; `rows`: how many of the
    latter a beam may be away from a place that it lies beside.
    """

    def __init__(self, points: np.ndarray, origin: np.ndarray, rows: float = _ROWS):
        self._origin = origin
        direction, self._range = self._directions(points)
        self.across, self.along = _beam_spacing(direction)
        self._elevation = direction[:, 1]
        self._scale = np.array([1 / (2 * self.along), 1 / (rows * self.across)])
        self._tree = cKDTree(self._scaled(direction), boxsize=[2 * np.pi * self._scale[0], 0])

    def _directions(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        way = points - self._origin
        flat = np.hypot(way[:, 0], way[:, 1])
        return np.stack([np.arctan2(way[:, 1], way[:, 0]), np.arctan2(way[:, 2], flat)], 1), np.hypot(flat, way[:, 2])

    def _scaled(self, direction: np.ndarray) -> np.ndarray:
        turned = np.stack([np.mod(direction[:, 0], 2 * np.pi), direction[:, 1]], 1) * self._scale
        turned[:, 0] = np.minimum(turned[:, 0], np.nextafter(2 * np.pi * self._scale[0], 0))
        return turned

    def beside(self, places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns the range (M) of places (M,3), those f64 (M,K) of the beams beside them, infinite where none is, and how
        many rows (M,K) these lie above the places.
        """
        direction, reach = self._directions(places)
        index = self._tree.query(self._scaled(direction), k=_NEIGHBORS, distance_upper_bound=1.0)[1]
        above = (np.append(self._elevation, np.nan)[index] - direction[:, 1:]) / self.across
        return reach, np.append(self._range, np.inf)[index], above

    def look(self, places: np.ndarray, margin: np.ndarray) -> np.ndarray:
        """Returns bool (M): whether all beams beside a place (M,3) end more than `margin` (M) behind it, two at least, and
        such that the place isn't above all of them or below: the outermost rows see past what lies outside them.
        """
        reach, ends, above = self.beside(places)
        between = (above > -_AIMED).any(1) & (above < _AIMED).any(1)
        return between & (np.isfinite(ends).sum(1) >= 2) & (ends.min(1) > reach + margin)


def _beam_spacing(direction: np.ndarray) -> tuple[float, float]:
    """Returns the angles between rows of beams and along a row, radians, from the directions (N,2) of a frame's points.

    Both are the distance of as many even beams where there are no rows: the beams of some solid-state lidars follow curves
    that cross one another, along which they are much denser.
    """
    degree = np.radians(1)
    sector = np.floor(direction[:, 0] / (0.5 * degree)).astype(int)
    order = np.lexsort((direction[:, 1], sector))
    gap = np.diff(direction[order, 1])[np.diff(sector[order]) == 0]
    gap = gap[gap > 0.05 * degree]
    across = float(np.clip(np.median(gap) if len(gap) else degree, 0.1 * degree, 2.5 * degree))
    seen = len(np.unique(np.floor(direction / degree), axis=0))  # square degrees
    even = degree * float(np.sqrt(seen / max(len(direction), 1)))
    if even > _NO_ROWS * across:
        return (min(even, 2.5 * degree),) * 2
    cells = np.unique(np.stack([sector, np.floor(direction[:, 1] / across).astype(int)]), axis=1).shape[1]
    along = cells * 0.5 * degree / max(len(direction), 1)
    return across, float(np.clip(along, 0.08 * degree, degree))


def range_jumps(points: np.ndarray, origin: np.ndarray) -> float:
    """Returns the share of neighboring beams that end at ranges a tenth apart and more, were the sensor at `origin` (3).

    It is small at the true place, where only outlines of objects count, and larger elsewhere, whence far and near mix.
    """
    sight = LineOfSight(points, origin, _SAME_ROW)
    reach, ends, _ = sight.beside(thin_evenly(points, _SAMPLE))
    known = np.isfinite(ends)
    jumps = np.abs(np.log(np.where(known, ends, 1) / np.maximum(reach, 1e-9)[:, None])) > 0.1
    return float((jumps & known).sum() / max(known.sum(), 1))
