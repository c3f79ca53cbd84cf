"""Class scores of whole videos: softmax averaged over a video's clips, for each stream and their fusion."""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from dpcli.classify.data.clips import Clip, ClipSource
from dpcli.classify.network.kinet import STREAMS, Kinet, fuse


@dataclass
class VideoScores:
    """Holds the mean probabilities (C) of one video, fused and by stream, and how many clips they come from."""

    sequence: int
    fused: np.ndarray
    streams: dict[str, np.ndarray]
    clips: int


def batches(source: ClipSource, clips: list[Clip], size: int) -> Iterator[tuple[list[Clip], torch.Tensor]]:
    """Yields clips in order as tensors (b,T,P,3); the points drawn depend on the clip alone, not on the batch."""
    for start in range(0, len(clips), size):
        chosen = clips[start : start + size]
        arrays = [source.load(clip, clip.sequence, *clip.frames) for clip in chosen]
        yield chosen, torch.from_numpy(np.stack(arrays))


@torch.inference_mode()
def predict_videos(
    model: Kinet,
    source: ClipSource,
    clips_per_video: int | None,
    batch: int,
    device: torch.device,
    streams: Sequence[str] = STREAMS,
    done: Container[int] = (),
) -> Iterator[VideoScores]:
    """Yields the scores of every video of `source` that isn't `done`, in order, one video in memory at a time.

    streams: those that were trained; with the static one alone, its scores are the fused ones. done: numbers of sequences.
    """
    current, kept = -1, []
    left = [clip for clip in source.clips(clips_per_video) if clip.sequence not in done]
    for clips, points in batches(source, left, batch):
        rows = clip_scores(model, points.to(device), streams).cpu().unbind(1)
        for clip, probabilities in zip(clips, rows):
            if clip.sequence != current and kept:
                yield _mean(current, kept, streams)
                kept = []
            current = clip.sequence
            kept.append(probabilities)
    if kept:
        yield _mean(current, kept, streams)


def clip_scores(model: Kinet, points: torch.Tensor, streams: Sequence[str]) -> torch.Tensor:
    """Returns the probabilities of clips (B,T,P,3): fused, then by stream, (1 + streams, B, C)."""
    if tuple(streams) != STREAMS:
        return torch.stack([torch.softmax(model.static_logits(points), -1)] * 2)
    static, dynamic = model(points)
    fused = fuse(static, dynamic, model.config.fusion)
    return torch.stack([fused, torch.softmax(static, -1), torch.softmax(dynamic, -1)])


def _mean(sequence: int, kept: list[torch.Tensor], streams: Sequence[str]) -> VideoScores:
    fused, *single = torch.stack(kept).mean(0).numpy()
    return VideoScores(sequence, fused, dict(zip(streams, single)), len(kept))
