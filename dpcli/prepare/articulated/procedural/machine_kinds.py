"""Kinds of procedural objects that turn, roll or walk: switches, chains, vehicles, robots.

Each takes a Builder and a generator; z is up, -y the front.
"""

from __future__ import annotations

import numpy as np

from dpcli.prepare.articulated.procedural.solids import Builder, X, Y, Z, ball, box, cylinder, ring, rod, turned

Rng = np.random.Generator


def switch(b: Builder, rng: Rng) -> None:
    """Builds a wall plate or a panel with one to four rockers, levers, dials and faders."""
    count = int(rng.integers(1, 5))
    pitch, height, thick = rng.uniform((0.15, 0.25, 0.02), (0.35, 0.6, 0.08))
    b.add(0, box((count * pitch, thick, height)))
    for k in range(count):
        at = np.array([(k - (count - 1) / 2) * pitch, -thick / 2, 0.0])
        _control(b, rng, at, pitch, height)


def _control(b: Builder, rng: Rng, at: np.ndarray, pitch: float, height: float) -> None:
    """Builds a rocker, a lever, a dial or a fader in front of ``at``."""
    wide, tall = pitch * rng.uniform(0.5, 0.8), height * rng.uniform(0.4, 0.8)
    kind = rng.integers(4)
    if kind == 0:
        swing = rng.uniform(8, 20)
        b.hinge(at, X, -swing, swing, box((wide, 0.03, tall), (0, -0.015, 0)))
    elif kind == 1:
        reach = rng.uniform(0.08, 0.2)
        b.hinge(at, X, -40, 40, rod((0, 0, 0), (0, -reach, 0), 0.2 * wide), ball(0.3 * wide, (0, -reach, 0)))
    elif kind == 2:
        pointer = box((0.25 * wide, 0.05, 0.5 * wide), (0, -0.06, 0.3 * wide))
        b.hinge(at, Y, -140, 140, cylinder(wide / 2, 0.06, (0, -0.03, 0), Y), pointer)
    else:
        b.add(0, box((0.15 * wide, 0.02, tall), at))
        b.slide(at, Z, -0.4 * tall, 0.4 * tall, box((wide, 0.06, 0.25 * wide), (0, -0.03, 0)))


def chain(b: Builder, rng: Rng) -> None:
    """Builds three to seven links in a row: of rings whose joints alternate, or of plates that all turn one way."""
    length, width, thick = rng.uniform((0.2, 0.08, 0.02), (0.35, 0.2, 0.05))
    rings = rng.random() < 0.5
    on, at = 0, np.zeros(3)
    for k in range(int(rng.integers(3, 8))):
        flat = Y if k % 2 == 0 or not rings else Z
        link = _ring_link(length, width, thick, flat) if rings else box((length, width, thick), (length / 2, 0, 0))
        if k == 0:
            b.add(0, link)
        else:
            swing = rng.uniform(30, 80)
            on = b.hinge(at, flat, -swing, swing, link, on=on)
        at = np.array([length * (0.9 if rings else 1.0), 0.0, 0.0])


def _ring_link(length: float, width: float, thick: float, flat: np.ndarray) -> np.ndarray:
    """Returns an oval ring along x, in the plane across ``flat``."""
    half, side = width / 2, np.cross(flat, X)
    ends = [ring(half, thick / 2, (x, 0, 0), flat) for x in (half, length - half)]
    bars = [rod(half * X + s * half * side, (length - half) * X + s * half * side, thick / 2) for s in (-1, 1)]
    return np.concatenate([*ends, *bars])


def vehicle(b: Builder, rng: Rng) -> None:
    """Builds a body on two to six spoked wheels, in one row where it is narrow, with a cabin or a load that tips."""
    length, width, height = rng.uniform((0.8, 0.1, 0.1), (1.4, 0.6, 0.3))
    radius = rng.uniform(0.12, 0.25)
    b.add(0, box((length, width, height), (0, 0, radius + height / 2)))
    for x in np.linspace(-0.38, 0.38, int(rng.integers(2, 4))) * length:
        for side in (-1, 1) if width > 0.25 else (0,):
            b.hinge((x, side * (width / 2 + 0.04), radius), Y, -180, 180, *_wheel(rng, radius))
    top = radius + height
    if rng.random() < 0.5:
        load = box((0.5 * length, 0.9 * width, rng.uniform(0.1, 0.3)), (0.25 * length, 0, 0.08))
        b.hinge((-0.4 * length, 0, top), Y, -rng.uniform(25, 60), 0, load)
    else:
        b.add(0, box((0.45 * length, 0.8 * width, 0.25), (0, 0, top + 0.12)))


def _wheel(rng: Rng, radius: float) -> list[np.ndarray]:
    """Returns the solids of a wheel about y: a tire, a hub and three to six spokes."""
    solids = [ring(0.85 * radius, 0.15 * radius, axis=Y), cylinder(0.2 * radius, 0.05, axis=Y)]
    spokes = int(rng.integers(3, 7))
    for k in range(spokes):
        to = turned(np.array([[0, 0, 0.85 * radius]]), Y, 360 * k / spokes)[0]
        solids.append(rod(np.zeros(3), to, 0.07 * radius))
    return solids


def robot(b: Builder, rng: Rng) -> None:
    """Builds a trunk with a head that turns, two arms of one or two links, and two legs or a foot."""
    w, d, h = rng.uniform((0.25, 0.15, 0.35), (0.45, 0.3, 0.6))
    b.add(0, box((w, d, h)))
    size = rng.uniform(0.12, 0.22)
    b.hinge(
        (0, 0, h / 2),
        Z,
        -80,
        80,
        box((size, size, size), (0, 0, size / 2)),
        box((0.3 * size, size, 0.1), (0, -size / 2, size / 2)),
    )
    elbows = rng.random() < 0.5
    for x in (-1, 1):
        _limb(b, rng, (x * (w / 2 + 0.05), 0, 0.4 * h), rng.uniform(0.25, 0.45), 2 if elbows else 1, 100)
    if rng.random() < 0.6:
        for x in (-1, 1):
            _limb(b, rng, (x * 0.3 * w, 0, -h / 2), rng.uniform(0.4, 0.6), 1, 45)
    else:
        b.add(0, cylinder(0.06, 0.2, (0, 0, -h / 2 - 0.1)), cylinder(0.25, 0.04, (0, 0, -h / 2 - 0.2)))


def _limb(b: Builder, rng: Rng, at: tuple[float, float, float], length: float, links: int, swing: float) -> None:
    """Builds a limb that hangs from ``at`` and swings forward and back, with a hinge between its links."""
    thick, on = rng.uniform(0.06, 0.1), 0
    for k in range(links):
        link = box((thick, thick, length / links), (0, 0, -length / links / 2))
        low, high = (-0.3 * swing, swing) if k == 0 else (0, 100)
        on = b.hinge(at, X, -high, -low, link, ball(0.6 * thick, (0, 0, -length / links)), on=on)
        at = (0, 0, -length / links)
