"""A street made of boxes: houses, trees, poles and parked cars that stand; cars, buses, cyclists and people that move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dpcli.prepare.articulated.procedural.solids import ball, box, cylinder, rod

_ROAD = 7.0  # meters between the curbs
_LENGTH = 120.0  # of the street, each way
_SWING = np.radians(25)  # of a walking leg


@dataclass
class Mover:
    """Holds a body: triangles f64 (T,3,3) with x ahead and z up, its legs (of swinging triangles), and its way.

    start (2): meters; heading, turn: radians and radians per second; speed: m/s.
    """

    triangles: np.ndarray
    start: np.ndarray
    heading: float
    speed: float
    turn: float = 0.0
    legs: int = 0  # of 12 triangles each, the last ones

    def pose(self, time: float) -> np.ndarray:
        """Returns where the body is, body to world f64 (4,4)."""
        return planar_pose(self.start, self.heading, self.speed, self.turn, time)

    def surface(self, time: float) -> np.ndarray:
        """Returns the triangles f64 (T,3,3) in the world; legs swing, once a meter and a half."""
        triangles = self.triangles.copy()
        for leg in range(self.legs):
            own = slice(len(triangles) - 12 * (leg + 1), len(triangles) - 12 * leg)
            angle = _SWING * np.sin(2 * np.pi * self.speed * time / 1.5 + np.pi * leg)
            c, s = np.cos(angle), np.sin(angle)
            hip = np.array([0, 0, 0.85])
            triangles[own] = (triangles[own] - hip) @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T + hip
        pose = self.pose(time)
        return triangles @ pose[:3, :3].T + pose[:3, 3]


def planar_pose(start: np.ndarray, heading: float, speed: float, turn: float, time: float) -> np.ndarray:
    """Returns the pose f64 (4,4) on a circle, or a line, after a time."""
    middle = heading + turn * time / 2
    way = speed * time * (np.sinc(turn * time / 2 / np.pi))
    pose, angle = np.eye(4), heading + turn * time
    pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    pose[:2, 3] = start + way * np.array([np.cos(middle), np.sin(middle)])
    return pose


def car(rng: np.random.Generator) -> np.ndarray:
    """Builds a car: a body, a cabin with slanting windows, four wheels."""
    length, width, height = rng.uniform(3.8, 4.8), rng.uniform(1.65, 1.9), rng.uniform(1.4, 1.8)
    waist, cut = 0.55 * height, rng.uniform(0.15, 0.25) * length
    cabin = box((0.62 * length, 0.92 * width, height - waist), (-0.08 * length, 0, (height + waist) / 2))
    top = cabin[..., 2] > height - 1e-6
    cabin[top, 0] -= np.sign(cabin[top, 0] + 0.08 * length) * cut / 2
    body = box((length, width, waist - 0.25), (0, 0, 0.25 + (waist - 0.25) / 2))
    wheels = [
        cylinder(0.32, 0.2, (x * length, y * width, 0.32), np.eye(3)[1]) for x in (-0.32, 0.32) for y in (-0.46, 0.46)
    ]
    return np.concatenate([body, cabin, *wheels])


def bus(rng: np.random.Generator) -> np.ndarray:
    """Builds a bus or a box truck."""
    length, height = rng.uniform(7, 12), rng.uniform(2.8, 3.3)
    wheels = [cylinder(0.5, 0.3, (x * length, y * 2.4, 0.5), np.eye(3)[1]) for x in (-0.3, 0.35) for y in (-0.46, 0.46)]
    return np.concatenate([box((length, 2.5, height - 0.4), (0, 0, 0.4 + (height - 0.4) / 2)), *wheels])


def person(rng: np.random.Generator) -> np.ndarray:
    """Builds a person: head, body, arms, and two legs, the last 24 triangles."""
    size = rng.uniform(0.9, 1.1)
    parts = [ball(0.12, (0, 0, 1.62)), box((0.25, 0.45, 0.65), (0, 0, 1.15))]
    parts += [rod(np.array([0, y, 1.4]), np.array([0.1, y, 0.85]), 0.05) for y in (-0.28, 0.28)]
    return size * np.concatenate([*parts, *(box((0.16, 0.16, 0.84), (0, y, 0.42)) for y in (-0.1, 0.1))])


def cyclist(rng: np.random.Generator) -> np.ndarray:
    """Builds a person on a bicycle."""
    wheels = [cylinder(0.34, 0.04, (x, 0, 0.34), np.eye(3)[1]) for x in (-0.5, 0.5)]
    frame = [rod(np.array([-0.5, 0, 0.34]), np.array([0.4, 0, 0.9]), 0.03)]
    rider = [box((0.3, 0.42, 0.6), (-0.05, 0, 1.2)), ball(0.12, (0.1, 0, 1.62)), box((0.2, 0.3, 0.6), (0, 0, 0.65))]
    return rng.uniform(0.95, 1.05) * np.concatenate([*wheels, *frame, *rider])


def _tree(at: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Builds a trunk and a crown of leaves, small triangles in a ball."""
    height, radius = rng.uniform(2, 4), rng.uniform(1.2, 2.5)
    leaves = rng.normal(size=(400, 1, 3))
    leaves *= radius * rng.uniform(0.4, 1, (400, 1, 1)) / np.linalg.norm(leaves, axis=2, keepdims=True)
    leaves = leaves + rng.normal(0, 0.12, (400, 3, 3)) + np.array([*at, height + 0.7 * radius])
    return np.concatenate([cylinder(rng.uniform(0.1, 0.25), height, (*at, height / 2)), leaves])


def _house_row(side: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Builds the houses of one side, with gaps, set back differently, some with a bay."""
    parts, x, back = [], -_LENGTH, _ROAD / 2 + rng.uniform(3, 9)
    while x < _LENGTH:
        length, height, deep = rng.uniform(8, 25), rng.uniform(4, 15), back + rng.uniform(0, 2)
        parts.append(box((length, 10, height), (x + length / 2, side * (deep + 5), height / 2)))
        parts += [
            box((0.3, 0.3, height), (x + length * share, side * deep, height / 2)) for share in rng.uniform(0, 1, 3)
        ]
        x += length + (rng.uniform(3, 15) if rng.uniform() < 0.4 else 0)
    return parts


def _standing_car(rng: np.random.Generator) -> np.ndarray:
    """Places a parked car at a curb."""
    at = [rng.uniform(-60, 60), rng.choice((-1, 1)) * (_ROAD / 2 - 1 + rng.uniform(0, 0.3)), 0]
    return car(rng) * [rng.choice((-1, 1)), 1, 1] + at


def standing_street(rng: np.random.Generator) -> np.ndarray:
    """Builds all that stands, triangles f64 (T,3,3): the street along x, its ground nearly at z = 0."""
    steps = np.linspace(-_LENGTH, _LENGTH, 25)
    slope, phase = rng.uniform(0, 0.4), rng.uniform(0, 6)
    ground = []
    for left, right in zip(steps[:-1], steps[1:]):
        z = slope * np.sin(np.array([left, right]) / 25 + phase) - slope * np.sin(phase)
        a, b, c, d = (left, -80, z[0]), (right, -80, z[1]), (right, 80, z[1]), (left, 80, z[0])
        ground += [[a, b, c], [a, c, d]]
    parts = [np.array(ground), *_house_row(-1, rng), *_house_row(1, rng)]
    walk = _ROAD / 2 + 2
    parts += [box((2 * _LENGTH, 3, 0.3), (0, side * (walk + 1), 0)) for side in (-1, 1)]  # pavements
    for _ in range(rng.integers(4, 14)):
        parts.append(_tree(np.array([rng.uniform(-50, 50), rng.choice((-1, 1)) * (walk + rng.uniform(0, 1))]), rng))
    for _ in range(rng.integers(3, 10)):
        at = (rng.uniform(-50, 50), rng.choice((-1, 1)) * (walk - 0.5), 2.5)
        parts.append(cylinder(rng.uniform(0.05, 0.15), 5, at))
    return np.concatenate([*parts, *(_standing_car(rng) for _ in range(rng.integers(2, 12)))])


def draw_movers(count: int, rng: np.random.Generator) -> list[Mover]:
    """Draws bodies that move and don't meet: in the lanes, on the pavements, across the road."""
    movers: list[Mover] = []
    for _ in range(20 * count):
        kind = rng.choice(("car", "bus", "person", "cyclist"), p=(0.45, 0.1, 0.3, 0.15))
        one = _draw_mover(str(kind), rng)
        gap = [np.linalg.norm(one.start - other.start) for other in movers]
        if np.linalg.norm(one.start) > 5 and min(gap, default=99) > 9:
            movers.append(one)
        if len(movers) == count:
            break
    return movers


def _draw_mover(kind: str, rng: np.random.Generator) -> Mover:
    """Draws one body with its place and speed."""
    way = int(rng.choice((-1, 1)))
    x, lane = rng.uniform(-35, 35), -way * _ROAD / 4
    heading = 0.0 if way > 0 else np.pi
    if kind == "person":
        side = rng.choice((-1, 1)) * (_ROAD / 2 + rng.uniform(0.8, 2.2))
        across = rng.uniform() < 0.3
        start = np.array([x, rng.uniform(-3, 3) if across else side])
        return Mover(person(rng), start, heading + (np.pi / 2 if across else 0), rng.uniform(0.9, 1.9), legs=2)
    start = np.array([x, lane * (rng.uniform(0.8, 1.1) if kind != "cyclist" else 1.5)])
    if kind == "cyclist":
        return Mover(cyclist(rng), start, heading, rng.uniform(2.5, 7))
    shape = car(rng) if kind == "car" else bus(rng)
    return Mover(shape, start, heading, rng.uniform(2, 15), rng.normal(0, 0.05))
