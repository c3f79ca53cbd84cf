"""Class scores of whole videos: softmax averaged over a video's clips, for each stream and their fusion."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from dpcli.classify.data.clips import Clip, ClipSource
from dpcli.classify.network.kinet import STREAMS, Kinet, fuse


@dataclass
class VideoScores:
    """Holds the mean probabilities (C) of one video, fused and by stream, and how many clips they come from."""

    fused: np.ndarray
    streams: dict[str, np.ndarray]
    clips: int


def batches(source: ClipSource, clips: list[Clip], size: int) -> Iterator[tuple[list[Clip], torch.Tensor]]:
    """Yields clips in order as tensors (b,T,P,3); the points drawn depend on the clip alone, not on the batch."""
    for start in range(0, len(clips), size):
        chosen = clips[start : start + size]
        arrays = [source.load_shown(clip) for clip in chosen]
        yield chosen, torch.from_numpy(np.stack(arrays))


@torch.inference_mode()
def score_video(
    model: Kinet,
    source: ClipSource,
    sequence: int,
    clips_per_video: int | None,
    batch: int,
    device: torch.device | str,
    streams: Sequence[str] = STREAMS,
) -> VideoScores:
    """Returns the scores of a video; a batch holds its clips alone, so that they are the same whatever is scored beside it.

    streams: those that were trained; with the static one alone, its scores are the fused ones.
    """
    clips = source.video_clips(sequence, clips_per_video)
    found = [clip_scores(model, points.to(device), streams).cpu() for _, points in batches(source, clips, batch)]
    fused, *single = torch.cat(found, 1).mean(1).numpy()
    return VideoScores(fused, dict(zip(streams, single)), len(clips))


def clip_scores(model: Kinet, points: torch.Tensor, streams: Sequence[str]) -> torch.Tensor:
    """Returns the probabilities of clips (B,T,P,3): fused, then by stream, (1 + streams, B, C)."""
    if tuple(streams) != STREAMS:
        return torch.stack([torch.softmax(model.static_logits(points), -1)] * 2)
    static, dynamic = model(points)
    fused = fuse(static, dynamic, model.config.fusion)
    return torch.stack([fused, torch.softmax(static, -1), torch.softmax(dynamic, -1)])
