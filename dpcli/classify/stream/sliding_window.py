"""Predictions while the frames still come: a window of the last frames, a prediction per hop, equal to the batch ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from dpcli.classify.data.clips import Clip, ClipSource, OneVideo, clip_frames, uniform_frames
from dpcli.classify.data.likeness import NOTE
from dpcli.classify.network.kinet import Kinet
from dpcli.classify.network.model_file import ModelInfo
from dpcli.classify.video_scores import clip_scores
from dpcli.counted import counted
from dpcli.errors import UsageError
from dpcli.runtime.seeds import generator


@dataclass(frozen=True)
class Prediction:
    """Holds, after frame number `frame` (from 0), the probabilities f32 (1+S,C) of the window and their mean over all clips.

    Rows: fused, then each of the S streams that were trained.
    """

    frame: int
    clips: int
    scores: np.ndarray
    mean: np.ndarray


def window_size(info: ModelInfo, window: int | None) -> int:
    """Returns how many frames to look back at: a clip for a model of consecutive frames, else `window`, over which its frames spread.

    Raises UsageError for a window that the model can't use.
    """
    needed = info.config.num_frames
    if info.timing == "clips":
        if window not in (None, needed):
            raise UsageError(
                f"--window {window}: this model takes {counted(needed, 'consecutive frame')}; leave the option out"
            )
        return needed
    if window is None:
        raise UsageError(
            f"this model looks at whole videos in {counted(needed, 'part')}, and a stream has no end: give the number of frames"
            f" to look back, about as many as an action lasts, such as --window 40{_longest(info)}"
        )
    least = 1 if info.timing == "slots" else needed
    if window < least:
        raise UsageError(f"--window {window}: the model takes {counted(needed, 'frame')}; expected at least {least}")
    return window


def _longest(info: ModelInfo) -> str:
    """Returns how long the videos were that a model learned from, as the end of a sentence, "" where it doesn't say."""
    own = info.notes.get(NOTE)
    longest = own.get("frames") if isinstance(own, dict) else None
    if not isinstance(longest, int | float):
        return ""
    return f" (the longest video that it learned from had {counted(int(longest), 'frame')})"


class StreamPredictor:
    """Predicts every `hop` frames, first when the window is full. Memory does not grow.

    The points drawn depend on the seed and the frames' numbers, as in `ClipSource.load_shown`: with hop 1
    these are the clips that batch prediction takes, and the last `mean` is the video's score.
    """

    def __init__(
        self,
        model: Kinet,
        info: ModelInfo,
        *,
        window: int | None = None,
        hop: int = 1,
        seed: int = 0,
        device: torch.device | str = "cpu",
    ) -> None:
        if hop < 1:
            raise UsageError(f"--hop {hop}: expected at least 1 frame")
        self.model, self.info, self.hop, self.device = model.to(device), info, hop, device
        self.window = OneVideo("stream", info.config.column_fields, window_size(info, window))
        self._source = ClipSource(self.window, [0], info.config, timing=info.timing, seed=seed)
        self.streams = info.streams
        self.clips = 0
        self._sum = np.zeros((1 + len(self.streams), info.config.num_classes))

    def warm_up(self) -> None:
        """Predicts one made-up clip: loading kernels takes a second that the first prediction need not wait for."""
        config = self.info.config
        numbers = 5 + len(config.columns) if self.info.timing == "slots" else 3
        shape = (1, config.num_frames, config.points_per_frame, numbers)
        self._scores(torch.from_numpy(generator(0).random(shape, np.float32)))

    def add(self, points: np.ndarray) -> Prediction | None:
        """Takes a frame f32 (P,3+F), F columns as the model reads them; returns the prediction when one is due."""
        self.window.append(points)
        since_full = self.window.count - self.window.size
        return self._predict() if since_full >= 0 and since_full % self.hop == 0 else None

    def finish(self) -> Prediction | None:
        """Returns, at the end, the prediction of a stream too short for one window, its last frame held as batch prediction does."""
        return self._predict() if self.window.count and not self.clips else None

    @property
    def mean(self) -> np.ndarray:
        """Returns the probabilities f32 (1+S,C) averaged over all clips so far."""
        return (self._sum / max(self.clips, 1)).astype(np.float32)

    def clip(self) -> Clip:
        """Returns the clip that ends at the newest frame, by frame numbers."""
        count, frames = self.window.count, self.info.config.num_frames
        first = self.window.first
        if self.info.timing == "slots":
            return Clip(0, tuple(range(first, count)))
        if self.info.timing == "uniform":
            return Clip(0, tuple(first + t for t in uniform_frames(count - first, frames)))
        return Clip(0, clip_frames(count, frames, first))

    def _predict(self) -> Prediction:
        clip = self.clip()
        points = self._source.load_shown(clip)
        scores = self._scores(torch.from_numpy(points)[None])
        self.clips += 1
        self._sum += scores
        return Prediction(self.window.count - 1, self.clips, scores, self.mean)

    @torch.inference_mode()
    def _scores(self, points: torch.Tensor) -> np.ndarray:
        return clip_scores(self.model, points.to(self.device), self.streams)[:, 0].cpu().numpy()
