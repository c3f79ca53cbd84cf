"""The geometry elements of a URDF as triangles: boxes, cylinders, spheres, and mesh files (with trimesh)."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.path_names import path_inside

MESH_FORMATS = (".obj", ".stl", ".ply", ".glb", ".gltf", ".off", ".dae")


def geometry_triangles(path: Path, geometry: Any, root: Path | None, notes: Counter) -> np.ndarray:
    """Returns the corners f64 (T,3,3) of a geometry element, in its own frame, in meters.

    Mesh files outside ``root`` are refused (None: they may lie anywhere); those in other units are scaled and noted.
    """
    import trimesh

    scale = 1.0
    if geometry.box is not None:
        mesh = trimesh.creation.box(extents=geometry.box.size)
    elif geometry.cylinder is not None:
        mesh = trimesh.creation.cylinder(geometry.cylinder.radius, geometry.cylinder.length, sections=48)
    elif geometry.sphere is not None:
        mesh = trimesh.creation.icosphere(subdivisions=3, radius=geometry.sphere.radius)
    elif geometry.mesh is not None:
        mesh = _load_mesh(path, geometry.mesh.filename, root)
        scale = 1.0 if geometry.mesh.scale is None else geometry.mesh.scale
        scale = np.asarray(scale, np.float64) * _meters(path, mesh, geometry.mesh.filename, notes)
    else:
        return np.zeros((0, 3, 3))
    return np.asarray(mesh.vertices, np.float64)[mesh.faces] * np.asarray(scale, np.float64)


def resolve(path: Path, name: str, root: Path | None) -> Path:
    """Returns where a mesh is: beside the URDF, or in one of the folders above it as ``package://`` names need it.

    Raises DataError when the name leads out of ``root``.
    """
    plain = name.split("://", 1)[1] if "://" in name else name
    tails = [plain, plain.split("/", 1)[1]] if name.startswith("package://") and "/" in plain else [plain]
    folders = [path.parent]
    if "://" in name and not name.startswith("file://"):
        above = list(path.resolve().parents)[1:4]
        folders += [folder for folder in above if root is None or folder.is_relative_to(root.resolve())]
    places = [_joined(path, root, folder, tail) for folder in folders for tail in tails]
    return next((place for place in places if place.is_file()), places[-1] if len(tails) > 1 else places[0])


def _joined(path: Path, root: Path | None, folder: Path, name: str) -> Path:
    try:
        return path_inside(root, folder, name)
    except DataError as error:
        raise DataError(f"{path}: its mesh {error} (--allow-outside opens others)") from None


def _load_mesh(path: Path, name: str, root: Path | None) -> Any:
    import trimesh

    file = resolve(path, name, root)
    if not file.is_file():
        raise DataError(f"{path}: its mesh {name} is missing")
    if file.suffix.lower() not in MESH_FORMATS:
        raise DataError(f"{path}: its mesh {name} is of an unknown format; expected one of {' '.join(MESH_FORMATS)}")
    try:
        options = {"skip_materials": True} if file.suffix.lower() == ".obj" else {}
        mesh = trimesh.load(file, force="mesh", process=False, resolver=_resolver(file, root), **options)
        if mesh.vertices.shape[1:] != (3,):
            raise ValueError(f"its vertices have {mesh.vertices.shape[1]} coordinates, expected 3")
        if len(mesh.faces) and mesh.faces.max() >= len(mesh.vertices):
            raise ValueError("a face names a vertex that is not there")
        return mesh
    except Exception as error:  # the readers of eight formats raise many kinds on damaged files
        raise DataError(f"{path}: its mesh {name} cannot be read ({type(error).__name__}: {error})") from None


def _resolver(file: Path, root: Path | None) -> Any:
    """Returns what trimesh asks for the buffers and pictures of a mesh: files inside ``root`` alone."""
    from trimesh.resolvers import FilePathResolver

    class _Inside(FilePathResolver):
        def get(self, name: str) -> bytes:
            return path_inside(root, file.parent, name.strip()).read_bytes()

    return _Inside(str(file))


def _meters(path: Path, mesh: Any, name: str, notes: Counter) -> float:
    """Returns how many meters the unit is that a mesh file declares; 1 when it declares none."""
    from trimesh.units import unit_conversion

    if not mesh.units:
        return 1.0
    try:
        factor = float(unit_conversion(mesh.units, "meters"))
    except (KeyError, ValueError, TypeError):
        factor = np.nan
    if not 0 < factor < np.inf:
        raise DataError(f"{path}: its mesh {name} declares the unit {mesh.units!r}; expected a length, such as meters")
    if abs(factor - 1) > 1e-9:
        notes["mesh files scaled from the unit they declare to meters"] += 1
    return factor
