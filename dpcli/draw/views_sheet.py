"""A contact sheet of pictures of several cameras: a row per camera, frames over time as columns, on white."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpcli.draw.palette import LIGHT
from dpcli.draw.sequences import ViewsSource
from dpcli.draw.sheet import SheetRow, contact_sheet, save_picture, spread_evenly

_HEIGHT = 150  # pixels of a cell


def on_white(rgba: np.ndarray) -> np.ndarray:  # [H, W, 4] -> [H, W, 3]
    """Returns a picture u8 with straight alpha on white.

    >>> on_white(np.array([[[200, 0, 0, 0], [200, 0, 0, 255]]], np.uint8)).tolist()
    [[[255, 255, 255], [200, 0, 0]]]
    """
    alpha = rgba[..., 3:].astype(np.uint16)
    return ((rgba[..., :3] * alpha + 255 * (255 - alpha) + 127) // 255).astype(np.uint8)


def views_sheet(reader: ViewsSource, path: Path, samples: int = 8, frames: int = 8) -> None:
    """Writes the sheet to `path`: at most `samples` views (the reference first) and `frames` moments, evenly spread."""
    from PIL import Image

    header = reader.header
    others = [view for view in range(header.num_views) if view != header.reference]
    views = [header.reference, *(others[place] for place in spread_evenly(len(others), samples - 1))]
    moments = spread_evenly(header.num_frames, frames)
    size = (max(1, round(_HEIGHT * header.size[0] / header.size[1])), _HEIGHT)

    def cell(view: int, frame: int) -> np.ndarray:
        picture = Image.fromarray(on_white(reader.rgba(view, frame)))
        return np.asarray(picture.resize(size, Image.Resampling.BOX))

    marks = [str(frame) for frame in moments]
    rows = [SheetRow(view_title(reader, view), marks, [cell(view, frame) for frame in moments]) for view in views]
    save_picture(contact_sheet(rows, LIGHT), path)


def view_title(reader: ViewsSource, view: int) -> str:
    """Returns a title such as `2 train · azimuth 90, elevation -20`; angles of the camera's place in degrees."""
    x, y, z = reader.header.camera_centers()[view]
    azimuth, elevation = np.rad2deg(np.arctan2(x, z)), np.rad2deg(np.arctan2(y, np.hypot(x, z)))
    return f"{view} {reader.header.role[view]} · azimuth {azimuth + 0.0:.0f}, elevation {elevation + 0.0:.0f}"
