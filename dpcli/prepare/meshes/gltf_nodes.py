"""The nodes of a glTF file and its clips: where every node is at every time."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from dpcli.errors import DataError, UsageError
from dpcli.prepare.meshes.gltf import Gltf
from dpcli.prepare.meshes.skinning import Curve, matrices
from dpcli.runtime.progress import log

_REST = {"translation": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0, 1.0), "scale": (1.0, 1.0, 1.0)}
_AFFINE = 1e-3  # what 32 bits and careless exporters leave of 0, 0, 0, 1
_POINTER = re.compile(
    r"/nodes/(\d+)/(?:extensions/KHR_node_visibility/(?=visible$))?(visible|translation|rotation|scale|weights)"
)


@dataclass(frozen=True)
class Clip:
    """Holds one animation. curves: (node, translation | rotation | scale | weights) -> Curve. Seconds.

    passed: what it changes besides nodes, as pointers into the file.
    """

    name: str
    start: float
    end: float
    curves: dict[tuple[int, str], Curve]
    passed: tuple[str, ...] = ()

    def sample_times(self, frames: int) -> np.ndarray:
        """Returns `frames` times f64 (T) from the start on; the end is left out, in a loop it would repeat the first
        frame.
        """
        return self.start + (self.end - self.start) * np.arange(frames) / frames


def clip_names(file: Gltf) -> list[str]:
    """Returns the names of the animations in the file's order, each once: clip N when unnamed, NAME (2) for a second of a name.

    What would move a terminal's cursor is spelled out, such as \\x1b.
    """
    found: list[str] = []
    for index, entry in enumerate(file.items("animations")):
        plain = str(entry.get("name") or "").strip() or f"clip {index}"
        plain = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in plain)
        name, number = plain, 1
        while name in found:
            number += 1
            name = f"{plain} ({number})"
        found.append(name)
    return found


def choose_clip(file: Gltf, wanted: str | None) -> int:
    """Returns the index of a clip by name, by what follows a | of it, in any case, or by its number from 0.

    None: the first.
    """
    names = clip_names(file)
    if not names:
        raise file.fail("has no animation: nothing moves in it. Export the model with its clips (see --list)")
    if wanted is None:
        return 0
    if wanted in names:
        return names.index(wanted)
    asked, lower = wanted.lower(), [name.lower() for name in names]
    for fits in (asked.__eq__, lambda name: name.endswith(f"|{asked}")):
        same = [index for index, name in enumerate(lower) if fits(name)]
        if len(same) == 1:
            return same[0]
    if wanted.isdecimal() and int(wanted) < len(names):
        return int(wanted)
    raise UsageError(
        f"--clip {wanted}: {file.path} has {', '.join(names)}; name one, or its number 0 .. {len(names) - 1}"
    )


def read_clip(file: Gltf, index: int) -> Clip:
    """Reads the clip's curves. Raises DataError that names clip, node and key when one is broken."""
    entry, name = file.item("animations", index), clip_names(file)[index]
    curves, passed = {}, []
    for channel in entry.get("channels", []):
        node, path = _target(channel.get("target", {}))
        if node is None or path not in (*_REST, "weights", "visible"):
            passed.append(str(path))  # what an extension moves; the specification says to pass it over
            continue
        what = f"clip {name!r}, {path} of {node_name(file, node)!r}"
        if (node, path) in curves:
            log.warn(f"{file.path}: {what}: two channels move it, and the last one counts")
        try:
            sampler = entry["samplers"][channel["sampler"]]
            keys = (sampler["input"], sampler["output"], sampler.get("interpolation", "LINEAR"))
        except (KeyError, IndexError, TypeError):
            raise file.fail(f"{what}: its sampler is missing; export the file again") from None
        interpolation = "STEP" if path == "visible" else keys[2]
        curves[node, path] = _read_curve(file, what, path, *keys[:2], interpolation)
    if not curves:
        raise file.fail(f"clip {name!r} moves nothing; choose another with --clip (see --list)")
    start, end = min(c.times[0] for c in curves.values()), max(c.times[-1] for c in curves.values())
    return Clip(name, float(start), float(end), curves, tuple(dict.fromkeys(passed)))


def clips_apart(file: Gltf, index: int) -> list[str]:
    """Returns the names of the clips that move something with a surface, but nothing that this clip does.

    So exporters write a scene of several objects when each has an action of its own.
    """
    targets = [_targets(entry) for entry in file.items("animations")]
    names, mine = clip_names(file), targets[index]
    others = [n for n, own in enumerate(targets) if n != index and own and own.isdisjoint(mine)]
    carriers = _carriers(file) if others else set()
    return [names[other] for other in others if _moves_any(file, other, carriers)]


def _targets(entry: dict[str, Any]) -> set[tuple[int | None, str | None]]:
    """Returns all that a clip's channels change; nothing for one that is broken."""
    try:
        return {_target(channel.get("target", {})) for channel in entry.get("channels", [])}
    except (TypeError, AttributeError):
        return set()


def _carriers(file: Gltf) -> set[int]:
    """Returns the nodes that carry a mesh, bend one or have such nodes below them."""
    parent = node_parents(file)
    found = {joint for skin in file.items("skins") for joint in skin.get("joints", [])}
    waiting = [*found, *(index for index, node in enumerate(file.items("nodes")) if "mesh" in node)]
    while waiting:
        found.add(index := waiting.pop())
        waiting += [above for above in [int(parent[index])] if above >= 0 and above not in found]
    return found


def _moves_any(file: Gltf, index: int, nodes: set[int]) -> bool:
    """Returns whether a clip changes one of the nodes over time; False for one that is broken."""
    try:
        curves = read_clip(file, index).curves
    except DataError:
        return False
    return any(node in nodes and np.ptp(curve.values, axis=0).any() for (node, _), curve in curves.items())


def _target(target: dict[str, Any]) -> tuple[int | None, str | None]:
    """Returns node and property of a channel, where KHR_animation_pointer points at those of a node, too."""
    if target.get("path") != "pointer":
        return target.get("node"), target.get("path")
    pointer = str(target.get("extensions", {}).get("KHR_animation_pointer", {}).get("pointer", ""))
    found = _POINTER.fullmatch(pointer)
    return (int(found[1]), found[2]) if found else (None, pointer)


def _read_curve(file: Gltf, what: str, path: str, times: int, values: int, interpolation: str) -> Curve:
    if interpolation not in ("LINEAR", "STEP", "CUBICSPLINE"):
        raise file.fail(f"{what}: its keys are joined by {interpolation!r}; expected LINEAR, STEP or CUBICSPLINE")
    times = file.accessor(times, what, 1).astype(np.float64)
    if (np.diff(times) < 0).any():
        raise file.fail(f"{what}: its times do not rise; export the file again")
    values = file.accessor(values, what).astype(np.float64)
    group = (3,) if interpolation == "CUBICSPLINE" else ()  # a key has tangents before and behind its value
    count = len(times) * (3 if group else 1)
    width = len(_REST[path]) if path in _REST else values.size // count
    if values.size != count * width or not width:
        raise file.fail(f"{what}: {values.size} numbers for {len(times)} keys of {width}; export the file again")
    values = values.reshape(len(times), *group, width)
    short = np.linalg.norm(values[:, 1] if group else values, axis=-1) < 1e-6
    if path == "rotation" and short.any():
        raise file.fail(f"{what}: the quaternion of key {short.argmax()} is zero; repair the model, export it again")
    return Curve(times, values, interpolation, path == "rotation")


def node_name(file: Gltf, index: int) -> str:
    """Returns a node's name for messages."""
    return str(file.item("nodes", index).get("name") or f"node {index}")


def node_parents(file: Gltf) -> np.ndarray:
    """Returns parent i64 (N) of every node, -1 for roots. Raises DataError when one has two, or is below itself."""
    nodes = file.items("nodes")
    parent = np.full(len(nodes), -1)
    for index, node in enumerate(nodes):
        for child in node.get("children", []):
            file.item("nodes", child)
            if parent[child] >= 0:
                raise file.fail(f"node {node_name(file, child)!r} has two parents; export the file again")
            parent[child] = index
    if len(parents_first(parent)) < len(nodes):
        raise file.fail("its nodes form a circle; export the file again")
    return parent


def parents_first(parent: np.ndarray) -> list[int]:
    """Returns indices such that a parent comes before its children; those on a circle are left out."""
    children: dict[int, list[int]] = {}
    for index, above in enumerate(parent):
        children.setdefault(int(above), []).append(index)
    order = list(children.get(-1, []))
    for index in order:  # grows while it is walked
        order += children.get(index, [])
    return order


def node_poses(file: Gltf, parent: np.ndarray, clip: Clip, time: np.ndarray) -> np.ndarray:
    """Returns node to world f64 (T,N,4,4) at `time` (T)."""
    local = np.stack([_local(file, index, clip, time) for index in range(len(parent))], axis=1)
    world = local.copy()
    for index in parents_first(parent):
        if parent[index] >= 0:
            world[:, index] = world[:, parent[index]] @ local[:, index]
    if not np.isfinite(world).all():
        bad = int(np.argmax(~np.isfinite(world).all((0, 2, 3))))
        raise file.fail(f"node {node_name(file, bad)!r} has a transform that is not finite; repair the model")
    return world


def node_visibility(file: Gltf, parent: np.ndarray, clip: Clip, time: np.ndarray) -> np.ndarray:
    """Returns bool (T,N): whether a node and all above it are visible at `time` (KHR_node_visibility)."""
    shown = np.ones((len(time), len(parent)), bool)
    for index in parents_first(parent):
        extension = file.item("nodes", index).get("extensions", {}).get("KHR_node_visibility", {})
        shown[:, index] = extension.get("visible", True)
        if (index, "visible") in clip.curves:
            shown[:, index] = clip.curves[index, "visible"].at(time)[:, 0] > 0.5
        if parent[index] >= 0:
            shown[:, index] &= shown[:, parent[index]]
    return shown


def _local(file: Gltf, index: int, clip: Clip, time: np.ndarray) -> np.ndarray:
    node = file.item("nodes", index)
    moving = [path for path in _REST if (index, path) in clip.curves]
    if "matrix" in node:
        if moving:
            raise file.fail(
                f"node {node_name(file, index)!r} is animated but stored as a matrix; export the file again"
            )
        matrix = _numbers(file, index, "matrix", 16).reshape(4, 4).T
        require_affine(file, matrix, f"matrix of node {node_name(file, index)!r}")
        return np.tile(matrix, (len(time), 1, 1))
    values = {}
    for path, rest in _REST.items():
        fixed = _numbers(file, index, path, len(rest)) if path in node else np.array(rest)
        values[path] = clip.curves[index, path].at(time) if path in moving else np.tile(fixed, (len(time), 1))
    return matrices(values["translation"], values["rotation"], values["scale"])


def require_affine(file: Gltf, matrices: np.ndarray, what: str) -> None:
    """Raises DataError unless (...,4,4) end in rows 0 0 0 1: whoever writes them row by row loses every shift."""
    rows = matrices.reshape(-1, 4, 4)[:, 3]
    wrong = np.abs(rows - (0, 0, 0, 1)).max(1) > _AFFINE
    if wrong.any():
        row = ", ".join(f"{value:g}" for value in rows[wrong][0])
        raise file.fail(f"{what} has the last row {row}; expected 0, 0, 0, 1 (is it transposed?)")


def _numbers(file: Gltf, index: int, key: str, count: int) -> np.ndarray:
    try:
        values = np.array(file.item("nodes", index)[key], np.float64)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise file.fail(f"{key} of node {node_name(file, index)!r} is not {count} finite numbers; repair the model")
    return values
