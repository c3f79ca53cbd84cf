"""The input clip's pictures for the page: one JPEG that holds a small picture of every frame."""

from __future__ import annotations

import base64
import io
import math
from pathlib import Path
from typing import Any

from dpcli.counted import counted
from dpcli.draw.views_sheet import on_white
from dpcli.errors import DataError
from dpcli.store.gaussians import GaussianScene
from dpcli.store.views import ViewsReader

_SIDE, _QUALITY = 192, 85  # pixels of a picture's longer side; of 100


def input_sheet(clip: Path, scene: GaussianScene) -> dict[str, Any]:
    """Returns the reference view of a clip as the page's header has it: width and height of a picture in pixels, columns
    of the sheet, and the sheet as a data address (JPEG, on white, frames row by row).

    Raises DataError unless the clip has as many frames as the scene.
    """
    from PIL import Image

    with ViewsReader(clip) as reader:
        if reader.num_frames != scene.num_frames:
            raise DataError(
                f"{clip}: {counted(reader.num_frames, 'frame')}, but the scene has {scene.num_frames}; name the clip it was fitted to"
            )
        scale = min(1.0, _SIDE / max(reader.header.size))
        width, height = (max(1, round(side * scale)) for side in reader.header.size)
        columns = math.ceil(math.sqrt(scene.num_frames))
        sheet = Image.new("RGB", (columns * width, math.ceil(scene.num_frames / columns) * height), "white")
        for frame in range(scene.num_frames):
            picture = Image.fromarray(on_white(reader.rgba(reader.header.reference, frame)))
            place = (frame % columns * width, frame // columns * height)
            sheet.paste(picture.resize((width, height), Image.Resampling.BOX), place)
    packed = io.BytesIO()
    sheet.save(packed, "JPEG", quality=_QUALITY)
    text = base64.b64encode(packed.getvalue()).decode("ascii")
    return {"width": width, "height": height, "columns": columns, "sheet": f"data:image/jpeg;base64,{text}"}
