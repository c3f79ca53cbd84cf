"""Toy objects for `dpc segment`: a box whose drawer slides out while both turn, with the truth beside."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpcli.segment.frame_pairs import frame_parts, true_flow
from dpcli.store import CloudSequence, CloudsWriter, PartsWriter

TRAIN = ("--flow", "nearest", "--points", 48, "--batch", 2, "--epochs", 2, "--set", "pairs_per_epoch=6", "--seed", 3)


def drawer(name: str, seed: int, frames: int = 3, points: int = 60, **fields) -> CloudSequence:
    """A box and a drawer that slides out of it while both turn; the truth beside."""
    rng = np.random.default_rng(seed)
    clouds, parts, poses = [], [], []
    for t in range(frames):
        body = rng.uniform(-0.5, 0.5, (points // 2, 3)) * [0.4, 0.6, 0.5]
        front = rng.uniform(-0.5, 0.5, (points - points // 2, 3)) * [0.1, 0.5, 0.3]
        angle = 0.1 * t
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        pose = np.tile(np.eye(4), (2, 1, 1))
        pose[:, :3, :3] = turn
        pose[1, :3, 3] = turn @ [0.25 + 0.1 * t, 0, 0]
        clouds.append(np.float32(np.concatenate([body @ turn.T, front @ turn.T + pose[1, :3, 3]])))
        parts.append(np.repeat([0, 1], [points // 2, points - points // 2]).astype(np.int16))
        poses.append(pose)
    return CloudSequence.from_frames(name, clouds, part=parts, pose=np.stack(poses), **fields)


def drawers(path: Path, count: int) -> Path:
    """A file of drawers, the last third of them for testing."""
    with CloudsWriter(path, class_names=["drawer"], fields=["part", "pose"]) as writer:
        for i in range(count):
            writer.write(drawer(f"d{i}", i, split="train" if i < count - count // 3 else "test", label=0))
    return path


def with_scene_flow(sequence: CloudSequence) -> CloudSequence:
    """The truth told as displacements to the next frame (the last frame's: to the one before) instead of poses."""
    rows, last = [], sequence.num_frames - 1
    for t in range(sequence.num_frames):
        poses = sequence.pose[t], sequence.pose[t + 1 if t < last else t - 1]
        rows.append(true_flow(sequence.frame(t), frame_parts(sequence, t), *poses))
    sequence.scene_flow = np.float32(np.concatenate(rows))
    return sequence


def predicted(path: Path, sequences: list[CloudSequence], unsure: int = 0, pairs: int | None = None) -> Path:
    """A parts file that says the truth; the last `unsure` points of each frame are in neither part for sure."""
    with PartsWriter(path, num_parts=3, provenance={"command": "dpc segment predict"}) as writer:
        for sequence in sequences:
            probability = np.eye(3, dtype=np.float32)[sequence.part]
            for end in sequence.frame_offsets[1:] if unsure else []:
                probability[end - unsure : end] = [0.2, 0.45, 0.35]
            said = np.array([(t, t + 1) for t in range(sequence.num_frames - 1)][:pairs])
            motion = np.tile(np.eye(4), (len(said), 3, 1, 1))
            motion[:, :2] = sequence.pose[said[:, 1]] @ np.linalg.inv(sequence.pose[said[:, 0]])
            flow = [np.zeros_like(sequence.frame(t)) for t, _ in said]
            sequence.pose = None
            writer.write(sequence, probability, said, motion, flow)
    return path
