"""Creatures of any body plan at rest: legs in no to four pairs, necks, tails, arms, wings and fins of any proportion.

Where `creature` draws animals that look right, these teach a shape network how much bodies differ.
"""

from __future__ import annotations

import numpy as np

from dpcli.prepare.synthetic.creature import Creature
from dpcli.prepare.synthetic.gait import Turns, X, Y, Z

_PAIRS = (0, 1, 2, 2, 2, 2, 3, 4)  # pairs of legs, as often as they stand here
_ROUND = (
    0.15  # share of figures whose trunk and head are one: what is round from the front need not be a long body's end
)


def wild_creature(rng: np.random.Generator) -> Creature:
    """Draws a creature of random plan, about 1 long or high; it looks along +z, y is up, the ground is near y = 0."""
    if rng.random() < _ROUND:
        return _round_figure(rng)
    upright = rng.random() < 0.2
    pairs = 1 if upright else int(rng.choice(_PAIRS))
    animal = Creature("wild", leg=_length(pairs, upright, rng))
    spine, girth = _body(animal, upright, rng)
    _neck_and_head(animal, spine[-1], girth[-1], upright, rng)
    if rng.random() < (0.3 if upright else 0.85):
        _tail(animal, spine[0], girth[0], rng)
    for pair in range(pairs):
        _pair_of_legs(animal, spine, girth, pair, pairs, upright, rng)
    arms = upright or (pairs == 1 and rng.random() < 0.6)
    if arms:
        _pair_of_arms(animal, spine, girth, upright, rng)
    if rng.random() < (0.6 if pairs == 0 else 0.1):
        _wings(animal, spine, girth, rng)
    if rng.random() < (0.7 if pairs == 0 else 0.1):
        _fin(animal, spine, girth, rng)
    return animal


def _round_figure(rng: np.random.Generator) -> Creature:
    """Draws an upright figure of one piece, from balls to pillars, on short legs or none; toys and mascots are built so."""
    u = rng.uniform
    girth = u(0.2, 0.45)
    animal = Creature("wild", leg=u(0.02, 0.25))
    foot = np.array([0, animal.leg + 0.9 * girth, 0])
    spine = foot + np.linspace(0, 1, 4)[:, None] * np.array([0, u(0.0, 2.5) * girth, u(-0.1, 0.1)])
    girths = girth * np.interp(np.linspace(0, 1, 4), [0, 0.5, 1], [1, u(0.8, 1.15), u(0.5, 1.1)])
    for k in range(3):
        bone = animal.bone(f"spine_{k}", "" if k == 0 else f"spine_{k - 1}", spine[k])
        animal.shape(bone, spine[k], spine[k + 1], girths[k], girths[k + 1])
    head = animal.bone("head", "spine_2", spine[3])
    animal.shape(head, spine[3], spine[3] + [0, 0.02, 0], girths[3], girths[3])
    animal.add_eyes(spine[3], (u(0.2, 0.5), u(-0.1, 0.4), 0.85), u(0.08, 0.35) * girths[3])
    if rng.random() < 0.4:
        tip = spine[3] + girths[3] * np.array([0, u(-0.4, 0.1), u(1.1, 1.5)])
        animal.shape(head, spine[3], tip, u(0.1, 0.3) * girths[3], u(0.05, 0.2) * girths[3], "horn")
    if animal.leg > 0.08:
        _pair_of_legs(animal, spine, girths, 0, 1, True, rng)
    if rng.random() < 0.8:
        _pair_of_arms(animal, np.repeat(spine[[1]], 4, axis=0), girths, True, rng)
    if rng.random() < 0.2:
        _tail(animal, spine[0], girths[0], rng)
    return animal


def wild_turns(animal: Creature, frames: int, rng: np.random.Generator) -> Turns:
    """Draws poses that have nothing to do with each other: turns of all bones over `frames` frames."""
    turns: Turns = {}
    for bone in animal.bones:
        limb = bone.name.startswith(("leg", "arm", "wing"))
        size = 0.3 if limb else 0.12
        turns[bone.name] = [
            (X, size * rng.normal(size=frames)),
            (Y, 0.5 * size * rng.normal(size=frames)),
            (Z, (0.25 if limb and not bone.name.startswith("wing") else 0.5) * size * rng.normal(size=frames)),
        ]
    return turns


def _length(pairs: int, upright: bool, rng: np.random.Generator) -> float:
    """Draws the length of the legs, hip to ground."""
    if pairs == 0:
        return 0.3
    low, high = (0.3, 0.6) if upright else (0.4, 0.8) if pairs == 1 else (0.15, 0.75)
    return float(rng.uniform(low, high))


def _body(animal: Creature, upright: bool, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Adds the trunk; returns the joints of the spine (4,3), rump first, and the girth at each (4)."""
    u = rng.uniform
    length = u(0.3, 0.55) if upright else u(0.3, 0.8)
    rise = u(1.2, 1.65) if upright else rng.normal(0, 0.15) if rng.random() < 0.8 else u(0.2, 0.9)
    way, arch = np.array([0, np.sin(rise), np.cos(rise)]), u(-0.06, 0.1)
    along = np.linspace(0, 1, 4)
    start = np.array([0, animal.leg, -0.4 * length * np.cos(rise)])
    spine = start + along[:, None] * length * way + np.outer(np.sin(np.pi * along) * arch, [0, np.cos(rise), 0])
    girth = u(0.08, 0.24) * np.clip(1 + 0.25 * rng.normal(size=4), 0.5, 1.5)
    flat = u(0.55, 1.0) if rng.random() < 0.5 else 1.0
    normal = (1.0, 0.0, 0.0) if rng.random() < 0.5 else (0.0, 1.0, 0.0)
    for k in range(3):
        bone = animal.bone(f"spine_{k}", "" if k == 0 else f"spine_{k - 1}", spine[k])
        animal.shape(bone, spine[k], spine[k + 1], girth[k], girth[k + 1], flat=flat, normal=normal)
    return spine, girth


def _neck_and_head(animal: Creature, start: np.ndarray, girth: float, upright: bool, rng: np.random.Generator) -> None:
    u = rng.uniform
    length = u(0.02, 0.12) if upright or rng.random() < 0.3 else u(0.05, 0.6)
    rise = u(1.0, 1.6) if upright else u(-0.5, 1.4)
    crown = start + (0.6 * girth + length) * np.array([0, np.sin(rise), np.cos(rise)])
    size = u(0.5, 1.3) * girth if rng.random() < 0.8 else u(0.08, 0.22)
    animal.limb("neck", "spine_2", [start, crown], [u(0.5, 0.9) * girth, u(0.4, 0.9) * min(girth, size)])
    head = animal.bone("head", "neck_0", crown)
    middle = crown + size * np.array([0, 0.3 if upright else 0.1, 0.3])
    animal.shape(head, crown, middle, 0.9 * size, size)
    if rng.random() < 0.8:
        droop, snout = u(-0.6, 0.2), u(0.2, 2.2) * size
        tip = middle + snout * np.array([0, np.sin(droop), np.cos(droop)])
        paint = "horn" if rng.random() < 0.2 else "coat"
        animal.shape(head, middle, tip, 0.7 * size, u(0.1, 0.6) * size, paint)
    animal.add_eyes(middle, (0.75, 0.4, 0.6), u(0.08, 0.25) * size)
    if rng.random() < 0.7:
        paint = "horn" if rng.random() < 0.4 else "coat"
        long, out, back = u(0.4, 2.2) * size, u(0, 1.3), u(-0.8, 0.5)
        thick, flat = u(0.12, 0.45) * size, u(0.4, 1.0)
        for side, sign in (("left", 1), ("right", -1)):
            root = middle + size * np.array([0.5 * sign, 0.65, -0.1])
            tip = root + long * np.array([sign * np.sin(out), np.cos(out), back])
            animal.limb(f"ear_{side}", "head", [root, tip], [thick, 0.3 * thick], paint, flat=flat, normal=(0.0, 0, 1))


def _tail(animal: Creature, start: np.ndarray, girth: float, rng: np.random.Generator) -> None:
    u = rng.uniform
    long, droop, bend = u(0.1, 0.9), u(-0.9, 0.7), u(-0.4, 0.4)
    thick = u(0.3, 0.9) * girth if rng.random() < 0.4 else u(0.02, 0.08)
    points = [start + np.array([0, 0.2 * girth, -0.5 * girth])]
    for k in range(3):
        angle = droop + k * bend
        points.append(points[-1] + long / 3 * np.array([0, np.sin(angle), -np.cos(angle)]))
    end = u(0.2, 1.2) * thick if thick < 0.08 else 0.15 * thick
    animal.limb("tail", "spine_0", points, [thick, 0.8 * thick + 0.2 * end, 0.4 * thick + 0.6 * end, end])


def _pair_of_legs(
    animal: Creature,
    spine: np.ndarray,
    girth: np.ndarray,
    pair: int,
    pairs: int,
    upright: bool,
    rng: np.random.Generator,
) -> None:
    """Adds two legs of thigh, shin and foot at their place along the spine: straight below it or sprawled."""
    u = rng.uniform
    share = (0.05 if upright else u(0.1, 0.5)) if pairs == 1 else pair / (pairs - 1)
    place = share * 2.99
    k = int(place)
    hip = spine[k] + (place - k) * (spine[k + 1] - spine[k])
    wide = girth[k] * u(0.5, 0.9)
    sprawl = u(0.3, 0.9) * animal.leg if pairs > 2 or rng.random() < 0.1 else u(-0.05, 0.1)
    thick = u(0.2, 0.5) * girth[k] if pairs <= 2 else u(0.12, 0.3) * girth[k]
    bend, ahead, foot = u(-0.12, 0.12), u(-0.08, 0.08), u(0.0, 0.14)
    lift = u(0.0, 0.5) * animal.leg if sprawl > 0.2 else 0.0
    turn = (share - 0.5) * u(0.5, 1.5) if pairs > 2 else 0.0  # outer pairs reach forward and back
    for side, sign in (("left", 1), ("right", -1)):
        top = hip + [sign * wide, -0.3 * girth[k], 0]
        out = sprawl * np.array([sign * np.cos(turn), 0, np.sin(turn)])
        knee = top + 0.5 * out + [0, lift - 0.48 * top[1] * (lift == 0), bend]
        ankle = np.array([*(top + out)[[0]], 0.12 * animal.leg, (top + out)[2] + ahead])
        sole = ankle + [0, -0.1 * animal.leg, foot]
        name = f"leg_{pair}_{side}"
        animal.limb(
            name, f"spine_{min(k, 2)}", [top, knee, ankle, sole], [1.2 * thick, 0.8 * thick, 0.5 * thick, 0.5 * thick]
        )


def _pair_of_arms(
    animal: Creature, spine: np.ndarray, girth: np.ndarray, upright: bool, rng: np.random.Generator
) -> None:
    u = rng.uniform
    long, thick = (u(0.25, 0.5) if upright else u(0.08, 0.3)), u(0.15, 0.4) * girth[2]
    out, ahead = u(0.1, 1.5) if upright else u(0.0, 0.3), u(0.0, 0.6)
    for side, sign in (("left", 1), ("right", -1)):
        shoulder = spine[3 if upright else 2] + [sign * 0.8 * girth[2], -0.1 * girth[2], 0]
        way = np.array([sign * np.sin(out), -np.cos(out), ahead])
        elbow = shoulder + 0.5 * long * way
        hand = elbow + 0.5 * long * (way + [0, 0, u(0, 0.6)])
        animal.limb(f"arm_{side}", "spine_2", [shoulder, elbow, hand], [1.1 * thick, 0.8 * thick, u(0.6, 1.2) * thick])


def _wings(animal: Creature, spine: np.ndarray, girth: np.ndarray, rng: np.random.Generator) -> None:
    u = rng.uniform
    span, chord, rise, back, flat = u(0.2, 0.9), u(0.06, 0.2), u(-0.4, 0.9), u(-0.4, 0.2), u(0.1, 0.25)
    for side, sign in (("left", 1), ("right", -1)):
        root = spine[2] + [sign * 0.6 * girth[2], 0.3 * girth[2], 0]
        points = [root + s * span * np.array([sign * np.cos(rise), np.sin(rise), back]) for s in (0, 0.5, 1)]
        normal = (-sign * float(np.sin(rise)), float(np.cos(rise)), 0.0)
        radii = [chord, 0.95 * chord, 0.35 * chord]
        animal.limb(f"wing_{side}", "spine_2", points, radii, "fin", flat=flat, normal=normal)


def _fin(animal: Creature, spine: np.ndarray, girth: np.ndarray, rng: np.random.Generator) -> None:
    u = rng.uniform
    thin = {"flat": u(0.15, 0.3), "normal": (1.0, 0.0, 0.0)}
    root = spine[2] + [0, 0.8 * girth[2], 0]
    animal.limb("back_fin", "spine_1", [root, root + [0, u(0.05, 0.2), -u(0, 0.15)]], [0.09, 0.04], "fin", **thin)
    tail = spine[0] + [0, 0, -girth[0]]
    for index, sign in enumerate((-1, 1)):
        tip = tail + [0, sign * u(0.08, 0.2), -u(0.05, 0.2)]
        animal.limb(f"tail_fin_{index}", "spine_0", [tail, tip], [0.06, 0.05], "fin", **thin)
