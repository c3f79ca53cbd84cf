"""Up, and the ground: a plane for the direction, a map of heights for what lies on it."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from dpcli.ops.open3d_import import load_open3d

_CELL = 1.0  # meters, of the map of heights
_SLOPE = 0.3  # steepest ground, rise over run
_AROUND = 12  # cells over which the slope limits heights
_LOW = 5  # percentile of heights in a cell taken for the ground: a few points lie below by noise and mirrors
_BELOW = 0.03  # share of the points that may lie below a ground plane
_LEAST = 0.04  # share of the points in a plane worth a look
_PIT = 0.7  # meters: a cell so far below those around it is a mirror
_CELLS = 400  # along a side of the map, at most
_PLANES = 4
_AHEAD = 0.5  # length of the mean viewing direction above which a sensor looks ahead, not around
_TILT = np.cos(np.radians(35))  # a plane this near to an axis of the file, or to that of the beams, may be the ground
_LEANS = np.cos(np.radians(60))  # ground leans no more than this against the axis of the beams; walls stand along it
_LEVEL = np.cos(np.radians(15))  # an axis of the file this near to that of the beams is upright by intention
_ALL_AROUND = 0.6  # share of the second least spread of the beams' directions above which they turn about no axis


def find_up(points: np.ndarray, sensor: np.ndarray | None) -> tuple[np.ndarray, bool]:
    """Returns the unit vector f64 (3) that points up, and whether a ground plane showed it.

    points: f64 (N,3), meters. Planes are found one after the other by RANSAC; the ground is a large one with hardly
    anything below it, across which the sensor looks. Without any, up is the axis about which the beams of a spinning
    sensor turn, or else the file's axis along which a scene extends least.
    """
    open3d = load_open3d()
    open3d.utility.random.seed(0)
    rest = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points)).voxel_down_sample(0.3)
    thin = np.asarray(rest.points)
    extent = np.ptp(np.percentile(thin, (2, 98), axis=0), axis=0)
    best, up = 0.0, np.eye(3)[extent.argmin()] if len(points) > 2 else np.eye(3)[2]
    sight = np.zeros(3) if sensor is None else _directions(thin, sensor).mean(0)  # short when it looks all around
    axis = _axis_of_beams(points, sensor)
    if axis is not None:
        nearest = np.eye(3)[np.abs(axis).argmax()]
        up = nearest if nearest @ axis >= _LEVEL else axis
    for _ in range(_PLANES):
        if len(rest.points) < max(50, _LEAST * len(thin)):
            break
        # probability 1: all 300 draws, as stopping early depends on which thread was first
        plane, inside = rest.segment_plane(0.15, 3, 300, probability=1.0)
        score, normal = _judge_plane(np.array(plane), len(inside) / len(thin), thin, sight, axis)
        flatness = np.abs(normal) @ (extent.max() / np.maximum(extent, 1.0))  # normals along the thin side of a scene
        if score * flatness > best:
            best, up = score * flatness, normal
        rest = rest.select_by_index(inside, invert=True)
    return up, best > 0


def _directions(points: np.ndarray, sensor: np.ndarray) -> np.ndarray:
    """Returns the unit vectors f64 (N,3) from the sensor (3) to points (N,3)."""
    way = points - sensor
    return way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)


def _axis_of_beams(points: np.ndarray, sensor: np.ndarray | None) -> np.ndarray | None:
    """Returns the axis f64 (3) about which the beams turn that ended at points (N,3), its largest component positive.

    None where the sensor is unknown, looks ahead, or looks into all directions alike. Beams rise and fall less than they
    turn, however near a wall is.
    """
    if sensor is None or len(points) < 3:
        return None
    way = _directions(points, sensor)
    if np.linalg.norm(way.mean(0)) > _AHEAD:
        return None
    spread, axes = np.linalg.eigh(way.T @ way)
    axis = axes[:, 0] * np.sign(axes[np.abs(axes[:, 0]).argmax(), 0])
    return axis if spread[0] < _ALL_AROUND * spread[1] else None


def _judge_plane(
    plane: np.ndarray, share: float, points: np.ndarray, sight: np.ndarray, axis: np.ndarray | None
) -> tuple[float, np.ndarray]:
    """Returns the share of points in a plane (4), 0 where it can't be ground, and its normal f64 (3) toward most points."""
    normal, offset = plane[:3] / np.linalg.norm(plane[:3]), plane[3] / np.linalg.norm(plane[:3])
    height = points @ normal + offset
    if (height > 0.15).sum() < (height < -0.15).sum():
        normal, height = -normal, -height
    below = (height < -0.6).mean()
    facing = np.linalg.norm(sight) > _AHEAD and abs(sight @ normal) > 0.75 * np.linalg.norm(sight)
    leans = 1.0 if axis is None else abs(normal @ axis)
    near = leans >= _LEANS and max(np.abs(normal).max(), 0.0 if axis is None else leans) >= _TILT
    possible = share >= _LEAST and below <= _BELOW and near and not facing
    return (share if possible else 0.0), normal


def level(up: np.ndarray) -> np.ndarray:
    """Returns the smallest rotation f64 (3,3) that takes `up` to the z axis."""
    cosine = up[2]
    if cosine < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    x, y = up[0], up[1]
    cross = np.array([[0, 0, -x], [0, 0, -y], [x, y, 0]])
    return np.eye(3) + cross + cross @ cross / (1 + cosine)


def height_above_ground(points: np.ndarray) -> np.ndarray:
    """Returns the height f64 (N), meters, of each point f64 (N,3), z up, above the ground below it.

    The ground of a cell is its low percentile of z, but nowhere higher than ground of the usual slope would rise from
    the cells around; cells that lie below all their neighbors by far are taken for mirrors and filled.
    """
    if len(points) == 0:
        return np.zeros(0)
    low, high = np.percentile(points[:, :2], (0.5, 99.5), axis=0) + np.array([[-_CELL], [_CELL]])
    size = np.minimum(np.ceil((high - low) / _CELL).astype(int) + 1, _CELLS)
    cell = np.clip(((points[:, :2] - low) / _CELL).astype(int), 0, size - 1)
    flat = cell[:, 0] * size[1] + cell[:, 1]
    ground = _limit_slope(_low_heights(flat, points[:, 2], size))
    return points[:, 2] - ground[cell[:, 0], cell[:, 1]]


def _low_heights(flat: np.ndarray, z: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Returns the low percentile of z in each cell f64 (size), infinite where there are no points."""
    order = np.lexsort((z, flat))
    cells, start, count = np.unique(flat[order], return_index=True, return_counts=True)
    heights = np.full(size[0] * size[1], np.inf)
    heights[cells] = z[order][start + count * _LOW // 100]
    return heights.reshape(size)


def _limit_slope(heights: np.ndarray) -> np.ndarray:
    """Returns the highest ground f64 (X,Y) below the heights that rises no more than `_SLOPE`."""
    # unknown cells are infinite: the lowest ones count
    around = ndimage.percentile_filter(heights, 20, 5, mode="nearest")
    heights = np.where(np.isfinite(around) & (heights < around - _PIT), around, heights)
    step = np.hypot(*np.mgrid[-_AROUND : _AROUND + 1, -_AROUND : _AROUND + 1]) * _CELL * _SLOPE
    return ndimage.grey_erosion(heights, structure=-step, mode="constant", cval=np.inf)
