"""Bodies that hold two parts are split, though no pair of frames proposed the motion of one of them."""

from __future__ import annotations

import numpy as np
import torch

from dpcli.segment.multibody.explanation import body_of, label_points
from dpcli.segment.multibody.frames import Frames, Trajectory, relative_motion
from dpcli.segment.multibody.hypotheses import Hypothesis
from dpcli.segment.multibody.search import Search
from dpcli.segment.multibody.settings import MultibodySettings
from dpcli.segment.multibody.splits import split_bodies
from dpcli.segment.rigid_motions import move
from dpcli.segment.training.trainer import rand_index

STEP = 0.3  # radians that the second link turns by in a frame


def turn_about_z(angle: float, at: tuple[float, float, float]) -> np.ndarray:
    """Returns the motion (3,4) that turns about a line along z through a point."""
    rotation = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    return np.concatenate([rotation, (at - rotation @ at)[:, None]], 1)


def two_links(frames: int = 4, points: int = 200) -> tuple[list[np.ndarray], np.ndarray, list[Trajectory]]:
    """Returns clouds (N,3), labels (frames N) and trajectories of two bars on a hinge, drawn anew in each frame."""
    rng, size = np.random.default_rng(3), np.array([0.4, 0.08, 0.15])
    still = np.tile(np.eye(3, 4), (frames, 1, 1))
    turning = np.stack([turn_about_z(STEP * t, (0.42, 0.04, 0.0)) for t in range(frames)])
    clouds = []
    for t in range(frames):
        links = []
        for left, motion in ((0.0, still[t]), (0.44, turning[t])):
            drawn, axis = rng.random((points, 3)), rng.choice(3, points, p=[0.12, 0.57, 0.31])
            drawn[np.arange(points), axis] = rng.integers(0, 2, points)
            links.append(move(motion, drawn * size + [left, 0, 0]))
        clouds.append(np.float32(np.concatenate(links)))
    return clouds, np.tile(np.repeat([0, 1], points), frames), [still, turning]


def test_a_patch_of_a_body_gets_the_motion_of_its_part():
    clouds, part, (still, turning) = two_links()
    frames = Frames(clouds)
    one = label_points(frames, [body_of(frames, still)], MultibodySettings())
    second = clouds[0][200:]
    gaps = [
        np.linalg.norm(
            move(relative_motion(body.trajectory, 0, 3) - relative_motion(turning, 0, 3), second), axis=1
        ).mean()
        for body in split_bodies(frames, one)
    ]
    assert min(gaps) < 1.5 * frames.spacing  # which fits to the part's points reach; it begins 13 spacings away


def test_the_search_finds_a_part_whose_motion_nobody_proposed():
    clouds, part, (still, _) = two_links()
    search = Search(Frames(clouds), MultibodySettings(), [Hypothesis(0, clouds[0], still)])
    found = search.improve(search.begin())
    assert len(found.bodies) == 2
    assert rand_index(torch.from_numpy(found.label), torch.from_numpy(part)) > 0.9
