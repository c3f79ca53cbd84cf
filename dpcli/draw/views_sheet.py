"""A contact sheet of a views file: a row per camera, frames over time as columns, on white."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpcli.store.views import ViewsReader

_HEIGHT, _GAP, _TITLE = 150, 4, 18
_INK, _FAINT = (30, 34, 40), (130, 138, 150)


def on_white(rgba: np.ndarray) -> np.ndarray:
    """u8 (H,W,4), straight alpha -> u8 (H,W,3) on white."""
    alpha = rgba[..., 3:].astype(np.uint16)
    return ((rgba[..., :3] * alpha + 255 * (255 - alpha) + 127) // 255).astype(np.uint8)


def views_sheet(reader: ViewsReader, path: Path, samples: int = 8, frames: int = 8) -> None:
    """Write the sheet to `path`: at most `samples` views (the reference first) and `frames` moments, evenly spread."""
    from PIL import Image, ImageDraw

    from dpcli.draw.contact_sheet import save_sheet, text_font

    header = reader.header
    others = [view for view in range(header.num_views) if view != header.reference]
    kept = np.unique(np.linspace(0, len(others) - 1, min(samples - 1, len(others))).round().astype(int)).tolist()
    rows = [header.reference, *(others[at] for at in kept)]
    columns = np.unique(np.linspace(0, header.num_frames - 1, frames).round().astype(int)).tolist()
    width = max(1, round(_HEIGHT * header.size[0] / header.size[1]))
    size = (len(columns) * (width + _GAP) + _GAP, len(rows) * (_HEIGHT + _TITLE + _GAP) + _GAP)
    sheet = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(sheet)
    for place, view in enumerate(rows):
        top = _GAP + place * (_HEIGHT + _TITLE + _GAP)
        draw.text((_GAP + 2, top + 1), view_title(reader, view), fill=_INK, font=text_font(13))
        for column, frame in enumerate(columns):
            left = _GAP + column * (width + _GAP)
            picture = Image.fromarray(on_white(reader.rgba(view, frame)))
            sheet.paste(picture.resize((width, _HEIGHT), Image.Resampling.BOX), (left, top + _TITLE))
            draw.text((left + 4, top + _TITLE + 2), str(frame), fill=_FAINT, font=text_font(10))
    save_sheet(sheet, path)


def view_title(reader: ViewsReader, view: int) -> str:
    """Such as `2 train · azimuth 90, elevation -20`; angles of the camera's place in degrees."""
    x, y, z = reader.header.camera_centers()[view]
    azimuth, elevation = np.rad2deg(np.arctan2(x, z)), np.rad2deg(np.arctan2(y, np.hypot(x, z)))
    return f"{view} {reader.header.role[view]} · azimuth {azimuth + 0.0:.0f}, elevation {elevation + 0.0:.0f}"
