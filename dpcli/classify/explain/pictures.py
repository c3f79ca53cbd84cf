"""Pictures of explanations: activations on points, frame by frame or moving, and videos in the plane."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.classify.explain.point_activation_cloud import ActivationCloud
from dpcli.draw.animation import write_pictures
from dpcli.draw.fonts import text_font
from dpcli.draw.palette import DARK, heat_colors
from dpcli.draw.points import Raster, draw_dots
from dpcli.draw.sheet import new_figure, save_figure, save_picture, shortened, spread_evenly, write_line

ANIMATIONS = (".gif", ".mp4")
_CELL, _GAP, _TITLE, _MARGIN = 132, 3, 20, 58  # pixels: of a cell, between cells, of a title's line, left of the rows
_MARKERS = "osD^vP*X"
_RATE = 6  # images per second of an animation


def activation_sheet(
    path: Path, clouds: Sequence[ActivationCloud], class_names: Sequence[str], axes: np.ndarray, frames: int = 8
) -> None:
    """Draws a row per sample and stream (streams one under another), at most `frames` frames as columns; red acts most, blue least."""
    blocks = []
    for cloud in clouds:
        shown = spread_evenly(cloud.sequence.num_frames, frames)
        draw = _drawer(cloud, axes)
        rows = {stream: [draw(stream, t) for t in shown] for stream in cloud.activation}
        blocks.append((title(cloud, class_names), [f"{cloud.frames[t]}" for t in shown], rows))
    save_picture(_sheet(blocks), path)


def activation_animation(
    path: Path, clouds: Sequence[ActivationCloud], class_names: Sequence[str], axes: np.ndarray
) -> None:
    """Draws the clips' frames one after another, six a second: a row per sample, streams side by side."""
    drawers = [_drawer(cloud, axes) for cloud in clouds]
    images = []
    for t in range(max(cloud.sequence.num_frames for cloud in clouds)):
        blocks = []
        for cloud, draw in zip(clouds, drawers):
            here = min(t, cloud.sequence.num_frames - 1)
            cells = [draw(stream, here) for stream in cloud.activation]
            blocks.append((title(cloud, class_names), list(cloud.activation), {f"{cloud.frames[here]}": cells}))
        images.append(np.asarray(_sheet(blocks)))
    write_pictures(path, images, _RATE, force=True)


def title(cloud: ActivationCloud, class_names: Sequence[str]) -> str:
    """Returns the words above a sample: its name, its class, what the network says, and which class is explained."""

    def name(label: int) -> str:
        """Returns the name of a class, or its number where it has none."""
        return class_names[label] if 0 <= label < len(class_names) else str(label)

    parts = [cloud.sequence.name]
    if cloud.sequence.label >= 0:
        parts.append(name(cloud.sequence.label))
    parts.append(f"predicted {name(cloud.predicted)} {100 * cloud.probability:.0f} %")
    if cloud.target >= 0 and cloud.target != cloud.predicted:
        parts.append(f"explained {name(cloud.target)}")
    return " · ".join(parts)


def _drawer(cloud: ActivationCloud, axes: np.ndarray) -> Callable[[str, int], np.ndarray]:
    """Returns a function from (stream, frame) to a cell u8 (_CELL,_CELL,3); all frames are drawn in one scale."""
    seen = cloud.sequence.points @ axes.T
    low, high = np.percentile(seen[:, :2], [0.2, 99.8], axis=0)
    scale = 0.92 * _CELL / max(float((high - low).max()), 1e-9)
    raster = Raster(_CELL, _CELL, (low + high) / 2, scale)
    offsets = cloud.sequence.frame_offsets

    def draw(stream: str, t: int) -> np.ndarray:
        """Returns the cell of a stream and a frame."""
        span = slice(int(offsets[t]), int(offsets[t + 1]))
        colors, side = heat_colors(cloud.activation[stream][span]), 3 if span.stop - span.start < 3000 else 2
        return draw_dots(seen[span], colors, raster, side, relief=False)

    return draw


def _sheet(blocks: list[tuple[str, list[str], dict[str, list[np.ndarray]]]]) -> Any:
    """Draws blocks of a title, column heads and labeled rows of cells, with the scale of colors at the foot."""
    from PIL import Image, ImageDraw

    step = _CELL + _GAP
    columns = max(len(heads) for _, heads, _ in blocks)
    heights = [_TITLE + len(rows) * step + _GAP for _, _, rows in blocks]
    size = max(_MARGIN + columns * step + _GAP, 420), sum(heights) + _TITLE + 2 * _GAP
    sheet = Image.new("RGB", size, DARK.page)
    draw, top = ImageDraw.Draw(sheet), _GAP
    for (words, heads, rows), height in zip(blocks, heights):
        write_line(draw, (_GAP + 3, top + 1), words, size[0] - 2 * _GAP, DARK.ink)
        for row, (label, cells) in enumerate(rows.items()):
            y = top + _TITLE + row * step
            draw.text((_GAP + 3, y + _CELL // 2 - 7), label, fill=DARK.ink, font=text_font(12, label))
            for column, (head, cell) in enumerate(zip(heads, cells)):
                sheet.paste(Image.fromarray(cell), (_MARGIN + column * step, y))
                if row == 0:
                    draw.text((_MARGIN + column * step + 4, y + 2), head, fill=DARK.faint, font=text_font(11, head))
        top += height
    draw.text((_GAP + 3, top + 2), "least", fill=DARK.faint, font=text_font(11))
    bar = np.repeat(heat_colors(np.linspace(0, 1, 160))[None], 10, axis=0)
    sheet.paste(Image.fromarray(bar), (_MARGIN, top + 5))
    draw.text((_MARGIN + 168, top + 2), "most active point of the clip", fill=DARK.faint, font=text_font(11))
    return sheet


def plane_picture(
    path: Path,
    coordinates: dict[str, np.ndarray],
    labels: np.ndarray,
    class_names: Sequence[str],
    captions: dict[str, str],
) -> None:
    """Draws a panel per stream with a dot per video (S,2), colored by class, gray where there is no label; one legend."""

    present = sorted(set(labels[labels >= 0].tolist()))
    columns = -(-max(len(present), 1) // 22)
    figure = new_figure(4.6 * len(coordinates) + 1.7 * columns, 4.9)
    panels = figure.subplots(1, len(coordinates), squeeze=False)[0]
    names = [_short(label, class_names) for label in present]
    for axes, (stream, xy) in zip(panels, coordinates.items()):
        unknown = labels < 0
        handles = []
        if unknown.any():
            handles.append(axes.scatter(*xy[unknown].T, s=16, color="0.65", linewidths=0))
        for place, label in enumerate(present):
            color, marker = _style(place)
            handles.append(axes.scatter(*xy[labels == label].T, s=22, color=[color], marker=marker, linewidths=0))
        axes.set_title(f"{stream}\n{captions[stream]}", fontsize=10)
        axes.set(xticks=[], yticks=[])
        axes.margins(0.06)
        for spine in axes.spines.values():
            spine.set_color("0.8")
    places = map(str, range(len(handles)))  # a legend leaves out what is called nothing or begins with _
    legend = figure.legend(handles, places, loc="outside right upper", ncols=columns, fontsize=7.5, frameon=False)
    for text, name in zip(legend.get_texts(), [*(["no label"] if (labels < 0).any() else []), *names], strict=True):
        text.set_parse_math(False)
        text.set_text(name)
    save_figure(figure, path, 130)


def _style(place: int) -> tuple[tuple[float, ...], str]:
    """Returns color and marker of a class, ten hues a marker (20 classes: circles, squares), so that neighbors differ."""
    from matplotlib import colormaps

    return colormaps["tab10"](place % 10)[:3], _MARKERS[place // 10 % len(_MARKERS)]


def _short(label: int, class_names: Sequence[str]) -> str:
    return shortened((class_names[label] if label < len(class_names) else "") or str(label), 26)
