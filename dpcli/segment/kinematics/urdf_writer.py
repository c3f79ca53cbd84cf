"""A kinematic tree as a URDF robot with meshes, which other programs load and move, and as JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from dpcli.draw.palette import part_colors
from dpcli.runtime.whole_file import make_folder, write_whole
from dpcli.segment.kinematics.kinematic_tree import KinematicTree, PartJoint
from dpcli.segment.kinematics.part_surfaces import part_surface
from dpcli.standard_streams import printable
from dpcli.store import CloudSequence
from dpcli.store.joints import FIXED, FREE, PRISMATIC, REVOLUTE, TYPES
from dpcli.store.schema import METERS

_URDF_TYPES = {REVOLUTE: "revolute", PRISMATIC: "prismatic", FIXED: "fixed", FREE: "floating"}


def write_urdf(path: Path, tree: KinematicTree, name: str, unit: str) -> None:
    """Writes the tree as a URDF file, and a folder of meshes (.obj) beside it: `object_meshes` beside `object.urdf`.

    At joint values 0 the object is as in frame 0; a link's origin lies on its joint's axis. Limits are the values seen.
    Lengths are meters, as URDF has them, where the tree's unit is a known one.
    Raises DpcError where a file can't be written.
    """
    folder = path.with_name(f"{path.stem}_meshes")
    make_folder(folder)
    robot = ElementTree.Element("robot", name=printable(name))  # XML has no place for control characters
    origins, meters = link_origins(tree), METERS.get(unit, 1.0)
    for row, part in enumerate(tree.trajectories.ids.tolist()):
        file = folder / f"part_{part}.obj"
        vertices, triangles = part_surface(tree.points[row] - origins[row])
        write_whole(file, _obj(vertices * meters, triangles))
        robot.append(_link(part, f"{folder.name}/{file.name}"))
    for joint in tree.joints:
        robot.append(_joint(joint, tree, origins, meters))
    ElementTree.indent(robot)
    write_whole(path, b'<?xml version="1.0"?>\n' + ElementTree.tostring(robot, encoding="utf-8") + b"\n")


def link_origins(tree: KinematicTree) -> np.ndarray:
    """Returns where each part's link has its origin in frame 0, f64 (K,3): on its joint's axis; the root's at 0."""
    origins = np.zeros((len(tree.points), 3))
    for joint in tree.joints:
        fit = joint.fit
        origins[joint.child] = fit.point if fit.kind in (REVOLUTE, PRISMATIC) else tree.points[joint.child].mean(0)
    return origins


def _link(part: int, mesh: str) -> ElementTree.Element:
    link = ElementTree.Element("link", name=f"part_{part}")
    color = " ".join(f"{value / 255:.3f}" for value in part_colors(np.array([part]))[0])
    for kind in ("visual", "collision"):
        shape = ElementTree.SubElement(link, kind)
        ElementTree.SubElement(ElementTree.SubElement(shape, "geometry"), "mesh", filename=mesh)
        if kind == "visual":
            material = ElementTree.SubElement(shape, "material", name=f"color_{part}")
            ElementTree.SubElement(material, "color", rgba=f"{color} 1")
    return link


def _joint(joint: PartJoint, tree: KinematicTree, origins: np.ndarray, meters: float) -> ElementTree.Element:
    ids, fit = tree.trajectories.ids, joint.fit
    element = ElementTree.Element("joint", name=f"joint_{ids[joint.child]}", type=_URDF_TYPES[fit.kind])
    ElementTree.SubElement(element, "parent", link=f"part_{ids[joint.parent]}")
    ElementTree.SubElement(element, "child", link=f"part_{ids[joint.child]}")
    offset = meters * (origins[joint.child] - origins[joint.parent])
    ElementTree.SubElement(element, "origin", xyz=_numbers(offset), rpy="0 0 0")
    if fit.kind in (REVOLUTE, PRISMATIC):
        ElementTree.SubElement(element, "axis", xyz=_numbers(fit.axis))
        scale = meters if fit.kind == PRISMATIC else 1.0
        low, high = (f"{scale * value:.9g}" for value in (fit.value.min(), fit.value.max()))
        ElementTree.SubElement(element, "limit", lower=low, upper=high, effort="1", velocity="1")
    return element


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def _obj(vertices: np.ndarray, triangles: np.ndarray) -> bytes:
    lines = [f"v {_numbers(vertex)}" for vertex in vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in triangles + 1]
    return ("\n".join(lines) + "\n").encode("ascii")


def tree_json(tree: KinematicTree, sequence: CloudSequence, unit: str) -> dict[str, Any]:
    """Returns the tree of a sequence as an object for JSON: root, joints with axis, origin, range and value in each frame.

    Coordinates are those of frame 0 in `unit`, angles are radians; with `shift` added they are the original ones, which is
    there where something was taken off. root_motion: the root's motion (4,4) from frame 0 to each frame; a free joint has
    the child's motion as the parent sees it.
    """
    trajectories, ids = tree.trajectories, tree.trajectories.ids
    root = trajectories.motion[:, tree.root]
    return {
        "name": sequence.name,
        "length_unit": unit,
        **({} if sequence.shift is None else {"shift": sequence.shift.tolist()}),
        "parts": ids.tolist(),
        "root": int(ids[tree.root]),
        "root_motion": root.tolist(),
        "joints": [_joint_json(joint, tree) for joint in tree.joints],
    }


def _joint_json(joint: PartJoint, tree: KinematicTree) -> dict[str, Any]:
    fit, ids, motion = joint.fit, tree.trajectories.ids, tree.trajectories.motion
    said: dict[str, Any] = {
        "child": int(ids[joint.child]),
        "parent": int(ids[joint.parent]),
        "type": TYPES[fit.kind],
        "residual": fit.residual,
    }
    if fit.kind in (REVOLUTE, PRISMATIC):
        said |= {"axis": fit.axis.tolist(), "origin": fit.point.tolist(), "value": fit.value.tolist()}
        said["range"] = [float(fit.value.min()), float(fit.value.max())]
    if fit.kind == FREE:
        said["motion"] = (np.linalg.inv(motion[:, joint.parent]) @ motion[:, joint.child]).tolist()
    return said


def write_trees(path: Path, trees: list[dict[str, Any]]) -> None:
    """Writes the objects of `tree_json` as one JSON list, whole or not at all. Raises DpcError where it can't be written."""
    write_whole(path, (json.dumps(trees, indent=1, allow_nan=False) + "\n").encode("utf-8"))
