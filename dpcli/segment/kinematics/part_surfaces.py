"""A surface around the points of a part, from all frames."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from dpcli.ops.open3d_import import load_open3d
from dpcli.segment.thinning import thin_evenly

_MOST = 20_000  # points that a surface is made of
_REACH = 3.0  # of an alpha shape's balls, in distances between neighboring points: wide enough to close, thin enough for holes


def part_surface(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns vertices f64 (V,3) and triangles i (F,3) of a surface around points f64 (M,3).

    An alpha shape (Edelsbrunner & Mücke 1994); where that has no triangle, the convex hull; where the points lie in a plane
    or are fewer than four, a small tetrahedron about their middle, so that every link has a shape.
    """
    points = thin_evenly(points, _MOST)
    middle = points.mean(0)  # far from the origin Open3D's tetrahedra lose their shape
    points = np.unique(points - middle, axis=0)
    spacing = float(np.median(cKDTree(points).query(points, 2)[0][:, 1])) if len(points) > 1 else 0.0
    for mesh in (_alpha_shape, _hull):
        vertices, triangles = mesh(points, _REACH * spacing)
        if len(triangles):
            return vertices + middle, triangles
    size = max(spacing, 1e-3 * float(np.abs(points).max())) or 1e-3
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]])
    return middle + points.mean(0) + size * corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def _alpha_shape(points: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    o3d = load_open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    try:
        with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            mesh = o3d.geometry.TriangleMesh.create_from_point_cloud_alpha_shape(cloud, reach)
    except RuntimeError:  # points in a plane have no tetrahedra
        return points, np.zeros((0, 3), np.int32)
    mesh.remove_unreferenced_vertices()
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles)


def _hull(points: np.ndarray, _: float) -> tuple[np.ndarray, np.ndarray]:
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):  # flat, or fewer than four points
        return points, np.zeros((0, 3), np.int32)
    order = np.einsum("ij,ij->i", hull.equations[:, :3], _normals(points[hull.simplices])) < 0
    triangles = hull.simplices.copy()
    triangles[order] = triangles[order][:, ::-1]  # outward
    return points, triangles


def _normals(corners: np.ndarray) -> np.ndarray:
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
