"""A surface around the points of a part, from all frames."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay, QhullError, cKDTree

from dpcli.segment.thinning import thin_evenly

_MOST = 20_000  # points that a surface is made of
_REACH = 3.5  # of an alpha shape's balls, in distances between neighboring points: wide enough to close, thin enough for holes
_THIN = 0.1  # of that distance: the thickness on each side that points in a plane get


def part_surface(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns vertices f64 (V,3) and triangles i (F,3) of a surface around points f64 (M,3), which face outward.

    The outer boundary of the alpha complex (Edelsbrunner & Mücke 1994); where that has no triangle, the convex hull; where
    the points lie in a line or are fewer than three, a small tetrahedron about their middle, so that every link has a shape.
    """
    points = thin_evenly(points, _MOST)
    middle = points.mean(0)  # far from the origin tetrahedra lose their shape
    points = np.unique(points - middle, axis=0)
    spacing = float(np.median(cKDTree(points).query(points, 2)[0][:, 1])) if len(points) > 1 else 0.0
    corners, grid = _tetrahedra(points, spacing)
    for reach in (_REACH * spacing, np.inf) if grid is not None else ():
        triangles = _outer_boundary(corners, grid, reach)
        if len(triangles):
            used, triangles = np.unique(triangles, return_inverse=True)
            return corners[used] + middle, triangles.reshape(-1, 3)
    size = max(spacing, 1e-3 * float(np.abs(points).max())) or 1e-3
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]])
    return middle + points.mean(0) + size * corners, np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])


def _tetrahedra(points: np.ndarray, spacing: float) -> tuple[np.ndarray, Delaunay | None]:
    """Returns the points and their Delaunay tetrahedra; of points in a plane those of a thin plate, of fewer none."""
    flat = np.linalg.svd(points - points.mean(0), full_matrices=False)[2][-1] if len(points) > 2 else np.zeros(3)
    plate = np.concatenate([points + side * _THIN * spacing * flat for side in (-1, 1)])
    for corners in (points, plate):
        try:
            return corners, Delaunay(corners)
        except (QhullError, ValueError):  # in a plane, in a line, or fewer than four
            continue
    return points, None


def _outer_boundary(points: np.ndarray, grid: Delaunay, reach: float) -> np.ndarray:
    """Returns the triangles of the alpha complex that can be seen from outside, facing there; a sheet has both sides.

    Tetrahedra alone would leave holes in flat sides without noise, whose points have no tetrahedron as small as the
    triangles between them.
    """
    cells = grid.simplices
    outside = len(cells)  # the number of what lies beyond the hull
    solid = np.append(_circumsphere(points[cells])[1] <= reach, False)
    inner = np.repeat(np.arange(outside), 4)
    outer = np.where(grid.neighbors < 0, outside, grid.neighbors).ravel()
    apex, triangles = points[cells.ravel()], cells[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3)
    center, radius = _circumsphere(points[triangles])
    empty = np.linalg.norm(apex - center, axis=1) >= radius * (1 - 1e-9)
    same = np.unique(np.sort(triangles, axis=1), axis=0, return_inverse=True)[1].ravel()
    empty = np.bincount(same, ~empty)[same] == 0  # on both sides
    wall = solid[inner] | solid[outer] | (empty & (radius <= reach))
    through = coo_matrix((np.ones((~wall).sum()), (inner[~wall], outer[~wall])), (outside + 1, outside + 1))
    region = connected_components(through, directed=False)[1]
    seen = (region == region[outside]) & ~solid
    wall &= np.isfinite(radius)
    # in the neighbor, the corner that the triangle lacks; a tetrahedron as flat as its triangle would not tell its sides
    beyond = np.append(cells, np.zeros((1, 4), cells.dtype), axis=0)[outer].sum(1) - triangles.sum(1)
    hull = outer == outside
    way = np.where(hull[:, None], points[triangles[:, 0]] - points.mean(0), points[np.where(hull, 0, beyond)] - apex)
    away, back = wall & seen[outer], wall & hull & seen[inner]
    return np.concatenate(
        [_facing(points, triangles[side], sign * way[side]) for side, sign in ((away, 1), (back, -1))]
    )


def _circumsphere(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns centers (M,3) and radii (M) of the least spheres through corners (M,k,3); infinite ones without extent."""
    edges = corners[:, 1:] - corners[:, :1]
    products = edges @ np.swapaxes(edges, 1, 2)
    squares = np.einsum("mii->mi", products)
    good = np.linalg.det(products) > 1e-30 * squares.prod(1)
    share = np.zeros_like(squares)
    share[good] = np.linalg.solve(products[good], squares[good][..., None] / 2)[..., 0]
    arm = np.einsum("mi,mik->mk", share, edges)
    return corners[:, 0] + arm, np.where(good, np.linalg.norm(arm, axis=1), np.inf)


def _facing(points: np.ndarray, triangles: np.ndarray, way: np.ndarray) -> np.ndarray:
    """Returns triangles whose normals point along directions (M,3)."""
    first, second, third = np.moveaxis(points[triangles], 1, 0)
    turned = np.einsum("ij,ij->i", np.cross(second - first, third - first), way) < 0
    return np.where(turned[:, None], triangles[:, ::-1], triangles)
