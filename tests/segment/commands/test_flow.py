"""`dpc segment flow`, and the estimator it makes in other commands."""

from __future__ import annotations

import numpy as np

from dpcli.store import CloudSequence, CloudsWriter
from tests.support.drawers import TRAIN


def test_a_flow_estimator_is_trained_and_used(dpc_here, one_thread, data, tmp_path):
    folder = tmp_path / "flow"
    done = dpc_here("segment", "flow", data, "-o", folder, "--steps", 3, "--batch", 2, "--set", "points=48")
    assert done.returncode == 0, done.stderr.decode()
    assert (folder / "curves.png").exists() and done.stdout.decode().strip().endswith("best.safetensors")
    words = ("segment", "predict", data, "--method", "ward", "--flow", folder, "-o", tmp_path / "p.h5")
    used = dpc_here(*words)
    assert used.returncode == 0, used.stderr.decode()
    again = dpc_here(*words)
    assert again.returncode == 0 and b"already complete" in again.stderr
    learn = ("segment", "train", data, "-o", tmp_path / "run", *TRAIN[2:], "--flow", folder)
    assert dpc_here(*learn).returncode == 0
    weights = folder / "best.safetensors"  # the estimator is trained on: the same path, another network
    header, tensors = weights.read_bytes()[:-4], weights.read_bytes()[-4:]
    weights.write_bytes(header + bytes(byte ^ 1 for byte in tensors))
    other = dpc_here(*words)
    assert other.returncode == 2 and b"exists, made with another flow file" in other.stderr
    other = dpc_here(*learn)
    assert other.returncode == 2 and b"another configuration (other flow weights" in other.stderr, other.stderr


def test_nothing_is_learned_from_what_is_held_out(dpc_here, tmp_path):
    frames = list(np.random.default_rng(0).random((2, 40, 3), np.float32))
    with CloudsWriter(tmp_path / "c.h5", class_names=[], length_unit="m") as writer:
        for split in ("validation", "test"):
            writer.write(CloudSequence.from_frames(split, frames, split=split))
    done = dpc_here("segment", "flow", tmp_path / "c.h5", "-o", tmp_path / "flow", "--steps", 1)
    assert done.returncode == 3 and b"no sequence of split 'train', or without a split" in done.stderr
