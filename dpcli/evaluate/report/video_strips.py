"""Truth, prediction and difference side by side as pictures inside the page, for some instants of some views."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from contextlib import closing
from html import escape
from pathlib import Path

import numpy as np

from dpcli.draw.sheet import spread_evenly
from dpcli.evaluate.report.blocks import Figure

_INSTANTS, _MOST_VIEWS, _QUALITY = 6, 4, 82


def strip_figure(predicted: Path, truth: Path, *, protocol: str = "dpc", background: str | None = None) -> Figure:
    """Returns pictures of up to four views; reads or renders only those shown. Raises DataError as `evaluate_video`."""
    from dpcli.evaluate.choices import BACKGROUNDS
    from dpcli.evaluate.video.difference_strip import DifferenceStrip
    from dpcli.evaluate.video.protocol import video_protocol
    from dpcli.evaluate.video.sources.open_source import open_source
    from dpcli.evaluate.video.view_pairing import match_views

    chosen = video_protocol(protocol, background)
    strip = DifferenceStrip(BACKGROUNDS[chosen.background])
    with closing(open_source(truth)) as true_source, closing(open_source(predicted, truth=true_source)) as source:
        pairs, _ = match_views(source, true_source, chosen, intersect=True)
        for ours, theirs in pairs[:_MOST_VIEWS]:
            count = min(one.frames[view] for one, view in ((source, ours), (true_source, theirs)) if one.frames)
            shown = spread_evenly(count, _INSTANTS)
            pictures = zip(shown, source.pictures(ours, shown), true_source.pictures(theirs, shown), strict=True)
            for frame, predicted_picture, true_picture in pictures:
                strip(true_source.views[theirs], frame, count, predicted_picture, true_picture)
    html = "".join(_markup(title, cells) for title, cells in strip.cells().items())
    note = f"{min(len(pairs), _MOST_VIEWS)} of {len(pairs)} views, {_INSTANTS} instants at most, made smaller."
    return Figure("Pictures side by side", html, note)


def _markup(title: str, cells: Sequence[tuple[int, np.ndarray]]) -> str:
    from PIL import Image

    sheet = np.concatenate([own for _, own in cells], axis=1)
    stream = io.BytesIO()
    Image.fromarray(sheet).save(stream, "JPEG", quality=_QUALITY)
    data = base64.b64encode(stream.getvalue()).decode("ascii")
    frames = ", ".join(str(frame) for frame, _ in cells)
    words = escape(f"{title}; frames {frames}")
    height, width = sheet.shape[:2]
    return (
        f'<figure class="strip"><figcaption>{words}</figcaption><div class="wide" tabindex="0" role="region" aria-label="{words}">'
        f'<img alt="{words}" width="{width}" height="{height}" src="data:image/jpeg;base64,{data}"></div></figure>'
    )
