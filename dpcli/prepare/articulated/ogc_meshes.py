"""Any folder of meshes as shapes for generated rooms: centered, longest side 1, y up."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dpcli.errors import DataError
from dpcli.file_cache import cached_by_file
from dpcli.prepare.articulated.articulated_object import triangle_areas
from dpcli.prepare.articulated.urdf_meshes import MESH_FORMATS
from dpcli.prepare.decode.folder_listing import files_below
from dpcli.prepare.meshes.mesh_files import load_mesh
from dpcli.prepare.reader import natural_key, require_folder


@dataclass(frozen=True)
class Shape:
    """Holds triangles f64 (T,3,3), centered at the middle of their box, whose longest side is 1; hull f64 (V,3) spans
    them.
    """

    triangles: np.ndarray
    hull: np.ndarray


@cached_by_file(4)
def find_meshes(folder: Path) -> tuple[str, ...]:
    """Returns mesh files below a folder, relative to it, in natural order. Raises DataError when there are none."""
    require_folder(folder, f"meshes in it or below ({' '.join(MESH_FORMATS)})")
    found = [path.relative_to(folder).as_posix() for path in files_below(folder) if path.suffix.lower() in MESH_FORMATS]
    if not found:
        raise DataError(f"{folder}: no meshes in it or below; expected {' '.join(MESH_FORMATS)}")
    return tuple(sorted(found, key=natural_key))


@cached_by_file(24)
def load_shape(path: Path, up: str) -> Shape:
    """Reads a mesh file as a Shape; ``up``: the axis (y or z) that points up in it.

    Raises DataError when it has no surface.
    """
    try:
        mesh = load_mesh(path, path.parent)
        triangles = np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces, np.int64)]
    except DataError:
        raise
    except Exception as error:  # the readers of eight formats raise many kinds on damaged files
        raise DataError(f"{path}: not a readable mesh ({type(error).__name__}: {error})") from None
    triangles = triangles.reshape(-1, 3, 3)
    if up == "z":  # a quarter turn about x: z -> y, y -> -z
        triangles = triangles[..., [0, 2, 1]] * [1, 1, -1]
    if not len(triangles) or not np.isfinite(triangles).all() or not triangle_areas(triangles).sum() > 0:
        raise DataError(
            f"{path}: no surface (triangles: {len(triangles)}); expected a mesh of finite, non-empty triangles"
        )
    corners = triangles.reshape(-1, 3)
    low, high = corners.min(0), corners.max(0)
    triangles = (triangles - (low + high) / 2) / (high - low).max()
    return Shape(triangles, spanning(triangles.reshape(-1, 3)))


def spanning(points: np.ndarray) -> np.ndarray:
    """Returns the corners of the convex hull of points (N,3); all different points where it is flat."""
    from scipy.spatial import ConvexHull, QhullError

    points = np.unique(points, axis=0)
    try:
        return points[ConvexHull(points).vertices]
    except (QhullError, ValueError):
        return points
