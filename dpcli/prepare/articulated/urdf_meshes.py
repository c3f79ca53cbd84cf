"""The geometry elements of a URDF as triangles: boxes, cylinders, spheres, and mesh files (with trimesh)."""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from dpcli.errors import DataError
from dpcli.path_names import path_inside
from dpcli.prepare.meshes.mesh_files import load_mesh

MESH_FORMATS = (".obj", ".stl", ".ply", ".glb", ".gltf", ".off", ".dae")
_PACKAGES = ("package://", "model://")  # of ROS and Gazebo: the folder of the robot, or one above it


def geometry_triangles(path: Path, geometry: Any, root: Path | None, notes: Counter) -> np.ndarray:
    """Returns the corners f64 (T,3,3) of a geometry element, in its own frame, in meters.

    Mesh files outside ``root`` are refused (None: they may lie anywhere); those in other units are scaled and noted.
    """
    if geometry.mesh is not None:
        mesh = _load_mesh(path, geometry.mesh.filename, root)
        scale = 1.0 if geometry.mesh.scale is None else geometry.mesh.scale
        scale = np.asarray(scale, np.float64) * _meters(path, mesh, geometry.mesh.filename, notes)
        if scale.shape not in ((), (3,)):
            raise DataError(f"{path}: the scale of its mesh {geometry.mesh.filename} is not one or three numbers")
        return np.asarray(mesh.vertices, np.float64)[mesh.faces] * scale
    try:
        mesh = _solid(geometry)
    except (TypeError, ValueError, AttributeError, IndexError, OverflowError) as error:
        raise DataError(f"{path}: a box, cylinder or sphere has no valid size ({error})") from None
    return np.zeros((0, 3, 3)) if mesh is None else np.asarray(mesh.vertices, np.float64)[mesh.faces]


def _solid(geometry: Any) -> Any:
    """Returns the mesh of a box, cylinder, capsule or sphere; None for what has no shape."""
    import trimesh

    if geometry.box is not None:
        return trimesh.creation.box(extents=np.asarray(geometry.box.size, np.float64).reshape(3))
    if geometry.cylinder is not None:
        radius, length = float(geometry.cylinder.radius), float(geometry.cylinder.length)
        if getattr(geometry.cylinder, "round", False):
            return trimesh.creation.capsule(length, radius, (24, 48))
        return trimesh.creation.cylinder(radius, length, sections=48)
    if geometry.sphere is not None:
        with np.errstate(invalid="ignore"):  # of no size, as some links have that are only a place
            return trimesh.creation.icosphere(subdivisions=3, radius=geometry.sphere.radius)
    return None


def resolve(path: Path, name: str, root: Path | None) -> Path:
    """Returns where a mesh is: beside the URDF, or in one of the folders above it as ``package://`` names need it.

    Raises DataError when the name leads out of ``root``.
    """
    if not name:
        raise DataError(f"{path}: a mesh without a filename; name its file")
    name = name.replace("\\", "/").removeprefix("file://")  # written on Windows
    in_package = name.startswith(_PACKAGES)
    plain = name.split("://", 1)[1] if in_package else name
    plain = plain.lstrip("/") if in_package else plain  # package:///part.stl, of a package without a name
    tails = [plain, plain.split("/", 1)[1]] if in_package and "/" in plain else [plain]
    tails += [unquote(tail) for tail in tails if "%" in tail]
    folders = [path.parent]
    if in_package:
        above = list(path.resolve().parents)[1:4]
        folders += [folder for folder in above if root is None or folder.is_relative_to(root.resolve())]
    places = [_joined(path, root, folder, tail) for folder in folders for tail in tails]
    if not any(place.is_file() for place in places):
        places += [_joined(path, root, folder, _as_stored(folder, tail)) for folder in folders for tail in tails]
    return next((place for place in places if place.is_file()), places[0])


def _as_stored(folder: Path, tail: str) -> str:
    """Returns the name of a file in the capitals that it has on the disk, which Windows and macOS don't tell apart."""
    here, parts = folder, tail.split("/")
    for at, part in enumerate(parts):
        if (
            part not in ("", ".", "..")
            and os.access(here, os.R_OK | os.X_OK)
            and here.is_dir()
            and not (here / part).exists()
        ):
            alike = [name for name in os.listdir(here) if name.lower() == part.lower()]
            parts[at] = alike[0] if len(alike) == 1 else part
        here = here / parts[at]
    return "/".join(parts)


def is_missing(path: Path, name: str, root: Path | None) -> str:
    """Returns what is said of a mesh that isn't there, and where it lies when that is outside ``root``."""
    if root is not None and resolve(path, name, None).is_file():
        return f"{name} is outside the folder {root}: name a folder above it (or --allow-outside)"
    return f"{name} is missing"


def _joined(path: Path, root: Path | None, folder: Path, name: str) -> Path:
    try:
        return path_inside(root, folder, name)
    except DataError as error:
        raise DataError(f"{path}: its mesh {error} (--allow-outside opens others)") from None


def _load_mesh(path: Path, name: str, root: Path | None) -> Any:
    file = resolve(path, name, root)
    if not file.is_file():
        raise DataError(f"{path}: its mesh {is_missing(path, name, root)}")
    if file.suffix.lower() not in MESH_FORMATS:
        raise DataError(f"{path}: its mesh {name} is of an unknown format; expected one of {' '.join(MESH_FORMATS)}")
    try:
        mesh = load_mesh(file, root)
        if mesh.vertices.shape[1:] != (3,):
            raise ValueError(f"its vertices have {mesh.vertices.shape[1]} coordinates, expected 3")
        return mesh
    except DataError as error:
        raise DataError(f"{path}: its mesh {error}") from None
    except Exception as error:  # the readers of eight formats raise many kinds on damaged files
        raise DataError(f"{path}: its mesh {name} cannot be read ({type(error).__name__}: {error})") from None


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
