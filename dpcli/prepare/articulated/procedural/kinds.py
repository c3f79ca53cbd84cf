"""Kinds of procedural objects: furniture, appliances, tools.

Each takes a Builder and a generator; z is up, -y the front.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dpcli.prepare.articulated.procedural.machine_kinds import chain, robot, switch, vehicle
from dpcli.prepare.articulated.procedural.solids import (
    Builder,
    X,
    Y,
    Z,
    ball,
    box,
    cylinder,
    lathe,
    open_box,
    plate,
    ring,
    rod,
    turned,
)

Rng = np.random.Generator


def _leaf(
    b: Builder, rng: Rng, size: tuple[float, float], at: tuple[float, float, float], side: str, opening: float
) -> int:
    """Builds a door leaf of (width, height) in front of ``at`` (its center), hinged on ``side``: left, right, bottom or
    top.
    """
    w, h = size
    x, y, z = at
    t = rng.uniform(0.02, 0.05)
    sx, sz = {"left": (1, 0), "right": (-1, 0), "bottom": (0, 1), "top": (0, -1)}[side]
    axis, sign = (Z, -sx) if sx else (X, sz)
    middle = np.array([sx * w / 2, -t / 2, sz * h / 2])
    knob = middle + [sx * 0.4 * w, -t, sz * 0.4 * h]
    solids = [box((w * 0.98, t, h * 0.98), middle)]
    if rng.random() < 0.7:
        solids.append(_handle(rng, knob, upright=bool(sx)))
    hinge = (x - sx * w / 2, y, z - sz * h / 2)
    low, high = sorted((0.0, sign * opening))
    return b.hinge(hinge, axis, low, high, *solids)


def _handle(rng: Rng, at: np.ndarray, upright: bool) -> np.ndarray:
    if rng.random() < 0.4:
        return ball(rng.uniform(0.015, 0.03), at)
    half, reach = rng.uniform(0.04, 0.12), rng.uniform(0.02, 0.04)
    along = half * (Z if upright else X)
    return rod(at - along - reach * Y, at + along - reach * Y, 0.012)


def _drawer(b: Builder, rng: Rng, size: tuple[float, float, float], at: tuple[float, float, float]) -> int:
    """Builds a drawer of (width, depth, height) whose front stands at ``at``; it slides toward -y."""
    w, d, h = size
    front = box((w * 0.98, 0.03, h * 0.95), (0, -0.015, 0))
    tray = open_box((w * 0.9, d * 0.9, h * 0.7), 0.012, (0, d * 0.45, 0))
    return b.slide(at, -Y, 0.0, d * rng.uniform(0.5, 0.9), front, tray, _handle(rng, np.array([0, -0.03, 0]), False))


def _legs(b: Builder, rng: Rng, size: tuple[float, float], top: float, height: float) -> None:
    w, d = size
    thick, round_ = rng.uniform(0.02, 0.05), rng.random() < 0.5
    for x in (-1, 1):
        for y in (-1, 1):
            at = (x * (w / 2 - thick), y * (d / 2 - thick), top - height / 2)
            b.add(0, cylinder(thick / 2, height, at) if round_ else box((thick, thick, height), at))


def cabinet(b: Builder, rng: Rng) -> None:
    """Builds columns of doors and drawers."""
    w, d, h = rng.uniform((0.5, 0.3, 0.5), (1.2, 0.6, 1.4))
    b.add(0, open_box((w, d, h), 0.02, without="front"))
    columns = int(rng.integers(1, 4))
    for c in range(columns):
        cw, x = w / columns, -w / 2 + (c + 0.5) * w / columns
        cuts = np.sort(np.concatenate([[0, 1], rng.uniform(0.2, 0.8, rng.integers(0, 3))])) * h - h / 2
        for low, high in zip(cuts[:-1], cuts[1:]):
            tall, z = high - low, (low + high) / 2
            if tall < 0.1:
                continue
            if tall < 0.45 and rng.random() < 0.7:
                _drawer(b, rng, (cw, d, tall), (x, -d / 2, z))
            else:
                _leaf(b, rng, (cw, tall), (x, -d / 2, z), str(rng.choice(["left", "right"])), rng.uniform(80, 150))
    if rng.random() < 0.4:
        _legs(b, rng, (w, d), -h / 2, rng.uniform(0.05, 0.2))


def desk(b: Builder, rng: Rng) -> None:
    """Builds a table top on legs with drawers below."""
    w, d, h = rng.uniform((0.8, 0.4, 0.5), (1.6, 0.8, 0.8))
    b.add(0, box((w, d, 0.04), (0, 0, 0)))
    _legs(b, rng, (w, d), -0.02, h)
    drawers, height = int(rng.integers(1, 4)), rng.uniform(0.1, 0.2)
    for k in range(drawers):
        x = -w / 2 + (k + 0.5) * w / drawers
        _drawer(b, rng, (w / drawers * 0.85, d * 0.9, height), (x, -d / 2, -0.02 - height / 2))


def carton(b: Builder, rng: Rng) -> None:
    """Builds an open box with one to four flaps."""
    w, d, h = rng.uniform(0.3, 1.0, 3)
    b.add(0, open_box((w, d, h), 0.015))
    flaps = rng.permutation(4)[: rng.integers(1, 5)]
    for k in flaps:
        length, reach = ((w, d), (d, w))[k % 2]
        reach *= rng.uniform(0.35, 0.5) if len(flaps) > 1 else 0.95
        out = turned((-Y)[None], Z, 90 * k)[0]
        flap = turned(box((length * 0.98, reach, 0.012), (0, reach / 2, 0)), Z, 90 * k)
        at = out * (d if k % 2 == 0 else w) / 2 + [0, 0, h / 2]
        b.hinge(at, turned(X[None], Z, 90 * k)[0], 0, rng.uniform(150, 230), flap)


def chest(b: Builder, rng: Rng) -> None:
    """Builds a box with a lid hinged at the back, flat or vaulted."""
    w, d, h = rng.uniform((0.4, 0.3, 0.2), (1.0, 0.7, 0.6))
    b.add(0, open_box((w, d, h), 0.02))
    lid = box((w, d, 0.03), (0, -d / 2, 0.015))
    if rng.random() < 0.5:
        rise = rng.uniform(0.2, 0.6) * d
        arc = [(d / 2 * np.cos(a), rise * np.sin(a)) for a in np.linspace(0, np.pi, 12)]
        lid = turned(turned(plate(arc, w), X, 90), Z, 90) - [0, d / 2, 0]
    b.hinge((0, d / 2, h / 2), X, -rng.uniform(70, 120), 0, lid)


def appliance(b: Builder, rng: Rng) -> None:
    """Builds oven, microwave, dishwasher, refrigerator: a body with one to three doors and some knobs."""
    w, d, h = rng.uniform((0.4, 0.35, 0.3), (0.9, 0.8, 1.7))
    b.add(0, open_box((w, d, h), rng.uniform(0.02, 0.06), without="front"))
    doors = int(rng.integers(1, 4)) if h > 0.9 else 1
    side = str(rng.choice(["left", "right"])) if h > 0.9 else str(rng.choice(["left", "right", "bottom"]))
    cuts = np.sort(np.concatenate([[0, rng.uniform(0.75, 1.0)], rng.uniform(0.2, 0.7, doors - 1)]))
    for low, high in zip(cuts[:-1], cuts[1:]):
        _leaf(b, rng, (w, (high - low) * h), (0, -d / 2, (low + high - 1) / 2 * h), side, rng.uniform(70, 130))
    if cuts[-1] < 0.95:
        b.add(0, box((w, 0.04, (1 - cuts[-1]) * h), (0, -d / 2, cuts[-1] * h / 2)))
        knobs = int(rng.integers(0, 4))
        for x in np.linspace(-0.35, 0.35, max(knobs, 1))[:knobs] * w:
            knob = np.concatenate([cylinder(0.03, 0.03, axis=Y), box((0.012, 0.03, 0.05), (0, -0.015, 0))])
            b.hinge((x, -d / 2 - 0.03, (cuts[-1] + 1) / 2 * h - h / 2), Y, -130, 130, knob)
    if h > 0.9 and rng.random() < 0.4:
        _drawer(b, rng, (w * 0.9, d * 0.8, 0.15), (0, -d / 2, -h / 2 + 0.1))


def laptop(b: Builder, rng: Rng) -> None:
    """Builds two plates and a hinge; also a flip phone or a book."""
    w, d = rng.uniform(0.25, 0.5), rng.uniform(0.2, 0.4)
    t = rng.uniform(0.01, 0.04)
    b.add(0, box((w, d, t)))
    screen = box((w, d * rng.uniform(0.85, 1), t * rng.uniform(0.4, 1)), (0, -d / 2, t / 2))
    b.hinge((0, d / 2, t / 2), X, -rng.uniform(110, 180), 0, screen)


def _blade(rng: Rng, length: float, width: float, thick: float) -> np.ndarray:
    back, tip = rng.uniform(0.3, 0.5) * width, rng.uniform(0.7, 1.0)
    outline = [(0, -back), (length * tip, -back), (length, -back), (length * 0.6, back), (0, back)]
    return plate(outline, thick)


def scissors(b: Builder, rng: Rng) -> None:
    """Builds two blades with rings that cross at a pivot; pliers with rods instead."""
    length, width, grip = rng.uniform(0.3, 0.6), rng.uniform(0.05, 0.12), rng.uniform(0.25, 0.6)
    rings, thick = rng.random() < 0.6, rng.uniform(0.012, 0.05)
    halves = []
    for k, sign in enumerate((1, -1)):
        end = np.array([-grip, sign * rng.uniform(0.08, 0.15), 0])
        handle = ring(rng.uniform(0.06, 0.1), 0.02, end) if rings else rod(end * [1.3, 1.2, 1], end, 0.025)
        blade = _blade(rng, length, width, thick)
        blade = blade if sign > 0 else blade * [1, -1, 1]
        shift = np.array([0, 0, thick * (k - 0.5)])
        halves.append(np.concatenate([blade, rod(np.zeros(3), end, 0.02), handle]) + shift)
    b.add(0, halves[0])
    b.hinge((0, 0, 0), Z, -rng.uniform(5, 15), rng.uniform(40, 100), halves[1])


def knife(b: Builder, rng: Rng) -> None:
    """Builds a pocket knife with one to four blades, or a cutter whose blade slides."""
    length, width = rng.uniform(0.3, 0.6), rng.uniform(0.04, 0.09)
    thick = rng.uniform(0.03, 0.06)
    if rng.random() < 0.35:
        b.add(0, open_box((length, thick, width), 0.006, without="front"))
        blade = turned(_blade(rng, length * 0.9, width * 0.7, 0.008), X, 90)
        b.slide((-length / 2, 0, 0), X, 0.1 * length, length * rng.uniform(0.6, 0.9), blade)
        return
    b.add(
        0, box((length, width, thick * 0.3), (0, 0, -thick / 2)), box((length, width, thick * 0.3), (0, 0, thick / 2))
    )
    for k in range(int(rng.integers(1, 5))):
        end = 1 if k % 2 == 0 else -1
        blade = _blade(rng, length * rng.uniform(0.6, 0.95), width * 0.8, 0.008) * [-end, 1, 1]
        b.hinge((end * length * 0.45, 0, 0.01 * (k - 1.5)), Z * rng.choice([-1, 1]), 0, rng.uniform(120, 180), blade)


def lamp(b: Builder, rng: Rng) -> None:
    """Builds a desk lamp: a foot, one to three arms, a shade."""
    radius = rng.uniform(0.1, 0.2)
    b.add(0, cylinder(radius, 0.03))
    on, at = 0, np.array([0, 0, 0.015])
    if rng.random() < 0.5:
        on, at = b.hinge(at, Z, -150, 150, cylinder(radius * 0.6, 0.04, (0, 0, 0.02))), np.array([0, 0, 0.04])
    for _ in range(int(rng.integers(1, 4))):
        length = rng.uniform(0.2, 0.45)
        lean = turned(length * Z[None], X, rng.uniform(-45, 45))[0]
        on = b.hinge(
            at,
            X,
            -rng.uniform(20, 70),
            rng.uniform(20, 70),
            rod(np.zeros(3), lean, rng.uniform(0.01, 0.03)),
            ball(0.03),
            on=on,
        )
        at = lean
    wide, tall = rng.uniform(0.06, 0.16), rng.uniform(0.1, 0.2)
    shade = lathe([(0, 0), (0.03, 0), (wide, -tall)], axis=np.array([0, -rng.uniform(0, 1.5), 1]))
    b.hinge(at, X, -60, 60, shade, on=on)


def tap(b: Builder, rng: Rng) -> None:
    """Builds a tap: a column, a spout that swings, one or two levers."""
    h, reach, tube = rng.uniform(0.2, 0.5), rng.uniform(0.2, 0.45), rng.uniform(0.02, 0.04)
    b.add(0, cylinder(tube * 1.6, h, (0, 0, h / 2)), cylinder(tube * 3, 0.03))
    rise = rng.uniform(0, 0.2)
    spout = [rod((0, 0, 0), (0, -reach, rise), tube), rod((0, -reach, rise), (0, -reach, rise - 0.1), tube)]
    b.hinge((0, 0, h), Z, -rng.uniform(40, 100), rng.uniform(40, 100), *spout)
    if rng.random() < 0.5:
        lever = rod((0, 0, 0), (0, rng.uniform(0.1, 0.2), 0.05), tube * 0.6)
        b.hinge((0, 0, h + tube), X, 0, rng.uniform(30, 60), lever, ball(tube * 1.3))
        return
    for side in (-1, 1):
        cross = [rod(-0.09 * v, 0.09 * v, tube * 0.5) for v in (X, Y)]
        b.add(0, rod((0, 0, 0.05), (side * 0.2, 0, 0.05), tube), cylinder(tube, 0.1, (side * 0.2, 0, 0.08)))
        b.hinge((side * 0.2, 0, 0.14), Z * side, 0, 90, *cross)


def window(b: Builder, rng: Rng) -> None:
    """Builds a frame with one or two sashes that swing or slide."""
    w, h, bar = rng.uniform(0.6, 1.4), rng.uniform(0.5, 1.3), rng.uniform(0.03, 0.07)
    for x in (-1, 1):
        b.add(0, box((bar, bar, h + bar), (x * w / 2, 0, 0)), box((w + bar, bar, bar), (0, 0, x * h / 2)))
    if rng.random() < 0.4:
        vertical = rng.random() < 0.5
        size = (w, 0.02, h / 2) if vertical else (w / 2, 0.02, h)
        for k in (-1, 1):
            at = (0, k * 0.02, k * h / 4) if vertical else (k * w / 4, k * 0.02, 0)
            b.slide(at, -k * (Z if vertical else X), 0, 0.45 * (h if vertical else w), box(size))
        return
    if rng.random() < 0.5:
        _leaf(b, rng, (w, h), (0, 0, 0), str(rng.choice(["left", "right", "top", "bottom"])), rng.uniform(60, 130))
        return
    for x, side in ((-1, "left"), (1, "right")):
        _leaf(b, rng, (w / 2, h), (x * w / 4, 0, 0), side, rng.uniform(60, 130))


def cart(b: Builder, rng: Rng) -> None:
    """Builds a tray, fixed or tipping, on spoked wheels, with a handle that swings."""
    w, d, r = rng.uniform(0.3, 0.6), rng.uniform(0.5, 1.0), rng.uniform(0.08, 0.18)
    b.add(0, box((w, d, 0.05)))
    tray = open_box((w, d, rng.uniform(0.15, 0.4)), 0.02, (0, 0, 0.0))
    tray = tray - [0, -d / 2, tray[..., 2].min()]
    if rng.random() < 0.6:
        b.hinge((0, -d / 2, 0.03), X, 0, rng.uniform(30, 60), tray)
    else:
        b.add(0, tray - [0, d / 2, -0.025])
    handle = [rod((x * w / 2, 0, 0), (x * w / 2, 0, 0.5), 0.02) for x in (-1, 1)]
    b.hinge((0, d / 2, 0), X, -60, 30, *handle, rod((-w / 2, 0, 0.5), (w / 2, 0, 0.5), 0.02))
    spokes = int(rng.integers(2, 6))
    for y in (-1, 1):
        for x in (-1, 1):
            wheel = [ring(r * 0.85, r * 0.15, axis=X)]
            wheel += [turned(rod(np.zeros(3), r * 0.8 * Z, r * 0.1), X, 360 * k / spokes) for k in range(spokes)]
            b.hinge((x * (w / 2 + r * 0.2), y * d * 0.38, -r * 0.6), X, -180, 180, *wheel)


def bottle(b: Builder, rng: Rng) -> None:
    """Builds a bottle, jar or pot whose cap or lid lifts off along its axis."""
    r, h = rng.uniform(0.1, 0.3), rng.uniform(0.2, 0.8)
    neck, rise = r * rng.uniform(0.35, 1.0), rng.uniform(0.02, 0.3) * h
    b.add(
        0, lathe([(0, 0), (r, 0), (r * rng.uniform(0.8, 1.1), h / 2), (r, h), (neck, h + rise), (neck, h + 1.3 * rise)])
    )
    cap, top = neck * rng.uniform(1.02, 1.2), rng.uniform(0.1, 0.5) * neck + 0.02
    lid = [lathe([(cap, -top), (cap, 0), (cap * rng.uniform(0.2, 0.9), top * rng.uniform(0, 0.6)), (0, top * 0.6)])]
    if rng.random() < 0.4:
        lid.append(ball(0.2 * neck, (0, 0, 0.7 * top)))
    b.slide((0, 0, h + 1.3 * rise), Z, 0, rng.uniform(0.15, 0.5) * h, *lid)
    if rng.random() < 0.3:  # a bail handle
        b.hinge((0, 0, h * 0.9), X, -80, 80, turned(ring(r * 1.15, 0.015), X, 90))


def bin_(b: Builder, rng: Rng) -> None:
    """Builds a bin with a hinged lid, perhaps with a pedal."""
    r, h = rng.uniform(0.15, 0.3), rng.uniform(0.3, 0.8)
    b.add(0, lathe([(0, 0), (r * rng.uniform(0.7, 1), 0), (r, h)]))
    b.hinge((0, r, h), X, -rng.uniform(60, 110), 0, cylinder(r * 1.05, 0.03, (0, -r, 0.015)))
    if rng.random() < 0.5:
        b.hinge((0, -r * 0.7, 0.05), X, 0, 40, box((0.12, 0.2, 0.02), (0, -0.12, 0)))


def chair(b: Builder, rng: Rng) -> None:
    """Builds a swivel chair: the seat turns and rises, the back leans."""
    for k in range(5):
        foot = turned(0.27 * Y[None], Z, 72 * k)[0]
        b.add(0, rod((0, 0, 0.05), foot, 0.025))
    b.add(0, cylinder(0.04, 0.3, (0, 0, 0.15)))
    w, d, h = rng.uniform((0.35, 0.35, 0.3), (0.55, 0.55, 0.7))
    column = b.slide((0, 0, 0.3), Z, 0, rng.uniform(0.1, 0.25), cylinder(0.025, 0.3, (0, 0, -0.05)))
    seat = b.hinge((0, 0, 0.1), Z, -150, 150, box((w, d, 0.06)), on=column)
    b.hinge((0, d / 2, 0.03), X, -rng.uniform(20, 40), 15, box((w, 0.05, h), (0, 0, h / 2)), on=seat)
    if rng.random() < 0.5:
        for x in (-1, 1):
            rest = box((0.06, d * 0.7, 0.03), (0, -d * 0.3, 0))
            b.hinge((x * w / 2, d * 0.3, 0.25), X, -80, 10, rest, on=seat)


def fan(b: Builder, rng: Rng) -> None:
    """Builds a rotor of two to six blades on a stand that swings."""
    h, r = rng.uniform(0.3, 0.8), rng.uniform(0.2, 0.4)
    b.add(0, cylinder(rng.uniform(0.12, 0.2), 0.03), cylinder(0.025, h, (0, 0, h / 2)))
    head = b.hinge((0, 0, h), Z, -90, 90, cylinder(0.07, 0.2, (0, 0.05, 0), Y))
    blades, width = int(rng.integers(2, 7)), rng.uniform(0.05, 0.14)
    blade = turned(box((width, 0.012, r), (0, 0, r / 2)), Z, rng.uniform(10, 40))
    b.hinge(
        (0, -0.08, 0), Y, -180, 180, *[turned(blade, Y, 360 * k / blades) for k in range(blades)], ball(0.05), on=head
    )


def door(b: Builder, rng: Rng) -> None:
    """Builds a wall with a door and its latch, or a gate with two leaves."""
    w, h, t = rng.uniform(0.5, 0.9), rng.uniform(0.8, 1.6), rng.uniform(0.05, 0.15)
    post = rng.uniform(0.05, 0.4)
    for x in (-1, 1):
        b.add(0, box((post, t, h), (x * (w + post) / 2, 0, 0)))
    if rng.random() < 0.5:
        b.add(0, box((w + 2 * post, t, 0.1), (0, 0, h / 2 + 0.05)))
    if rng.random() < 0.5:
        leaf = _leaf(b, rng, (w, h), (0, -t / 2, 0), "left", rng.uniform(70, 150))
        lever = rod((0, 0, 0), (-rng.uniform(0.1, 0.2), 0, 0), 0.02)
        b.hinge((w * 0.9, -0.07, h / 2), Y, -60, 60, lever, ball(0.03), on=leaf)
        return
    for x, side in ((-1, "left"), (1, "right")):
        _leaf(b, rng, (w / 2, h), (x * w / 4, -t / 2, 0), side, rng.uniform(70, 150))


def arm(b: Builder, rng: Rng) -> None:
    """Builds a robot arm or excavator: a turning base, two to four links, a gripper of two fingers or a shovel."""
    b.add(0, box((*rng.uniform(0.25, 0.5, 2), 0.1)))
    on, at = b.hinge((0, 0, 0.05), Z, -150, 150, cylinder(0.12, 0.12, (0, 0, 0.06))), np.array([0, 0, 0.12])
    for _ in range(int(rng.integers(2, 4))):
        length, thick = rng.uniform(0.25, 0.5), rng.uniform(0.05, 0.1)
        lean = turned(np.array([[0, 0, length]]), X, rng.uniform(-60, 60))[0]
        link = rod(np.zeros(3), lean, thick / 2) if rng.random() < 0.5 else _beam(lean, thick)
        on, at = b.hinge(at, X, -rng.uniform(20, 70), rng.uniform(20, 70), link, on=on), lean
    if rng.random() < 0.5:
        for x in (-1, 1):
            b.slide(at + [x * 0.02, 0, 0], x * X, 0, 0.08, box((0.02, 0.05, 0.15), (0, 0, 0.08)), on=on)
        b.add(on, box((0.2, 0.06, 0.04), at))
    else:
        b.hinge(at, X, -60, 60, turned(open_box((0.25, 0.2, 0.15), 0.015), X, 90) + [0, 0, 0.1], on=on)


def _beam(to: np.ndarray, thick: float) -> np.ndarray:
    length = float(np.linalg.norm(to))
    angle = np.degrees(np.arctan2(-to[1], to[2]))
    return turned(box((thick, thick, length), (0, 0, length / 2)), X, angle)


def glasses(b: Builder, rng: Rng) -> None:
    """Builds spectacles whose temples fold."""
    r, gap, length = rng.uniform((0.1, 0.03, 0.45), (0.16, 0.06, 0.55))
    for x in (-1, 1):
        lens = ring(r, 0.012, (x * (r + gap), 0, 0), Y)
        b.add(0, lens, cylinder(r, 0.006, (x * (r + gap), 0, 0), Y))
        temple = rod((0, 0, 0), (0, length, 0), 0.015)
        hook = rod((0, length, 0), (0, length + 0.08, -0.08), 0.015)
        low, high = sorted((0, x * rng.uniform(80, 95)))
        b.hinge((x * (2 * r + gap), 0.01, 0), Z, low, high, temple, hook)
    b.add(0, rod((-gap, 0, 0), (gap, 0, 0), 0.012))


def clock(b: Builder, rng: Rng) -> None:
    """Builds a dial with two or three hands."""
    r = rng.uniform(0.3, 0.5)
    b.add(0, cylinder(r, 0.04, axis=Y) if rng.random() < 0.6 else box((2 * r, 0.04, 2 * r)))
    for k, part in enumerate((0.9, 0.6, 0.75)[: rng.integers(2, 4)]):
        hand = box((rng.uniform(0.02, 0.07), 0.012, r * part), (0, 0, r * part * 0.42))
        b.hinge((0, -0.04 - 0.02 * k, 0), Y, -180, 180, hand)


def stapler(b: Builder, rng: Rng) -> None:
    """Builds bars that open about a common end: a stapler, tongs, a nutcracker, a seesaw clamp."""
    length, width = rng.uniform(0.3, 0.6), rng.uniform(0.04, 0.12)
    bars, thick = int(rng.integers(2, 4)), rng.uniform(0.02, 0.06)
    b.add(0, box((length, width, thick), (length / 2, 0, 0)))
    for k in range(1, bars):
        bar = box((length * rng.uniform(0.7, 1), width * rng.uniform(0.5, 1), thick), (length / 2, 0, 0))
        b.hinge((0, 0, 1.2 * k * thick), Y, -rng.uniform(25, 110) * k / (bars - 1), 0, bar)


def assembly(b: Builder, rng: Rng) -> None:
    """Builds nothing in particular: two to seven random solids joined anyhow in a tree."""
    centers, sizes = [], []
    for k in range(int(rng.integers(2, 8))):
        size = rng.uniform(0.08, 0.6, 3)
        solid = _any_solid(rng, size)
        if k == 0:
            b.add(0, solid)
            centers.append(np.zeros(3))
            sizes.append(size)
            continue
        on = int(rng.integers(k))
        side, sign = rng.integers(3), rng.choice([-1, 1])
        away = np.where(np.arange(3) == side, sign, rng.uniform(-0.4, 0.4, 3))  # leaves the parent through this side
        outwards, shift = away * sizes[on] / 2, away * size / 2
        at, axis = centers[on] + outwards, np.eye(3)[rng.integers(3)] if rng.random() < 0.7 else rng.normal(size=3)
        if rng.random() < 0.65:
            b.hinge(at, axis, -rng.uniform(20, 120), rng.uniform(20, 120), solid + shift, on=on)
        else:
            b.slide(at, axis, 0, rng.uniform(0.1, 0.5), solid + shift, on=on)
        centers.append(shift)
        sizes.append(size)


def _any_solid(rng: Rng, size: np.ndarray) -> np.ndarray:
    """Builds a solid that fills a box of this size about the origin."""
    unit = [
        lambda: box((1, 1, 1)),
        lambda: cylinder(0.5, 1, axis=np.eye(3)[rng.integers(3)]),
        lambda: ball(0.5),
        lambda: lathe([(0.5, -0.5), (rng.uniform(0.05, 0.4), 0.5), (0, 0.5)]),
        lambda: open_box((1, 1, 1), 0.05),
        lambda: ring(0.35, 0.15, axis=np.eye(3)[rng.integers(3)]),
        lambda: lathe(list(zip(rng.uniform(0.1, 0.5, 5), np.linspace(-0.5, 0.5, 5)))),
        lambda: plate(
            [
                (rng.uniform(0.2, 0.5) * np.cos(a), rng.uniform(0.2, 0.5) * np.sin(a))
                for a in np.linspace(0, 2 * np.pi, 7)[:-1]
            ],
            1,
        ),
    ]
    return unit[rng.integers(len(unit))]() * size


KINDS: dict[str, Callable[[Builder, Rng], None]] = {
    function.__name__.strip("_"): function
    for function in (
        appliance,
        arm,
        assembly,
        bin_,
        bottle,
        cabinet,
        carton,
        cart,
        chain,
        chair,
        chest,
        clock,
        desk,
        door,
        fan,
        glasses,
        knife,
        lamp,
        laptop,
        robot,
        scissors,
        stapler,
        switch,
        tap,
        vehicle,
        window,
    )
}
