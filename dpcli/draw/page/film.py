"""Pictures from several cameras as a page: one strip of frames for each camera, played together."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from dpcli.draw.page.assemble import data_page
from dpcli.draw.page.points import PageFacts, frame_rate

_QUALITY = 82  # of WebP; its transparency loses nothing


@dataclass
class PageView:
    """Holds one camera: a title, and its pictures u8 (H,W,4) with straight alpha, which are taken one at a time."""

    title: str
    pictures: Iterable[np.ndarray]


def film_page(
    facts: PageFacts, views: Iterable[PageView], *, frames: Sequence[int], frame_count: int, time: np.ndarray, side: int
) -> str:
    """Returns the page. frames: numbers of the pictures' frames, of frame_count in all. time: f64 of these frames, seconds.

    Pictures are reduced so that their longer side has at most `side` pixels, and stored as WebP.
    """
    titles, strips = [], []
    for at, view in enumerate(views):
        titles.append(view.title)
        pictures = "".join(f'<img alt="" src="{_webp(picture, side)}">' for picture in view.pictures)
        strips.append(f'<div id="view{at}" hidden>{pictures}</div>')
    header = facts.header() | {
        "views": titles,
        "frames": list(frames),
        "frame_count": frame_count,
        "time": time.tolist(),
        "rate": frame_rate(time),
    }
    return data_page(header, "film", script=("film",), data="\n".join(strips))


def _webp(rgba: np.ndarray, side: int) -> str:
    """Returns the address, `data:...`, of a picture: letters, digits and + / = only, so it may stand in an attribute."""
    from PIL import Image

    picture = Image.fromarray(rgba)
    picture.thumbnail((side, side), Image.Resampling.BOX)
    content = io.BytesIO()
    picture.save(content, "webp", quality=_QUALITY, method=4)
    return f"data:image/webp;base64,{base64.b64encode(content.getvalue()).decode('ascii')}"
