"""A small articulated truth and predictions of it, for tests of parts files and their evaluation."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dpcli.store import CloudSequence, CloudsWriter, PartsWriter

CLASS_NAMES = ("door", "lamp")
CHAIN = np.array([[0, 1], [1, 2], [2, 1]], np.int32)


def rotation(rng: np.random.Generator, angle: float | None = None) -> np.ndarray:
    """A random rotation f64 (3,3), by `angle` radians or any (Rodrigues)."""
    axis = rng.normal(size=3)
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = rng.uniform(-np.pi, np.pi) if angle is None else angle
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def rigid(rng: np.random.Generator, scale: float = 0.3, angle: float | None = None) -> np.ndarray:
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = rotation(rng, angle), rng.uniform(-scale, scale, 3)
    return motion


def truth_sequence(
    name: str,
    seed: int = 0,
    parts: int = 3,
    frames: int = 3,
    label: int = 0,
    split: str = "test",
    pad: int = 3,
    points: int = 40,
) -> CloudSequence:
    """Independent points of each part in each frame, moved by the part's pose; poses padded with identities."""
    rng = np.random.default_rng(seed)
    pose = np.tile(np.eye(4), (frames, pad, 1, 1))
    clouds, ids = [], []
    for t in range(frames):
        pose[t, :parts] = [rigid(rng) for _ in range(parts)]
        part = rng.permutation(np.arange(points + t) % parts).astype(np.int16)
        local = rng.uniform(-0.2, 0.2, (len(part), 3)) + part[:, None]
        own = pose[t, part]
        clouds.append(np.einsum("nij,nj->ni", own[:, :3, :3], local) + own[:, :3, 3])
        ids.append(part)
    return CloudSequence.from_frames(name, clouds, part=ids, pose=pose, label=label, split=split)


def write_truth(path: Path, sequences: list[CloudSequence], **options) -> Path:
    options = {"class_names": CLASS_NAMES, "fields": ["part", "pose"], "length_unit": "m", **options}
    with CloudsWriter(path, **options) as writer:
        for sequence in sequences:
            writer.write(sequence)
    return path


def perfect(truth: CloudSequence, num_parts: int, pairs: np.ndarray = CHAIN, slots: np.ndarray | None = None) -> tuple:
    """Arguments of PartsWriter.write that say the truth, part s under the id slots[s]."""
    slots = np.arange(num_parts) if slots is None else slots
    part = slots[truth.part].astype(np.int16)
    probability = np.full((len(part), num_parts), 0.1 / max(num_parts - 1, 1), np.float32)
    probability[np.arange(len(part)), part] = 0.9
    motion, flow = np.tile(np.eye(4), (len(pairs), num_parts, 1, 1)), []
    for row, (i, j) in enumerate(pairs.tolist()):
        for s in range(truth.pose.shape[1]):
            motion[row, slots[s]] = truth.pose[j, s] @ np.linalg.inv(truth.pose[i, s])
        span = slice(*truth.frame_offsets[i : i + 2].tolist())
        own = motion[row, part[span]]
        moved = np.einsum("nij,nj->ni", own[:, :3, :3], truth.points[span]) + own[:, :3, 3]
        flow.append((moved - truth.points[span]).astype(np.float32))
    sequence = CloudSequence(truth.name, truth.points, truth.frame_offsets, truth.split, truth.label, part=part)
    return sequence, probability, pairs, motion.astype(np.float32), flow


def write_parts(path: Path, samples: list[tuple], num_parts: int = 4, **options) -> Path:
    options = {"class_names": CLASS_NAMES, "length_unit": "m", **options}
    with PartsWriter(path, num_parts=num_parts, **options) as writer:
        for sample in samples:
            writer.write(*sample)
    return path
