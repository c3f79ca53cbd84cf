"""The accuracy of the streams of a network in training on the validation videos."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from dpcli.classify.data.clips import ClipSource
from dpcli.classify.network.kinet import Kinet, fuse
from dpcli.classify.training.schedule import Schedule
from dpcli.classify.video_scores import batches
from dpcli.runtime.distributed import Processes


@torch.inference_mode()
def validation_accuracy(
    model: Kinet,
    source: ClipSource,
    schedule: Schedule,
    processes: Processes,
    device: torch.device,
    streams: Sequence[str],
) -> dict[str, float]:
    """Returns the share of videos that are classified rightly, scores averaged over clips, for each of the streams.

    streams: `static` alone, or `static`, `dynamic` and `fused`. Each process scores a share of the videos. Leaves the
    network in evaluation mode.
    """
    model.eval()
    mine = set(source.sequences[processes.rank :: processes.count])
    clips = [clip for clip in source.clips(schedule.validation_clips) if clip.sequence in mine]
    totals: dict[str, dict[int, torch.Tensor]] = {name: {} for name in streams}
    for chosen, points in batches(source, clips, schedule.batch):
        for key, scores in _scores(model, points.to(device), len(streams) == 1).items():
            for clip, row in zip(chosen, scores.cpu()):
                totals[key][clip.sequence] = totals[key].get(clip.sequence, 0) + row
    labels = source.reader.labels
    right = [sum(int(row.argmax()) == int(labels[s]) for s, row in sums.items()) for sums in totals.values()]
    counted = processes.sums([*map(float, right), float(len(mine))], device)
    return dict(zip(totals, (value / counted[-1] for value in counted[:-1])))


def _scores(model: Kinet, points: torch.Tensor, static_only: bool) -> dict[str, torch.Tensor]:
    """Returns the class probabilities (B,C) of a batch of clips by stream."""
    if static_only:
        return {"static": torch.softmax(model.static_logits(points), -1)}
    static, dynamic = model(points)
    fused = fuse(static, dynamic, model.config.fusion)
    return {"static": torch.softmax(static, -1), "dynamic": torch.softmax(dynamic, -1), "fused": fused}
