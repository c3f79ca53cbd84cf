"""A true video, and a prediction with noise that grows from view to view."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.video_clips import clip, write


@pytest.fixture
def truth(tmp_path: Path) -> Path:
    return write(tmp_path / "truth.h5", clip())


@pytest.fixture
def said(tmp_path: Path) -> Path:
    return write(tmp_path / "said.h5", clip(1, noise=6))
