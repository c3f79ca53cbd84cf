"""The scene that is made of a fitted model: whose parts it holds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from dpcli.generate4d.config import FIT_PRESETS
from dpcli.generate4d.out.scene_writer import to_scene
from dpcli.generate4d.scene.canonical_gaussians import CanonicalGaussians
from dpcli.generate4d.scene.model import Model4D
from dpcli.generate4d.targets import Targets
from dpcli.ops.cameras import DEFAULT_FOVY, orbit_pose, pinhole


def test_parts_are_those_that_move_apart_unless_the_temporal_cue_is_off():
    """A model whose left half rises while the right one stays, by a network that has three parts anyway."""
    torch.manual_seed(0)
    mean, lens = torch.rand(600, 3) - 0.5, pinhole(DEFAULT_FOVY, 16, 16)
    targets = Targets("box", torch.zeros(1, 6, 16, 16, 4), lens[None], orbit_pose(0.0, 0.0)[None], np.arange(6.0), 0)
    config = replace(FIT_PRESETS["tiny"], parts=12)
    assert config.blended_parts == 8 and FIT_PRESETS["tiny"].blended_parts == 3
    model = Model4D(CanonicalGaussians(mean, torch.zeros(600, 3), opacity=0.9), config)
    model.field.start_parts(mean, mean[:8])
    found = {}
    for temporal in (True, False):
        model.config = replace(config, temporal=temporal)
        found[temporal] = to_scene(model, targets, {})
    assert found[True].num_parts == 1 and found[False].num_parts == 8  # nothing moves yet
    forward = model.field.forward

    def lifted(points: torch.Tensor, times: torch.Tensor):
        motion = forward(points, times)
        shift = 0.3 * times[:, None, None] * (points[:, :1] < 0) * torch.tensor([0.0, 1.0, 0.0])
        return replace(motion, displacement=motion.displacement + shift)

    model.field.forward = lifted
    model.config = config
    scene = to_scene(model, targets, {})
    assert scene.num_parts == 2 and set(np.unique(scene.part_probability)) == {0.0, 1.0}
    left = mean[:, 0].numpy() < 0
    assert np.mean((scene.part == scene.part[left][0]) == left) > 0.95
    assert np.isclose(sorted(scene.part_motion[-1, :, 1, 3]), [0, 0.3], atol=0.05).all()
