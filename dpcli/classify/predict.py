"""Class scores of whole videos: softmax averaged over a video's clips, for each stream and their fusion."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import torch

from dpcli.classify.clips import Clip, ClipSource
from dpcli.classify.kinet import Kinet, fuse


@dataclass
class VideoScores:
    """Mean probabilities (C) of one video, by stream, and how many clips they come from."""

    sequence: int
    static: np.ndarray
    dynamic: np.ndarray
    fused: np.ndarray
    clips: int


def batches(source: ClipSource, clips: list[Clip], size: int) -> Iterator[tuple[list[Clip], torch.Tensor]]:
    """Clips in order as tensors (b,T,P,3); the points drawn depend on the clip alone, not on the batch."""
    for start in range(0, len(clips), size):
        chosen = clips[start : start + size]
        arrays = [source.load(clip, clip.sequence, *clip.frames) for clip in chosen]
        yield chosen, torch.from_numpy(np.stack(arrays))


@torch.inference_mode()
def predict_videos(
    model: Kinet, source: ClipSource, clips_per_video: int | None, batch: int, device: torch.device
) -> Iterator[VideoScores]:
    """Scores of every video of `source`, in order, one video in memory at a time."""
    rows: Iterable[tuple[Clip, list[torch.Tensor]]] = _clip_scores(model, source, clips_per_video, batch, device)
    current, kept = -1, []
    for clip, probabilities in rows:
        if clip.sequence != current and kept:
            yield _mean(current, kept)
            kept = []
        current = clip.sequence
        kept.append(probabilities)
    if kept:
        yield _mean(current, kept)


def _clip_scores(model: Kinet, source: ClipSource, count: int | None, batch: int, device: torch.device) -> Iterator:
    for clips, points in batches(source, source.clips(count), batch):
        static, dynamic = model(points.to(device))
        fused = fuse(static, dynamic, model.config.fusion)
        table = torch.stack([torch.softmax(static, -1), torch.softmax(dynamic, -1), fused]).cpu()
        yield from zip(clips, table.unbind(1))


def _mean(sequence: int, kept: list[torch.Tensor]) -> VideoScores:
    static, dynamic, fused = torch.stack(kept).mean(0).numpy()
    return VideoScores(sequence, static, dynamic, fused, len(kept))
