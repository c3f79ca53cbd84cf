"""The contact sheet of point clouds: which samples it shows, and in which colors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dpcli.draw.clouds_sheet import clouds_sheet, spread_samples
from dpcli.errors import DataError
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter

RED = (255, 0, 0)


@settings(max_examples=60, deadline=None)
@given(labels=st.lists(st.integers(-1, 6), min_size=1, max_size=40), count=st.integers(1, 12))
def test_samples_are_spread_over_the_classes(labels: list[int], count: int) -> None:
    chosen = spread_samples(np.array(labels), count)
    assert len(set(chosen)) == len(chosen) == min(count, len(labels))
    shown = [labels[i] for i in chosen]
    assert shown == sorted(shown)
    assert len(set(shown)) == min(count, len(set(labels)))
    if count >= len(set(labels)):  # no class gets two more than another that still had samples
        for label in set(labels):
            if shown.count(label) < labels.count(label):
                assert max(shown.count(other) for other in shown) <= shown.count(label) + 1


@pytest.mark.parametrize("field", ["none", "color", "part"])
def test_the_sheet_shows_the_colors_of_the_file(tmp_path: Path, field: str) -> None:
    from PIL import Image

    rng = np.random.default_rng(0)
    path = tmp_path / "c.h5"
    with CloudsWriter(path, class_names=["wave", "push"], fields=() if field == "none" else (field,)) as writer:
        for index in range(3):
            frames = [rng.uniform(0, 1, (200, 3)) for _ in range(5)] + [np.zeros((0, 3))]
            extra = {
                "color": {"color": [np.tile(np.array([RED], np.uint8), (len(f), 1)) for f in frames]},
                "part": {"part": [np.arange(len(f), dtype=np.int16) % 3 for f in frames]},
            }.get(field, {})
            writer.write(CloudSequence.from_frames(f"s{index}", frames, label=index % 2, **extra))
    picture = tmp_path / "sheet.png"
    with CloudsReader(path) as reader:
        clouds_sheet(reader, picture, samples=2, frames=4)
    with Image.open(picture) as image:
        pixels = np.asarray(image).reshape(-1, 3).astype(int)
    red = ((pixels[:, 0] > 120) & (pixels[:, 1] < 40) & (pixels[:, 2] < 40)).sum()
    colored = (pixels.max(1) - pixels.min(1) > 60).sum()
    assert colored > 500
    assert (red > 0.9 * colored) == (field == "color")


def test_a_picture_into_nowhere(tmp_path: Path) -> None:
    path = tmp_path / "c.h5"
    with CloudsWriter(path) as writer:
        writer.write(CloudSequence.from_frames("s", [np.zeros((1, 3))]))
    with CloudsReader(path) as reader, pytest.raises(DataError, match="cannot be written"):
        clouds_sheet(reader, tmp_path / "none" / "x.png")
