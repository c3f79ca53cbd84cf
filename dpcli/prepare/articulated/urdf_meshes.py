"""The geometry elements of a URDF as triangles: boxes, cylinders, spheres, and mesh files (with trimesh)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError

MESH_FORMATS = (".obj", ".stl", ".ply", ".glb", ".gltf", ".off", ".dae")


def geometry_triangles(path: Path, geometry: Any) -> np.ndarray:
    """Returns the corners f64 (T,3,3) of a geometry element, in its own frame."""
    import trimesh

    scale = 1.0
    if geometry.box is not None:
        mesh = trimesh.creation.box(extents=geometry.box.size)
    elif geometry.cylinder is not None:
        mesh = trimesh.creation.cylinder(geometry.cylinder.radius, geometry.cylinder.length, sections=48)
    elif geometry.sphere is not None:
        mesh = trimesh.creation.icosphere(subdivisions=3, radius=geometry.sphere.radius)
    elif geometry.mesh is not None:
        mesh = _load_mesh(path, geometry.mesh.filename)
        scale = 1.0 if geometry.mesh.scale is None else geometry.mesh.scale
    else:
        return np.zeros((0, 3, 3))
    return np.asarray(mesh.vertices, np.float64)[mesh.faces] * np.asarray(scale, np.float64)


def resolve(path: Path, name: str) -> Path:
    """Returns where a mesh is: beside the URDF, or in one of the folders above it as ``package://`` names need it."""
    plain = name.split("://", 1)[1] if "://" in name else name
    tails = [plain, plain.split("/", 1)[1]] if name.startswith("package://") and "/" in plain else [plain]
    folders = [path.parent, *list(path.resolve().parents)[1:4]] if "://" in name else [path.parent]
    places = [folder / tail for folder in folders for tail in tails]
    return next((place for place in places if place.is_file()), places[-1] if len(tails) > 1 else places[0])


def _load_mesh(path: Path, name: str) -> Any:
    import trimesh

    file = resolve(path, name)
    if not file.is_file():
        raise DataError(f"{path}: its mesh {name} is missing")
    if file.suffix.lower() not in MESH_FORMATS:
        raise DataError(f"{path}: its mesh {name} is of an unknown format; expected one of {' '.join(MESH_FORMATS)}")
    try:
        options = {"skip_materials": True} if file.suffix.lower() == ".obj" else {}
        mesh = trimesh.load(file, force="mesh", process=False, **options)
        if len(mesh.faces) and mesh.faces.max() >= len(mesh.vertices):
            raise ValueError("a face names a vertex that is not there")
        return mesh
    except Exception as error:  # the readers of eight formats raise many kinds on damaged files
        raise DataError(f"{path}: its mesh {name} cannot be read ({type(error).__name__}: {error})") from None
