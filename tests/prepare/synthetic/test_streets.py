"""Streets: poses carry points from frame to frame, what stands is part 0, and a lidar's rows are its beams."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from dpcli.errors import UsageError
from dpcli.prepare.synthetic.streets import SyntheticStreets
from dpcli.segment.frame_pairs import true_flow


def test_poses_carry_every_part_to_the_next_frame() -> None:
    reader = SyntheticStreets(streets=1, frames=2, movers=6, noise=0.0, dropout=0.0)
    sequence = reader.read(reader.items()[0], np.random.default_rng(3)).sequence
    first, second = sequence.frame(0), sequence.frame(1)
    part = sequence.part[: len(first)]
    flow = true_flow(first, part, sequence.pose[0], sequence.pose[1])
    near = (np.linalg.norm(first, axis=1) < 20) & (first[:, 2] > -1.2)  # the rings on the ground drive along
    assert part.max() >= 1 and (part == 0).mean() > 0.9
    moved, still = (np.median(cKDTree(second).query(cloud[near])[0]) for cloud in (first + flow, first))
    assert moved < 0.1 and moved < still


def test_elevations_are_those_of_the_beams() -> None:
    reader = SyntheticStreets(streets=1, frames=1, rows=16, noise=0.0)
    points = reader.read(reader.items()[0], np.random.default_rng(1)).sequence.frame(0).astype(np.float64)
    elevation = np.degrees(np.arcsin(points[:, 2] / np.linalg.norm(points, axis=1)))
    assert len(points) > 5000 and np.abs(elevation / 2 - np.round(elevation / 2 - 0.5) - 0.5).max() < 1e-3


def test_refuses_another_number_of_rows() -> None:
    with pytest.raises(UsageError, match="--rows 20"):
        SyntheticStreets(rows=20)
