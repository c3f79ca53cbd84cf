"""Pictures of explanations: activations on points, frame by frame or moving, and videos in the plane."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.classify.explain.point_activation_cloud import ActivationCloud
from dpcli.errors import DataError, UsageError
from dpcli.runtime.whole_file import whole_file

ANIMATIONS = (".gif", ".mp4")
_CELL, _GAP, _TITLE, _MARGIN = 132, 3, 20, 58  # pixels: of a cell, between cells, of a title's line, left of the rows
_BACKGROUND, _INK, _FAINT = (17, 20, 26), (226, 230, 236), (130, 138, 150)
_MARKERS = "osD^vP*X"
_RATE = 6  # images per second of an animation


def view_axes(text: str | None, length_unit: str) -> np.ndarray:
    """Returns rows f32 (3,3): the axes that point right, down and away, from names such as `xyz` or `x-zy`.

    Without a text: camera axes, or those of image coordinates where the unit says row and column.
    """
    text = text or ("yx-z" if "row, column" in length_unit else "xyz")
    axes = re.findall(r"-?[xyz]", text)
    if "".join(axes) != text or sorted(axis[-1] for axis in axes) != ["x", "y", "z"]:
        raise UsageError(f"--view {text}: expected the axes that point right, down and away, such as xyz or x-zy")
    return np.array([np.eye(3)["xyz".index(axis[-1])] * (-1 if axis[0] == "-" else 1) for axis in axes], np.float32)


def activation_sheet(
    path: Path, clouds: Sequence[ActivationCloud], class_names: Sequence[str], axes: np.ndarray, frames: int = 8
) -> None:
    """Draws a row per sample and stream (streams one under another), at most `frames` frames as columns; red acts most, blue least."""
    blocks = []
    for cloud in clouds:
        shown = np.unique(np.linspace(0, cloud.sequence.num_frames - 1, frames).round().astype(int)).tolist()
        draw = _drawer(cloud, axes)
        rows = {stream: [draw(stream, t) for t in shown] for stream in cloud.activation}
        blocks.append((title(cloud, class_names), [f"{cloud.frames[t]}" for t in shown], rows))
    _save_whole(path, lambda part: _sheet(blocks).save(part))


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
    save = _save_mp4 if path.suffix.lower() == ".mp4" else _save_gif
    _save_whole(path, lambda part: save(part, images))


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


def heat(values: np.ndarray) -> np.ndarray:
    """Returns colors u8 (P,3) of values 0..1, blue to red."""
    from matplotlib import colormaps

    table = (colormaps["turbo"](np.linspace(0.06, 0.94, 256))[:, :3] * 255).astype(np.uint8)
    return table[np.clip(np.round(values * 255), 0, 255).astype(int)]


def _drawer(cloud: ActivationCloud, axes: np.ndarray) -> Callable[[str, int], np.ndarray]:
    """(stream, frame) -> cell u8 (_CELL,_CELL,3), all frames in one scale."""
    seen = cloud.sequence.points @ axes.T
    low, high = np.percentile(seen[:, :2], [0.2, 99.8], axis=0)
    scale = 0.92 * _CELL / max(float((high - low).max()), 1e-9)
    places = (seen[:, :2] - (low + high) / 2) * scale + _CELL / 2
    offsets = cloud.sequence.frame_offsets

    def draw(stream: str, t: int) -> np.ndarray:
        """Returns the cell of a stream and a frame."""
        span = slice(int(offsets[t]), int(offsets[t + 1]))
        return _dots(places[span], seen[span, 2], heat(cloud.activation[stream][span]))

    return draw


def _dots(places: np.ndarray, depth: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """Small squares at pixel places (N,2), the nearest on top."""
    image = np.empty((_CELL, _CELL, 3), np.uint8)
    image[:] = _BACKGROUND
    size = 3 if len(places) < 3000 else 2
    order = np.argsort(-depth, kind="stable")
    steps = np.stack(np.meshgrid(np.arange(size), np.arange(size)), -1).reshape(-1, 2) - size // 2
    pixels = (np.floor(places[order]).astype(int)[:, None] + steps).reshape(-1, 2)
    painted = np.repeat(colors[order], len(steps), axis=0)
    inside = ((pixels >= 0) & (pixels < _CELL)).all(1)
    image[pixels[inside, 1], pixels[inside, 0]] = painted[inside]
    return image


def _sheet(blocks: list[tuple[str, list[str], dict[str, list[np.ndarray]]]]) -> Any:
    """Blocks of a title, column heads and labeled rows of cells, with the scale of colors at the foot."""
    from PIL import Image, ImageDraw

    step = _CELL + _GAP
    columns = max(len(heads) for _, heads, _ in blocks)
    heights = [_TITLE + len(rows) * step + _GAP for _, _, rows in blocks]
    size = max(_MARGIN + columns * step + _GAP, 420), sum(heights) + _TITLE + 2 * _GAP
    sheet = Image.new("RGB", size, tuple(c + 10 for c in _BACKGROUND))
    draw, top = ImageDraw.Draw(sheet), _GAP
    for (words, heads, rows), height in zip(blocks, heights):
        _write(draw, (_GAP + 3, top + 1), words, size[0] - 2 * _GAP)
        for row, (label, cells) in enumerate(rows.items()):
            y = top + _TITLE + row * step
            draw.text((_GAP + 3, y + _CELL // 2 - 7), label, fill=_INK, font=_font(12))
            for column, (head, cell) in enumerate(zip(heads, cells)):
                sheet.paste(Image.fromarray(cell), (_MARGIN + column * step, y))
                if row == 0:
                    draw.text((_MARGIN + column * step + 4, y + 2), head, fill=_FAINT, font=_font(11))
        top += height
    draw.text((_GAP + 3, top + 2), "least", fill=_FAINT, font=_font(11))
    bar = np.repeat(heat(np.linspace(0, 1, 160))[None], 10, axis=0)
    sheet.paste(Image.fromarray(bar), (_MARGIN, top + 5))
    draw.text((_MARGIN + 168, top + 2), "most active point of the clip", fill=_FAINT, font=_font(11))
    return sheet


def _write(draw: Any, place: tuple[int, int], text: str, room: int) -> None:
    """Text in one line, shortened to the room (pixels) there is."""
    while draw.textlength(text, font=_font(13)) > room and len(text) > 2:
        text = text[:-2] + "…"
    draw.text(place, text, fill=_INK, font=_font(13))


def _font(size: int) -> Any:
    from PIL import ImageFont

    return ImageFont.load_default(size=size)


def _save_gif(path: Path, images: list[np.ndarray]) -> None:
    """Returns all images with one table of colors, so that nothing flickers."""
    from PIL import Image

    table = Image.fromarray(np.concatenate(images[:: max(1, len(images) // 4)], axis=1)).quantize(255)
    frames = [Image.fromarray(image).quantize(palette=table, dither=Image.Dither.NONE) for image in images]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=round(1000 / _RATE), loop=0)


def _save_mp4(path: Path, images: list[np.ndarray]) -> None:
    import imageio_ffmpeg

    height, width = (side // 2 * 2 for side in images[0].shape[:2])  # 4:2:0 wants even sides
    writer = imageio_ffmpeg.write_frames(
        str(path),
        (width, height),
        fps=_RATE,
        codec="libx264",
        pix_fmt_out="yuv420p",
        macro_block_size=1,
        quality=None,
        output_params=["-crf", "18", "-preset", "veryfast", "-threads", "2"],
        ffmpeg_log_level="error",
    )
    writer.send(None)
    for image in images:
        writer.send(np.ascontiguousarray(image[:height, :width]))
    writer.close()


def _save_whole(path: Path, save: Callable[[Path], None]) -> None:
    """Saves a picture through `whole_file`. Raises DataError when it can't be written."""
    try:
        with whole_file(path) as part:
            save(part)
    except (ValueError, OSError) as error:
        raise DataError(f"{path}: cannot be written ({error})") from None


def plane_picture(
    path: Path,
    coordinates: dict[str, np.ndarray],
    labels: np.ndarray,
    class_names: Sequence[str],
    captions: dict[str, str],
) -> None:
    """Draws a panel per stream with a dot per video (S,2), colored by class, gray where there is no label; one legend."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    present = sorted(set(labels[labels >= 0].tolist()))
    columns = -(-max(len(present), 1) // 22)
    figure = Figure(figsize=(4.6 * len(coordinates) + 1.7 * columns, 4.9), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(coordinates), squeeze=False)[0]
    for axes, (stream, xy) in zip(panels, coordinates.items()):
        unknown = labels < 0
        if unknown.any():
            axes.scatter(*xy[unknown].T, s=16, color="0.65", label="no label", linewidths=0)
        for place, label in enumerate(present):
            color, marker = _style(place, len(present))
            axes.scatter(
                *xy[labels == label].T,
                s=22,
                color=[color],
                marker=marker,
                linewidths=0,
                label=_short(label, class_names),
            )
        axes.set_title(f"{stream}\n{captions[stream]}", fontsize=10)
        axes.set(xticks=[], yticks=[])
        axes.margins(0.06)
        for spine in axes.spines.values():
            spine.set_color("0.8")
    handles, names = panels[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside right upper", ncols=columns, fontsize=7.5, frameon=False)
    _save_whole(path, lambda part: figure.savefig(part, dpi=130))


def _style(place: int, count: int) -> tuple[tuple[float, ...], str]:
    """Returns color and marker of a class, ten hues a marker (20 classes: circles, squares), so that neighbors differ."""
    from matplotlib import colormaps

    return colormaps["tab10"](place % 10)[:3], _MARKERS[place // 10 % len(_MARKERS)]


def _short(label: int, class_names: Sequence[str]) -> str:
    name = class_names[label] if label < len(class_names) else str(label)
    return (name if len(name) <= 26 else name[:25] + "…").replace("$", r"\$")
