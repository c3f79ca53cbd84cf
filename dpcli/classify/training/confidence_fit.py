"""Temperature and threshold of a trained network, fitted on its validation videos at the end of a training."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from dpcli.classify.confidence import Confidence, fit_confidence
from dpcli.classify.data.clips import Clip, ClipSource
from dpcli.classify.network.kinet import Kinet
from dpcli.classify.video_scores import batches, clip_scores


@torch.inference_mode()
def fitted_confidence(
    model: Kinet, source: ClipSource, clips_per_video: int, batch: int, device: torch.device, streams: Sequence[str]
) -> Confidence:
    """Returns the confidence fitted to clips of validation videos, and to still ones: each video's first frame, held.

    Leaves the network in evaluation mode.
    """
    model.eval()
    frames, labels = source.config.num_frames, source.reader.labels
    moving = [clip for sequence in source.sequences for clip in source.video_clips(sequence, clips_per_video)]
    still = [Clip(sequence, (0,) * frames) for sequence in source.sequences]

    def scores(clips: list[Clip]) -> np.ndarray:
        made = [clip_scores(model, points.to(device), streams)[0].cpu() for _, points in batches(source, clips, batch)]
        return torch.cat(made).numpy()

    own = np.array([labels[clip.sequence] for clip in moving], np.int64)
    return fit_confidence(scores(moving), own, scores(still), f"{len(source.sequences)} validation videos")
