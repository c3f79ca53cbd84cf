"""Ground truth of models in which things appear, vanish or are never seen, against cubes whose places are known."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from dpcli.ops.cameras import DEFAULT_RADIUS
from dpcli.prepare.meshes.animation import load_animation
from dpcli.prepare.meshes.filming import OBJECT_RADIUS, Filming, film
from tests.support.gltf_files import GlbFile

CORNERS = np.array(np.meshgrid([-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5])).reshape(3, 8).T
SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
FACES = np.array([corner for a, b, c, d in SIDES for corner in (a, b, c, a, c, d)])
COLORS = np.array([(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0)])
TRACKS = 600


@dataclass(frozen=True)
class Cube:
    """One that rises by `speed` a frame. how: what hides it where `shown`, a bool for each frame, is False."""

    how: str
    speed: float
    shown: tuple[bool, ...]

    @property
    def seen(self) -> np.ndarray:
        """In which frames it can be seen, bool (T)."""
        return np.array(self.shown) & (self.how not in ("clear", "cut off", "flat"))


@st.composite
def scenes(draw) -> tuple[float, list[Cube]]:
    frames = draw(st.integers(2, 6))
    ways = st.sampled_from(["scale", "small", "visibility", "clear", "cut off", "flat"])
    patterns = st.tuples(*[st.booleans()] * frames)
    cubes = st.builds(Cube, ways, st.sampled_from([0, 0.5, -0.3]), patterns)
    others = draw(st.lists(cubes.filter(lambda cube: cube.how != "small" or any(cube.shown)), max_size=3))
    when = draw(st.integers(0, frames - 1))
    once = Cube("scale", 0.5, tuple(frame == when for frame in range(frames)))
    always = Cube("scale", 0.2, (True,) * frames)
    return draw(st.sampled_from([10, 12, 24, 25, 29.97, 30, 60])), [draw(st.sampled_from([once, always])), *others]


def model(rate: float, cubes: list[Cube]) -> GlbFile:
    """The cubes in a row along x, 2 apart, keys at k / rate."""
    file, frames = GlbFile(), len(cubes[0].shown)
    times, keys = np.arange(frames + 1) / rate, np.minimum(np.arange(frames + 1), frames - 1)
    file.tree |= {"nodes": [], "meshes": [], "materials": [], "scenes": [{"nodes": list(range(len(cubes)))}]}
    for k, cube in enumerate(cubes):
        alpha = {"clear": 0.0, "cut off": 0.2}.get(cube.how, 1.0)
        mode = {"clear": "BLEND", "cut off": "MASK"}.get(cube.how, "OPAQUE")
        color = {"baseColorFactor": [*map(float, COLORS[k]), alpha]}
        unlit = {"extensions": {"KHR_materials_unlit": {}}}
        file.tree["materials"].append({"pbrMetallicRoughness": color, "alphaMode": mode, "doubleSided": True, **unlit})
        faces = np.repeat(FACES[::3], 3) if cube.how == "flat" else FACES
        primitive = {"attributes": {"POSITION": file.add(CORNERS)}, "indices": file.add(faces, "u2"), "material": k}
        file.tree["meshes"].append({"primitives": [primitive]})
        file.tree["nodes"].append({"mesh": k})
        places = np.array([[2.0 * k, cube.speed * frame, 0] for frame in range(frames + 1)])
        file.animate(k, "translation", times, places)
        shown = np.array(cube.shown)[keys]
        if cube.how == "visibility":
            file.animate(k, "pointer", times, shown, "STEP")
            pointer = {"pointer": f"/nodes/{k}/extensions/KHR_node_visibility/visible"}
            target = {"path": "pointer", "extensions": {"KHR_animation_pointer": pointer}}
            file.tree["animations"][0]["channels"][-1]["target"] = target
        else:
            hidden = 1e-4 if cube.how == "small" else 0.0
            file.animate(k, "scale", times, np.where(shown[:, None], 1.0, hidden) * np.ones(3), "STEP")
    return file


def ball(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Center and radius of a nearly smallest ball around points (N,3)."""
    center = (points.min(0) + points.max(0)) / 2
    for step in range(2000):
        center = center + (points[np.linalg.norm(points - center, axis=1).argmax()] - center) / (step + 5)
    return center, float(np.linalg.norm(points - center, axis=1).max())


@settings(max_examples=15, deadline=None)
@given(scenes())
def test_tracks_and_parts_are_of_what_is_seen_in_some_frame(scene):
    rate, cubes = scene
    frames = len(cubes[0].shown)
    with TemporaryDirectory() as folder:
        mesh = load_animation(model(rate, cubes).write(Path(folder, "m.glb")), None, frames)
    filming = Filming(size=64, test_azimuths=(), tracks=TRACKS, samples=1, part_tolerance=0.001)
    clip = film(mesh, filming)
    seen = [k for k, cube in enumerate(cubes) if cube.seen.any()]
    places = np.array([[(2.0 * k, cube.speed * t, 0) for k, cube in enumerate(cubes)] for t in range(frames)])
    center, radius = ball(np.concatenate([places[cubes[k].seen, k] + corner for k in seen for corner in CORNERS]))
    scale = OBJECT_RADIUS / radius
    places = scale * (places - center)
    belongs = _cube_of_each_track(clip.track, cubes, places, scale)
    counts = np.bincount(belongs, minlength=len(cubes))
    assert (counts[seen] > TRACKS / len(seen) - 2).all() and counts.sum() == TRACKS
    parts = {}
    for k in seen:
        (parts[k],) = set(clip.part[belongs == k])
    assert not any(parts[a] == parts[b] for a in seen for b in seen if _move_apart(cubes[a], cubes[b]))
    for _, frame, picture in clip.pictures():
        colors = {tuple(color) for color in (picture[picture[..., 3] == 255][:, :3] // 255).tolist()}
        assert colors == {tuple(COLORS[k]) for k in seen if cubes[k].seen[frame]}


def _move_apart(a: Cube, b: Cube) -> bool:
    """Returns whether one is seen where the other isn't, or both are at two times and have other speeds."""
    return (a.seen != b.seen).any() or (a.seen.sum() > 1 and a.speed != b.speed)


def _cube_of_each_track(track: np.ndarray, cubes: list[Cube], places: np.ndarray, scale: float) -> np.ndarray:
    """The one cube i64 (M) on whose surface a track lies whenever it is seen, and where it rests on a point while hidden."""
    fits = np.zeros((len(cubes), track.shape[1]), bool)
    for k, cube in enumerate(cubes):
        if cube.seen.any():
            off = np.abs(track[cube.seen] - places[cube.seen, k][:, None]).max(-1) - 0.5 * scale
            fits[k] = (np.abs(off) < 0.01).all(0)
    assert (fits.sum(0) == 1).all()
    belongs = fits.argmax(0)
    for k, cube in enumerate(cubes):
        resting = track[~cube.seen][:, belongs == k]
        assert not resting.size or np.ptp(resting, axis=1).max() < 1e-3
    assert np.linalg.norm(track, axis=2).max() < OBJECT_RADIUS * 1.01 < DEFAULT_RADIUS
    return belongs
