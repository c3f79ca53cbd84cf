"""The scene that is made of a fitted model: whose parts it holds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from dpcli.generate4d.config import FIT_PRESETS
from dpcli.generate4d.out.scene_writer import to_scene
from dpcli.generate4d.scene.canonical_gaussians import CanonicalGaussians
from dpcli.generate4d.scene.depth import calm_depth
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


def test_of_motion_along_the_line_of_sight_only_what_is_slow_is_kept():
    """A fit with a shape prior: what comes nearer and trembles comes nearer; the picture stays, as does a fit without one."""
    model = Model4D(CanonicalGaussians(torch.rand(40, 3) - 0.5, torch.zeros(40, 3), opacity=0.9), FIT_PRESETS["tiny"])
    pose, lens = orbit_pose(30.0, 10.0), pinhole(DEFAULT_FOVY, 16, 16)
    targets = Targets("box", torch.zeros(1, 8, 16, 16, 4), lens[None], pose[None], np.arange(8.0), 0)
    forward, axis = model.field.forward, torch.from_numpy(pose[2, :3]).float()

    def swaying(points: torch.Tensor, times: torch.Tensor):
        motion, turn = forward(points, times), 2 * np.pi * (times * 7 / 8)[:, None, None]
        near, tremble = 0.2 * (turn / 2 + np.pi / 16).cos(), 0.1 * (3 * turn + 3 * np.pi / 8).cos()
        shift = (near + tremble) * axis + tremble * torch.linalg.cross(axis, torch.tensor([0.0, 0.0, 1.0]))
        return replace(motion, displacement=motion.displacement + shift)

    model.field.forward = swaying
    asis, calm = (to_scene(model, targets, {}, calm=calm) for calm in (False, True))
    before, after = ((scene.frame_mean @ pose[:3, :3].T + pose[:3, 3]) for scene in (asis, calm))
    np.testing.assert_allclose(after[..., :2] / after[..., 2:], before[..., :2] / before[..., 2:], atol=1e-5)
    depth = before[..., 2].mean(0) + 0.75 * 0.2 * np.cos(np.pi * (np.arange(8) + 0.5) / 8)[:, None]
    np.testing.assert_allclose(after[..., 2], depth, atol=1e-5)
    assert (asis.part == calm.part).all()


def test_depth_of_a_single_frame_and_behind_the_camera_stays():
    pose = orbit_pose(0.0, 0.0)
    places = torch.randn(1, 30, 3) * 0.3
    torch.testing.assert_close(calm_depth(places, pose), places)
    behind = torch.randn(6, 30, 3) + 100 * torch.from_numpy(pose[2, :3]).float() * torch.tensor([-1.0])
    assert torch.equal(calm_depth(behind, pose), behind)
    assert calm_depth(torch.zeros(3, 0, 3), pose).shape == (3, 0, 3)
