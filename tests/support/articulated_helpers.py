"""Small URDF files and meshes, written by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np

CUBE_OBJ = (
    """mtllib nowhere.mtl
usemtl none
"""
    + "".join(f"v {x} {y} {z}\n" for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5))
    + ("f 1 2 4\nf 1 4 3\nf 5 7 8\nf 5 8 6\nf 1 5 6\nf 1 6 2\nf 3 4 8\nf 3 8 7\nf 1 3 7\nf 1 7 5\nf 2 6 8\nf 2 8 4\n")
)


def link(name: str, geometry: str = "", xyz: str = "0 0 0", kind: str = "visual") -> str:
    """A link with one geometry element, or none."""
    inside = f'<{kind}><origin xyz="{xyz}"/><geometry>{geometry}</geometry></{kind}>' if geometry else ""
    return f'<link name="{name}">{inside}</link>'


def joint(
    name: str,
    parent: str,
    child: str,
    kind: str = "revolute",
    axis: str = "0 0 1",
    limits: str = "0 1.5",
    xyz: str = "0 0 0",
    rpy: str = "0 0 0",
    more: str = "",
) -> str:
    """A joint; limits "" for none."""
    low, high = limits.split() if limits else ("", "")
    limit = f'<limit lower="{low}" upper="{high}"/>' if limits else ""
    return (
        f'<joint name="{name}" type="{kind}"><origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>'
        f'<parent link="{parent}"/><child link="{child}"/>{limit}{more}</joint>'
    )


def box(x: float, y: float, z: float) -> str:
    return f'<box size="{x} {y} {z}"/>'


def write_urdf(path: Path, *elements: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f'<?xml version="1.0"?><robot name="r">{"".join(elements)}</robot>')
    return path


def cabinet(path: Path) -> Path:
    """A body, a door (hinge about z at x = -0.5), a drawer (slide along -y), a knob fixed to the door."""
    mesh = path.parent / "meshes" / "cube.obj"
    mesh.parent.mkdir(parents=True, exist_ok=True)
    mesh.write_text(CUBE_OBJ)
    return write_urdf(
        path,
        link("base"),
        link("body", '<mesh filename="meshes/cube.obj" scale="1 0.6 1.5"/>'),
        link("door", box(1, 0.05, 0.7), "0.5 0 0"),
        link("knob", box(0.1, 0.08, 0.1)),
        link("drawer", box(0.9, 0.5, 0.4)),
        joint("root", "base", "body", "fixed", rpy="0 0 0.3", xyz="0.1 0.2 0.3"),
        joint("hinge", "body", "door", axis="0 0 -1", limits="0 2.0", xyz="-0.5 -0.33 0.3"),
        joint("weld", "door", "knob", "fixed", xyz="0.9 -0.06 0"),
        joint("slide", "body", "drawer", "prismatic", axis="0 -2 0", limits="0 0.4", xyz="0 -0.1 -0.4"),
    )


def distance_to_triangles(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Distance f64 (N) from points (N,3) to the nearest of triangles (T,3,3), by brute force over faces, edges, corners."""
    best = np.full(len(points), np.inf)
    for a, b, c in triangles:
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal)
        height = (points - a) @ normal
        foot = points - height[:, None] * normal
        inside = np.ones(len(points), bool)
        for p, q in ((a, b), (b, c), (c, a)):
            inside &= np.cross(q - p, foot - p) @ normal >= 0
            s = np.clip((points - p) @ (q - p) / ((q - p) @ (q - p)), 0, 1)
            best = np.minimum(best, np.linalg.norm(points - p - s[:, None] * (q - p), axis=1))
        best = np.where(inside, np.minimum(best, np.abs(height)), best)
    return best
