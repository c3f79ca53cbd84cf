"""A picture of an object's parts with the axes of their joints."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpcli.draw.fonts import text_font
from dpcli.draw.palette import part_colors
from dpcli.draw.points import Raster, draw_balls
from dpcli.draw.sheet import save_picture, write_line
from dpcli.draw.view import turntable_view
from dpcli.segment.kinematics.kinematic_tree import KinematicTree
from dpcli.store.joints import FIXED, PRISMATIC, REVOLUTE, TYPES

_CELL, _VIEWS, _LINE = 420, (np.radians(40), np.radians(130)), 18
_INK, _PAPER = (30, 34, 42), (255, 255, 255)
_HALF = 0.28  # of the object's extent: half the length of a drawn axis


def joints_picture(path: Path, tree: KinematicTree, title: str, up: str) -> None:
    """Writes two views of the parts as in frame 0, each joint's axis as a line (revolute) or an arrow (prismatic).

    up: the axis that points upwards, such as z or -y.
    """
    from PIL import Image, ImageDraw

    points, part = np.concatenate(tree.points), np.repeat(tree.trajectories.ids, [len(own) for own in tree.points])
    lines = _legend_lines(tree)
    sheet = Image.new("RGB", (len(_VIEWS) * _CELL, _CELL + _LINE * (len(lines) + 2)), _PAPER)
    draw = ImageDraw.Draw(sheet)
    write_line(draw, (8, 4), title, sheet.width - 16, _INK)
    for column, azimuth in enumerate(_VIEWS):
        matrix = turntable_view(azimuth, np.radians(25), up)
        seen = points @ matrix.T
        low, high = seen.min(0), seen.max(0)
        extent = max(float((high - low)[:2].max()), 1e-9)
        raster = Raster(_CELL, _CELL, (low + high)[:2] / 2, 0.7 * _CELL / extent)
        cell = draw_balls(seen, part_colors(part), raster, _PAPER, (float(low[2]), float(high[2])))
        sheet.paste(Image.fromarray(cell), (column * _CELL, _LINE))
        for joint in tree.joints:
            if joint.fit.kind in (REVOLUTE, PRISMATIC):
                half = _HALF * extent * joint.fit.axis
                ends = np.stack([joint.fit.point - half, joint.fit.point + half])
                pixels = raster.place(ends @ matrix.T) + [column * _CELL, _LINE]
                _draw_axis(draw, pixels, _color(tree, joint.child), joint.fit.kind == PRISMATIC)
    for row, (text, color) in enumerate(lines):
        top = _CELL + _LINE * (row + 1) + 6
        draw.ellipse((10, top + 4, 20, top + 14), fill=color)
        draw.text((28, top), text, fill=_INK, font=text_font(12, text))
    save_picture(sheet, path)


def _color(tree: KinematicTree, row: int) -> tuple[int, ...]:
    return tuple(part_colors(tree.trajectories.ids[[row]])[0].tolist())


def _draw_axis(draw: object, pixels: np.ndarray, color: tuple[int, ...], arrow: bool) -> None:
    ends = [tuple(pixel) for pixel in pixels.tolist()]
    draw.line(ends, fill=_INK, width=5)
    draw.line(ends, fill=color, width=3)
    along = pixels[1] - pixels[0]
    length = float(np.hypot(*along))
    if arrow and length > 1:
        along, across = 12 * along / length, 7 * np.array([-along[1], along[0]]) / length
        tip = [pixels[1] + along, pixels[1] + across, pixels[1] - across]
        draw.polygon([tuple(corner) for corner in np.array(tip).tolist()], fill=color, outline=_INK)
    elif not arrow:
        for x, y in ends:
            draw.ellipse((x - 5, y - 5, x + 5, y + 5), fill=color, outline=_INK)


def _legend_lines(tree: KinematicTree) -> list[tuple[str, tuple[int, ...]]]:
    """Returns (text, color) of each part: what holds it, and how far it went."""
    ids = tree.trajectories.ids
    lines = [(f"part {ids[tree.root]}: root", _color(tree, tree.root))]
    for joint in tree.joints:
        fit, text = joint.fit, f"part {ids[joint.child]}: {TYPES[joint.fit.kind]} on part {ids[joint.parent]}"
        if fit.kind == REVOLUTE:
            text += f", {np.degrees(fit.value.min()):.0f} to {np.degrees(fit.value.max()):.0f} degrees"
        elif fit.kind == PRISMATIC:
            text += f", {fit.value.min():.3g} to {fit.value.max():.3g}"
        elif fit.kind != FIXED:
            text += ": no single axis explains its motion"
        lines.append((text, _color(tree, joint.child)))
    return lines
