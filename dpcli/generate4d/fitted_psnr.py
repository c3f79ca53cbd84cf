"""PSNR of the views that a model was fitted to: what a fit can say of itself without any ground truth."""

from __future__ import annotations

import math

import torch

from dpcli.generate4d.scene.model import Model4D
from dpcli.generate4d.targets import Targets


@torch.no_grad()
def fitted_psnr(model: Model4D, targets: Targets) -> dict[str, float]:
    """Returns the PSNR in dB of each fitted view on white at the fitted size, mean over its frames.

    Keys are `reference` and `train` with the view's index. The model must be on the CPU.
    """
    values = {}
    for view in range(targets.num_views):
        name = "reference" if view == targets.reference else f"train{view}"
        frames = [_frame_psnr(model, targets, view, frame) for frame in range(targets.num_frames)]
        values[name] = sum(frames) / len(frames)
    return values


def _frame_psnr(model: Model4D, targets: Targets, view: int, frame: int) -> float:
    truth, intrinsics, poses = targets.at([view], [frame])
    instant = model.at(targets.times()[[frame]])
    rendered, _, _ = model.render(instant, poses, intrinsics, *targets.size, torch.ones(1, 3))
    error = (rendered.clamp(0, 1) - (truth[..., :3] + 1 - truth[..., 3:])).square().mean()
    return -10 * math.log10(max(float(error), 1e-10))
