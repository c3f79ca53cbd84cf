"""Made-up animals at rest: bones, the round shapes around them, and how big everything is.

They look along +z, y is up.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np


@dataclass(frozen=True)
class Bone:
    """Turns about ``pivot`` (3), carried by ``parent`` (index, -1: the root)."""

    name: str
    parent: int
    pivot: np.ndarray


@dataclass(frozen=True)
class Shape:
    """Holds a cone with round ends on a bone, from a (radius ra) to b (radius rb); flat < 1 squeezes it along
    ``normal``.

    paint: which of the animal's colors it has: coat, dark, fin, horn.
    """

    bone: int
    a: np.ndarray
    b: np.ndarray
    ra: float
    rb: float
    paint: str = "coat"
    flat: float = 1.0
    normal: tuple[float, float, float] = (0.0, 1.0, 0.0)


@dataclass
class Creature:
    """Holds bones, parents before children; shapes; eyes: (bone, center of the head, direction, radius), on the
    surface.
    """

    kind: str
    bones: list[Bone] = field(default_factory=list)
    shapes: list[Shape] = field(default_factory=list)
    eyes: list[tuple[int, np.ndarray, np.ndarray, float]] = field(default_factory=list)
    leg: float = 0.5  # length, hip to ground

    def bone(self, name: str, parent: str, pivot: object) -> int:
        """Adds a bone and returns its index."""
        self.bones.append(Bone(name, self.index(parent) if parent else -1, np.asarray(pivot, float)))
        return len(self.bones) - 1

    def shape(self, bone: int, a: object, b: object, ra: float, rb: float, paint: str = "coat", **more: object) -> None:
        """Adds a shape to a bone."""
        self.shapes.append(Shape(bone, np.asarray(a, float), np.asarray(b, float), ra, rb, paint, **more))  # type: ignore[arg-type]

    def index(self, name: str) -> int:
        """Returns the index of the bone of this name."""
        return [bone.name for bone in self.bones].index(name)

    def limb(
        self, name: str, parent: str, points: list, radii: list[float], paint: str = "coat", **more: object
    ) -> None:
        """Adds a chain of bones name_0, name_1, ... through the points, radii at each."""
        for k in range(len(points) - 1):
            index = self.bone(f"{name}_{k}", parent if k == 0 else f"{name}_{k - 1}", points[k])
            self.shape(index, points[k], points[k + 1], radii[k], radii[k + 1], paint, **more)

    def add_eyes(self, center: np.ndarray, direction: tuple[float, float, float], radius: float) -> None:
        """Adds two eyes to the bone ``head``, mirrored at its middle."""
        for side in (-1, 1):
            self.eyes.append((self.index("head"), center, np.array(direction) * [side, 1, 1], radius))


def quadruped(rng: np.random.Generator) -> Creature:
    """Draws a dog- to horse-like animal, about 1 from rump to chest; head, ears, tail, four legs with knees and feet."""
    u = rng.uniform
    leg, girth, neck, rise = u(0.42, 0.62), u(0.13, 0.18), u(0.14, 0.3), u(0.5, 1.1)
    animal = Creature("quadruped", leg=leg)
    height = leg + 0.55 * girth
    hips, chest = np.array([0, height, -0.3]), np.array([0, height + 0.02, 0.02])
    animal.bone("hips", "", hips)
    animal.shape(0, hips, chest, 0.92 * girth, 0.96 * girth)
    animal.shape(animal.bone("chest", "hips", chest), chest, chest + [0, 0.0, 0.28], 0.96 * girth, 1.08 * girth)
    start = chest + [0, 0.4 * girth, 0.32]
    crown = start + neck * np.array([0, np.sin(rise), np.cos(rise)])
    animal.limb("neck", "chest", [start, crown], [0.72 * girth, u(0.42, 0.55) * girth])
    _head(animal, crown, girth, rng)
    dock = hips + [0, 0.55 * girth, -0.75 * girth]
    length, droop, thick = u(0.3, 0.5), u(-0.6, 0.5), u(0.025, 0.06)
    chain = [dock + k / 3 * length * np.array([0, np.sin(droop), -np.cos(droop)]) for k in range(4)]
    animal.limb("tail", "hips", chain, [thick, 1.1 * thick, thick, 0.6 * thick], "coat")
    for end, parent, z in (("front", "chest", chest[2] + 0.24), ("hind", "hips", hips[2] + 0.02)):
        for side, sign in (("left", 1), ("right", -1)):
            _leg(animal, f"{end}_{side}", parent, np.array([0.62 * sign * girth, height - 0.35 * girth, z]), girth, end)
    return animal


def _head(animal: Creature, crown: np.ndarray, girth: float, rng: np.random.Generator) -> None:
    u = rng.uniform
    size, snout = u(0.6, 0.75) * girth, u(0.1, 0.2)
    head = animal.bone("head", "neck_0", crown)
    middle = crown + [0, 0.25 * size, 0.5 * size]
    animal.shape(head, crown, middle, 0.95 * size, size)
    tip = middle + [0, -0.4 * size, 0.75 * size + snout]
    animal.shape(head, middle - [0, 0.15 * size, 0], tip, 0.72 * size, 0.42 * size)
    animal.shape(
        head, tip + [0, 0.12 * size, 0.3 * size], tip + [0, 0.14 * size, 0.32 * size], 0.17 * size, 0.17 * size, "dark"
    )
    animal.add_eyes(middle, (0.72, 0.42, 0.62), 0.17 * size)
    ear, out, width = u(0.9, 1.9) * size, u(0.15, 0.6), u(0.3, 0.45) * size
    for side, sign in (("left", 1), ("right", -1)):
        root = middle + size * np.array([0.55 * sign, 0.72, -0.25])
        tip = root + ear * np.array([sign * np.sin(out), np.cos(out), -0.1])
        index = animal.bone(f"ear_{side}", "head", root)
        animal.shape(index, root, tip, width, 0.35 * width, flat=0.45, normal=(0.0, 0.1, 1.0))


def _leg(animal: Creature, name: str, parent: str, top: np.ndarray, girth: float, end: str) -> None:
    """Adds thigh, shin and foot, down to the ground at y = 0."""
    thick, bend = girth * (0.42 if end == "hind" else 0.36), 0.05 if end == "hind" else -0.02
    knee = np.array([top[0], 0.52 * top[1], top[2] + bend])
    ankle = np.array([top[0], 0.13 * top[1], top[2] - 0.6 * bend])
    sole = np.array([top[0], 0.22 * thick, ankle[2] + 0.05])
    animal.limb(name, parent, [top, knee, ankle, sole], [1.25 * thick, 0.68 * thick, 0.42 * thick, 0.45 * thick])
    animal.shapes[-1] = replace(animal.shapes[-1], paint="dark")


def bird(rng: np.random.Generator) -> Creature:
    """Draws a bird in flight, span about 1.6; wings of an inner and an outer part."""
    u = rng.uniform
    animal, girth, span, chord = Creature("bird"), u(0.1, 0.15), u(0.62, 0.85), u(0.13, 0.2)
    animal.bone("body", "", (0, 0, 0))
    animal.shape(0, (0, 0, -0.2), (0, 0.02, 0.14), 0.6 * girth, girth)
    nape = np.array([0, 0.05, 0.2])
    crown = nape + u(0.08, 0.2) * np.array([0, 0.55, 0.8])
    animal.limb("neck", "body", [nape, crown], [0.7 * girth, 0.5 * girth])
    head = animal.bone("head", "neck_0", crown)
    animal.shape(head, crown, crown + [0, 0.01, 0.04], 0.66 * girth, 0.6 * girth)
    animal.shape(
        head, crown + [0, 0, 0.06], crown + [0, -0.02, 0.07 + u(0.07, 0.16)], 0.3 * girth, 0.07 * girth, "horn"
    )
    animal.add_eyes(crown + [0, 0.01, 0.03], (0.8, 0.35, 0.4), 0.14 * girth)
    animal.limb("tail", "body", [(0, 0, -0.26), (0, 0.01, -0.26 - u(0.15, 0.3))], [0.07, 0.13], "fin", flat=0.16)
    for side, sign in (("left", 1), ("right", -1)):
        points = [np.array([sign * x * span, 0.04, z]) for x, z in ((0.08, 0.05), (0.5, 0.06), (1.0, -0.08))]
        animal.limb(f"wing_{side}", "body", points, [chord, 0.95 * chord, 0.3 * chord], "fin", flat=0.13)
        hip = np.array([sign * 0.45 * girth, -0.75 * girth, -0.1])
        animal.limb(f"leg_{side}", "body", [hip, hip + [0, -0.06, -0.12]], [0.03, 0.022], "horn")
    return animal


def fish(rng: np.random.Generator) -> Creature:
    """Draws a fish about 1 long: a head, three body segments, tail, back and breast fins."""
    u = rng.uniform
    animal, deep, slim = Creature("fish"), u(0.14, 0.24), u(0.5, 0.75)
    z = [0.36, 0.18, -0.02, -0.2, -0.38]
    radius = [0.62 * deep, deep, 0.95 * deep, 0.55 * deep, 0.22 * deep]
    side = {"flat": slim, "normal": (1.0, 0.0, 0.0)}
    thin = {"flat": 0.16, "normal": (1.0, 0.0, 0.0)}
    for k, name in enumerate(("head", "front", "middle", "rear")):
        index = animal.bone(name, ("", "head", "front", "middle")[k], (0, 0, z[k] if k else z[1]))
        animal.shape(index, (0, 0, z[k]), (0, 0, z[k + 1]), radius[k], radius[k + 1], **side)
    tail, fork = animal.bone("tail", "rear", (0, 0, z[4])), u(0.1, 0.2)
    for sign in (-1, 1):
        animal.shape(tail, (0, 0, z[4]), (0, sign * fork, z[4] - u(0.14, 0.22)), 0.05, 0.06, "fin", **thin)
    back = animal.bone("back_fin", "front", (0, 0.9 * deep, 0.05))
    animal.shape(back, (0, 0.9 * deep, 0.1), (0, (1 + u(0.15, 0.5)) * deep, -0.1), 0.06, 0.07, "fin", **thin)
    for name, sign in (("left", 1), ("right", -1)):
        root = np.array([sign * 0.85 * slim * deep, -0.25 * deep, 0.16])
        index = animal.bone(f"fin_{name}", "front", root)
        tip = root + np.array([sign * 0.12, -0.05, -0.12])
        animal.shape(index, root, tip, 0.035, 0.06, "fin", flat=0.28, normal=(0.0, 0.92, -0.38))
    animal.add_eyes(np.array([0, 0.12 * deep, z[0] - 0.03]), (1.0, 0.25, 0.25), 0.17 * deep)
    return animal
