"""Frechet distances of videos: FVD and FID-VID over the views of a protocol."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpcli.evaluate.video.learned.base import FrameGap, LearnedMetric, LearnedScore
from dpcli.evaluate.video.protocol import Networks


class FrechetMetric(LearnedMetric):
    """Measures a Frechet distance (FVD, FID-VID) by a variant of `frechet/variants.py`; a view is a video."""

    def __init__(self, name: str, networks: Networks, folder: Path, device: str) -> None:
        from dpcli.evaluate.video.frechet.clip_features import FeatureNetwork

        variant = networks.fvd if name == "fvd" else name.removeprefix("fid_vid_")
        self.name, self._hop, self._views, self._pairs = name, networks.hop, [], []
        self._network = FeatureNetwork.load(variant, folder, device)

    def start(self, view: str) -> None:
        from dpcli.evaluate.video.frechet.clip_features import VideoFeatures

        self._video, self._gap = VideoFeatures(self._network, self._hop), FrameGap()
        self._views.append(view)

    def add(self, predicted: np.ndarray, truth: np.ndarray, frame: int) -> None:
        if self._gap.before(frame):
            self._video.restart()
        self._video.add(predicted, truth)

    def end(self) -> None:
        self._pairs.append(self._video.result())

    def score(self) -> LearnedScore:
        from dpcli.evaluate.video.frechet.clip_features import video_distance
        from dpcli.evaluate.video.frechet.variants import feature_choices

        found = video_distance(self._network.variant, self._pairs)
        each = dict(zip(self._views, found.each, strict=True)) if found.each else {}
        counts = {"videos": found.videos, "clips": found.clips, "frames": found.frames}
        choices = feature_choices(found.variant, self._hop)
        return LearnedScore(self.name, found.value, each, counts=counts, choices=choices)
