"""URDF files (with yourdfpy) into articulated objects: links joined by fixed joints are one body."""

from __future__ import annotations

import logging
import re
from collections import Counter, deque
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.errors import DataError
from dpcli.path_names import utf8_path
from dpcli.prepare.articulated.articulated_object import ArticulatedObject, Joint, drop_degenerate, joint_motion
from dpcli.prepare.articulated.urdf_meshes import geometry_triangles, resolve
from dpcli.runtime.clips.other_files import refuse_wrapped

MOVABLE = ("revolute", "continuous", "prismatic")
_UNSUPPORTED = ("floating", "planar")
_TYPES = (*MOVABLE, "fixed", *_UNSUPPORTED)
_TURNS = "hinges with limits more than two turns apart (one turn taken; are they degrees? a URDF has radians)"
_DEGREES = "origins turned by more than one turn (are they degrees? a URDF has radians)"
_LARGEST = 1e9  # of all numbers but limits, which may be as large as a float for none
_LARGE = 20.0  # meters, of a mesh
_MILLIMETERS = (
    f"meshes larger than {_LARGE:g} m (are they in millimeters? a URDF has meters; scale in <mesh> changes them)"
)
_EQUAL = (
    "joints whose two limits are equal taken as fixed (SolidWorks exports joints without limits so; to move them, give them"
    " limits or the type continuous)"
)

_SHAPES = ("box", "capsule", "cylinder", "sphere", "mesh")
_READ = {  # elements, and which of those within them count
    "robot": ("link", "joint"),
    "link": ("visual", "collision"),
    "visual": ("origin", "geometry"),
    "collision": ("origin", "geometry"),
    "joint": ("parent", "child", "origin", "axis", "limit", "mimic"),
}
_COUNTS = {  # texts of numbers, and how many
    **dict.fromkeys([("origin", "xyz"), ("origin", "rpy"), ("axis", "xyz"), ("box", "size")], (3,)),
    **dict.fromkeys([("limit", "lower"), ("limit", "upper"), ("mimic", "multiplier"), ("mimic", "offset")], (1,)),
    **{(shape, name): (1,) for shape in ("cylinder", "capsule", "sphere") for name in ("radius", "length")},
    ("mesh", "scale"): (1, 3),
}
_VERSION = re.compile(rb"\A((?:\xef\xbb\xbf)?<\?xml\s+version\s*=\s*[\"'])[\d.]+")  # simulators write 0.0, and read any
_UNDECLARED = re.compile(r"Namespace prefix (\S+) (?:for|on) ")
_XACRO = "it is written in xacro; make a plain URDF of it first: xacro FILE > robot.urdf"


@dataclass
class Skeleton:
    """Holds a URDF without its meshes. shapes: (body, 4x4 shape-to-body, geometry of yourdfpy) of every visual.

    root: the folder that its meshes must lie in, None for any.
    """

    path: Path
    joints: list[Joint]
    shapes: list[tuple[int, np.ndarray, Any]]
    notes: Counter
    root: Path | None = None


def read_skeleton(path: Path, root: Path | None = None) -> Skeleton:
    """Parses a URDF and merges links joined by fixed joints. Raises DataError when it isn't a tree of links.

    Limits: a continuous joint gets +-180 degrees, so does a revolute joint without limits; where one of two limits is
    given the other is 0, as the format says; inverted ones are swapped; of more than a turn the one about 0 is taken;
    a slide without limits has infinite ones here. Floating and planar joints are taken as fixed. All are noted.
    root: its meshes must lie in it.
    """
    notes: Counter = Counter()
    robot = _parse(path, notes)
    _check_names(path, robot)
    order, place = _walk_tree(path, robot)
    joints, sources = _movable(path, order, place, notes)
    return Skeleton(path, _followers(path, robot, joints, sources), _shapes(robot, place, notes), notes, root)


def load_object(skeleton: Skeleton) -> ArticulatedObject:
    """Returns the skeleton with the triangles of its visual geometry.

    DataError names a mesh that is missing or unreadable.
    """
    notes = Counter(skeleton.notes)
    triangles, bodies = [np.zeros((0, 3, 3))], [np.zeros(0, np.int64)]
    for body, placement, geometry in skeleton.shapes:
        corners = geometry_triangles(skeleton.path, geometry, skeleton.root, notes)
        if not len(corners):
            notes["mesh files without faces"] += 1
        elif geometry.mesh is not None and np.ptp(corners, axis=(0, 1)).max() > _LARGE:
            notes[_MILLIMETERS] += 1
        triangles.append(corners @ placement[:3, :3].T + placement[:3, 3])
        bodies.append(np.full(len(corners), body, np.int64))
    kept = drop_degenerate(np.concatenate(triangles), np.concatenate(bodies), notes)
    return ArticulatedObject(str(skeleton.path), list(skeleton.joints), *kept, notes)


def mesh_files(skeleton: Skeleton) -> dict[str, Path]:
    """Returns where the visual meshes are, or would be, by their names as the URDF spells them.

    Raises DataError when one lies outside the skeleton's root.
    """
    names = [geometry.mesh.filename for _, _, geometry in skeleton.shapes if geometry.mesh is not None]
    return {name: resolve(skeleton.path, name, skeleton.root) for name in names}


def _parse(path: Path, notes: Counter) -> Any:
    """Returns the robot of yourdfpy; cylinders that are ``round`` are capsules. What is odd is counted in ``notes``.

    Raises DataError when the file is not a URDF, or is a xacro.
    """
    from lxml import etree
    from yourdfpy import URDF

    logging.getLogger("yourdfpy.urdf").setLevel(logging.CRITICAL)
    utf8_path(path, "yourdfpy")
    try:
        refuse_wrapped(path)
        text = _VERSION.sub(rb"\g<1>1.0", path.read_bytes().lstrip(b" \t\r\n"))
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from None
    try:
        tree = _xml_tree(text)
        _make_plain(path, tree)
        turned = [origin for origin in tree.iter("origin") if _turns_over(origin.get("rpy", ""))]
        notes.update({_DEGREES: len(turned)} if turned else {})
        capsules = _capsules(tree.getroot())
        robot = URDF.load(BytesIO(etree.tostring(tree)), build_scene_graph=False, load_meshes=False).robot
        for link, kind, number in capsules:
            getattr(robot.links[link], kind + "s")[number].geometry.cylinder.round = True
        return robot
    except DataError:
        raise
    except (etree.LxmlError, OSError, LookupError) as error:  # such as bytes that are not of its encoding
        if isinstance(error, KeyError | IndexError):
            raise DataError(f"{path}: not a valid URDF: {type(error).__name__} {error}") from None
        problem = getattr(error, "msg", None) or error
        if "xacro" in str(problem):  # the prefix of its elements is not declared
            raise DataError(f"{path}: {_XACRO}") from None
        hint = "; save it as UTF-8, or name its encoding in its first line" if "ncoding" in str(problem) else ""
        raise DataError(f"{path}: not well-formed XML ({problem}); expected a URDF{hint}") from None
    except Exception as error:  # an element or attribute that is absent or odd: one bad file must not end the others
        raise DataError(f"{path}: not a valid URDF: {type(error).__name__} {error}") from None


def _xml_tree(text: bytes) -> Any:
    """Returns the tree of lxml; prefixes that the file doesn't declare, as of Drake, are no fault."""
    from lxml import etree

    known = {"xacro"}
    while True:
        try:
            return etree.parse(BytesIO(text), etree.XMLParser(resolve_entities=False, no_network=True))
        except etree.XMLSyntaxError as error:
            found = _UNDECLARED.match(error.msg or "")
            if found is None or found[1] in known:
                raise
            known.add(found[1])
            text = re.sub(rb"<robot(?=[\s>])", f'<robot xmlns:{found[1]}="{found[1]}"'.encode(), text, count=1)


def _make_plain(path: Path, tree: Any) -> None:
    """Takes namespaces out of the elements' names, and removes what is not read: other elements, collision shapes where there
    are visual ones, and those of unknown kinds.
    """
    from lxml import etree

    document, root = tree.docinfo.internalDTD, tree.getroot()
    if document is not None and any(True for _ in document.iterentities()):
        raise DataError(f"{path}: it has a DOCTYPE, whose entities are not read; expected a plain URDF")
    elements = [element for element in root.iter() if isinstance(element.tag, str)]
    if any(element.prefix == "xacro" for element in elements):
        raise DataError(f"{path}: {_XACRO}")
    for element in elements:
        if element.prefix is None:
            element.tag = element.tag.rpartition("}")[2]
    etree.cleanup_namespaces(tree)
    if root.tag != "robot":
        raise DataError(f"{path}: its root element is <{root.tag}>; expected <robot>, this is not a URDF")
    _remove_unread(root)
    if any("${" in value or "$(" in value for element in root.iter() for value in element.values()):
        raise DataError(f"{path}: {_XACRO}")
    root.set("name", root.get("name", "robot"))  # nothing here depends on it
    for origin in root.iter("origin"):
        if origin.get("quat_xyzw"):
            origin.set("rpy", " ".join(map(repr, _roll_pitch_yaw(path, origin.attrib.pop("quat_xyzw")))))
    for shape in root.findall("link/collision"):
        kinds = [part.tag for part in shape.findall("geometry/*") if isinstance(part.tag, str)]
        if not kinds or not {*kinds} <= {*_SHAPES}:
            shape.getparent().remove(shape)
    _check_visuals(path, root)
    _check_texts(path, root)


def _remove_unread(root: Any) -> None:
    """Removes what nothing here depends on, so that it may be as odd as it likes: masses, materials, motors, simulators."""
    drawn = root.find("link/visual/geometry/*") is not None
    for element in [element for element in root.iter() if element.tag in _READ]:
        for inner in list(element):
            if isinstance(inner.tag, str) and (
                inner.tag not in _READ[element.tag] or drawn and inner.tag == "collision"
            ):
                element.remove(inner)
    for geometry in root.iter("geometry"):  # some put a material into it
        inside = [element for element in geometry if isinstance(element.tag, str)]
        if any(element.tag in _SHAPES for element in inside):
            for unread in (element for element in inside if element.tag not in _SHAPES):
                geometry.remove(unread)
    for still in root.iterfind("joint[@type='fixed']"):
        for unread in [*still.findall("axis"), *still.findall("limit")]:
            still.remove(unread)
    for limit in root.iter("limit"):
        for name in {*limit.attrib} - {"lower", "upper"}:
            del limit.attrib[name]


def _check_visuals(path: Path, root: Any) -> None:
    """Raises DataError that names the link of a <visual> without a shape, or with several."""
    for shape in root.findall("link/visual"):
        link = shape.getparent().get("name")
        count = sum(isinstance(one.tag, str) for one in shape.findall("geometry/*"))
        if count == 0:
            raise DataError(
                f"{path}: link {link!r} has a <visual> without geometry; expected {', '.join(_SHAPES)} in it, or remove it"
            )
        if count > 1:
            raise DataError(
                f"{path}: link {link!r} has {count} shapes in one <visual>; give each a <visual> of its own"
            )


def _check_texts(path: Path, root: Any) -> None:
    """Raises DataError that names link or joint at a text that isn't the numbers it should be; an empty one is none."""
    for element in root.iter(*{tag for tag, _ in _COUNTS}):
        for name, text in element.items():
            expected = _COUNTS.get((element.tag, name))
            if not expected:
                continue
            if not text.strip():
                del element.attrib[name]
            elif len(text.split()) not in expected or not all(map(_is_number, text.split())):
                raise DataError(
                    f"{path}: {_owner(element)}: {name}={text!r} of <{element.tag}>; expected "
                    f"{' or '.join(map(str, expected))} {'number' if expected == (1,) else 'numbers'}, with spaces between"
                )
            elif element.tag != "limit" and not max(abs(float(word)) for word in text.split()) <= _LARGEST:
                raise DataError(
                    f"{path}: {_owner(element)}: {name}={text!r} of <{element.tag}>; no robot is that large (meters, radians)"
                )


def _owner(element: Any) -> str:
    owner = next(one for one in element.iterancestors() if one.tag in ("link", "joint", "robot"))
    return f"{owner.tag} {owner.get('name')!r}"


def _is_number(text: str) -> bool:
    """Returns whether a text is a number; infinite limits are none at all, but nan means nothing."""
    try:
        return not np.isnan(float(text))
    except ValueError:
        return False


def _turns_over(angles: str) -> bool:
    return any(abs(float(word)) > 2 * np.pi + 1e-2 for word in angles.split())


def _roll_pitch_yaw(path: Path, text: str) -> list[float]:
    """Returns the three angles of a quaternion, which newer URDFs may give instead of them."""
    from scipy.spatial.transform import Rotation

    try:
        return Rotation.from_quat([float(word) for word in text.split()]).as_euler("xyz").tolist()
    except ValueError:
        raise DataError(f"{path}: quat_xyzw {text!r} is not a rotation; expected four numbers, not all zero") from None


def _capsules(root: Any) -> list[tuple[int, str, int]]:
    """Returns where capsules stand, (link, kind, number in it), and calls them cylinders: yourdfpy knows no capsules."""
    found = []
    for index, link in enumerate(root.findall("link")):
        for kind in ("visual", "collision"):
            for number, shape in enumerate(link.findall(kind)):
                for solid in shape.findall("geometry/capsule"):
                    solid.tag = "cylinder"
                    found.append((index, kind, number))
    return found


def _check_names(path: Path, robot: Any) -> None:
    """Raises DataError when two links or two joints share a name, or when a joint mimics one that is not there."""
    for kind, entries in (("links", robot.links), ("joints", robot.joints)):
        twice = [name for name, count in Counter(entry.name for entry in entries).items() if count > 1]
        if twice:
            raise DataError(f"{path}: two {kind} have the name {twice[0]!r}; each needs its own, rename one")
    names = {joint.name for joint in robot.joints}
    for joint in robot.joints:
        if joint.mimic is not None and joint.mimic.joint not in names:
            raise DataError(
                f"{path}: joint {joint.name!r} mimics {joint.mimic.joint!r}; there is no joint of that name, "
                "correct it or remove the <mimic>"
            )


def _walk_tree(path: Path, robot: Any) -> tuple[list[Any], dict[str, tuple[int, np.ndarray]]]:
    """Returns the joints from the root outwards, and of every link its body and its 4x4 placement in that body."""
    links = {link.name for link in robot.links}
    children: dict[str, list[Any]] = {}
    parent_of: dict[str, Any] = {}
    for joint in robot.joints:
        for role, name in (("parent", joint.parent), ("child", joint.child)):
            if name not in links:
                raise DataError(f"{path}: joint {joint.name!r} has the {role} {name!r}; there is no link of that name")
        _check_numbers(path, joint)
        if joint.child in parent_of:
            first = parent_of[joint.child].name
            raise DataError(
                f"{path}: link {joint.child!r} is the child of two joints, {first!r} and {joint.name!r}; "
                "a URDF is a tree"
            )
        parent_of[joint.child] = joint
        children.setdefault(joint.parent, []).append(joint)
    shaped = {link.name for link in robot.links if link.visuals or link.name in children}
    roots = [link.name for link in robot.links if link.name not in parent_of and link.name in shaped]
    if len(roots) > 1:
        raise DataError(f"{path}: {len(roots)} links have no parent ({', '.join(roots[:4])}); expected one root")
    place: dict[str, tuple[int, np.ndarray]] = {root: (0, np.eye(4)) for root in roots}
    order, queue, bodies = [], deque(roots), 1
    while queue:
        for joint in children.get(queue.popleft(), []):
            order.append(joint)
            queue.append(joint.child)
            body, placement = place[joint.parent]
            if _moves(joint):
                place[joint.child], bodies = (bodies, np.eye(4)), bodies + 1
            else:
                place[joint.child] = (body, placement @ _fixed_motion(joint))
    left = [joint.child for joint in robot.joints if joint.child not in place]
    if left:
        raise DataError(f"{path}: links {', '.join(left[:4])} hang on each other in a cycle; a URDF is a tree")
    return order, place


def _check_numbers(path: Path, joint: Any) -> None:
    if joint.type in MOVABLE and (joint.axis.shape != (3,) or not 1e-9 < np.linalg.norm(joint.axis) < np.inf):
        raise DataError(f"{path}: joint {joint.name!r} has the axis {joint.axis}; expected three numbers, not all zero")
    if not np.isfinite(_origin(joint)).all():
        raise DataError(f"{path}: joint {joint.name!r} has an origin that is not finite")


def _limits(joint: Any) -> tuple[float, float, str]:
    """Returns (lower, upper, what was odd)."""
    low, high = (joint.limit.lower, joint.limit.upper) if joint.limit is not None else (None, None)
    alone = (low is None) != (high is None)
    if alone:
        low, high = low or 0.0, high or 0.0
    given = low is not None and high is not None and np.isfinite(low + high)
    if joint.type == "continuous":
        return -np.pi, np.pi, ""
    if not given and joint.type == "prismatic":
        return -np.inf, np.inf, ""
    if not given:
        return -np.pi, np.pi, "hinges without limits (+-180 degrees taken)"
    odd = "joints with one limit (the other is 0)" if alone else ""
    odd = "joints with inverted limits (swapped)" if low > high else odd
    low, high = min(low, high), max(low, high)
    if joint.type == "revolute" and high - low > 2 * np.pi:
        odd = _TURNS if high - low > 4 * np.pi + 1e-2 else odd
        middle = min(max(0.0, low + np.pi), high - np.pi)
        low, high = middle - np.pi, middle + np.pi
    return low, high, odd


def _moves(joint: Any) -> bool:
    return joint.type in MOVABLE and (joint.mimic is not None or np.ptp(_limits(joint)[:2]) > 0)


def _fixed_motion(joint: Any) -> np.ndarray:
    """Returns what a joint that doesn't move does: its origin, and its one value when its limits are equal."""
    if joint.type not in MOVABLE:
        return _origin(joint)
    own = _own_joint(joint, 0, 1, np.eye(4))
    return own.origin @ joint_motion(own, np.array([own.lower]))[0]


def _own_joint(joint: Any, parent: int, child: int, placement: np.ndarray) -> Joint:
    """Returns a joint of yourdfpy, of a kind that moves, as one of ours. placement: of its parent's link in the parent's body."""
    low, high, _ = _limits(joint)
    kind = "prismatic" if joint.type == "prismatic" else "revolute"
    axis = joint.axis / np.linalg.norm(joint.axis)
    return Joint(parent, child, kind, placement @ _origin(joint), axis, low, high)


def _origin(element: Any) -> np.ndarray:
    return np.eye(4) if element.origin is None else element.origin


def _movable(
    path: Path, order: list[Any], place: dict[str, tuple[int, np.ndarray]], notes: Counter
) -> tuple[list[Joint], list[Any]]:
    joints, sources = [], []
    for joint in order:
        if joint.type in _UNSUPPORTED:
            notes[f"{joint.type} joints taken as fixed"] += 1
        elif joint.type not in (*MOVABLE, "fixed"):
            raise DataError(f"{path}: joint {joint.name!r} has the type {joint.type!r}; expected {', '.join(_TYPES)}")
        if not _moves(joint):
            if joint.type in MOVABLE:
                notes[_EQUAL] += 1
            continue
        if odd := _limits(joint)[2]:
            notes[odd] += 1
        body, placement = place[joint.parent]
        joints.append(_own_joint(joint, body, place[joint.child][0], placement))
        sources.append(joint)
    return joints, sources


def _followers(path: Path, robot: Any, joints: list[Joint], sources: list[Any]) -> list[Joint]:
    """Returns the mimic joints; each follows the joint of its own that its chain of leaders ends at."""
    index = {source.name: i for i, source in enumerate(sources)}
    mimics = {joint.name: joint.mimic for joint in robot.joints if joint.mimic is not None}
    values = {joint.name: _limits(joint)[0] for joint in robot.joints if joint.type in MOVABLE and not _moves(joint)}
    result = list(joints)
    for i, source in enumerate(sources):
        name, multiplier, offset, seen = source.name, 1.0, 0.0, set()
        while (mimic := mimics.get(name)) is not None:
            if name in seen:
                raise DataError(f"{path}: joint {source.name!r} mimics itself, through {', '.join(sorted(seen))}")
            seen.add(name)
            offset += multiplier * (mimic.offset or 0.0)
            multiplier *= 1.0 if mimic.multiplier is None else mimic.multiplier
            name = mimic.joint
        if seen and name in index:
            result[i] = replace(joints[i], follows=index[name], multiplier=multiplier, offset=offset)
        elif seen:  # its leader never moves: it has the one value of its limits
            value = multiplier * values.get(name, 0.0) + offset
            result[i] = replace(joints[i], lower=value, upper=value)
    return result


def _shapes(robot: Any, place: dict[str, tuple[int, np.ndarray]], notes: Counter) -> list[tuple[int, np.ndarray, Any]]:
    """Returns the visual geometry, or that of the collisions when the file has no visual at all."""
    for kind in ("visuals", "collisions"):
        shapes = []
        for link in robot.links:
            if link.name not in place:
                continue
            body, placement = place[link.name]
            for shape in getattr(link, kind):
                if shape.geometry is not None:
                    shapes.append((body, placement @ _origin(shape), shape.geometry))
        if shapes:
            break
    if shapes and kind == "collisions":
        notes["objects without visual geometry (their collision geometry taken)"] += 1
    return shapes
