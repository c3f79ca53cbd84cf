"""The accuracy of the streams of a network in training on the validation videos."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from dpcli.classify.data.clips import ClipSource
from dpcli.classify.network.kinet import Kinet
from dpcli.classify.training.schedule import Schedule
from dpcli.classify.video_scores import batches, clip_scores
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
        scores = clip_scores(model, points.to(device), streams[:2]).cpu()
        for key, rows in zip(("fused", *streams[:2]), scores):
            for clip, row in zip(chosen, rows if key in totals else ()):
                totals[key][clip.sequence] = totals[key].get(clip.sequence, 0) + row
    labels = source.reader.labels
    right = [sum(int(row.argmax()) == int(labels[s]) for s, row in sums.items()) for sums in totals.values()]
    counted = processes.sums([*map(float, right), float(len(mine))], device)
    return dict(zip(totals, (value / counted[-1] for value in counted[:-1])))
