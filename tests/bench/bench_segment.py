"""Speed of `dpc segment predict`: procedural objects of 4 x 512 points with the shipped weights, stage by stage.

    python -m tests.bench.bench_segment [--objects 5] [--repeat 5]

Wall and processor time in ms, the least of `repeat` runs, mean over the objects; the model is loaded and every kernel
compiled before. Stages run in one thread, as they do inside a prediction, the whole in all. Beside it the same under
DPC_BACKEND=torch, run twice at most. Both must give the same parts but for one point in a hundred, or the bench fails;
so it does where a whole prediction takes longer than the limit.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from functools import partial

import numpy as np
import torch

from dpcli.ops import weighted_kabsch
from dpcli.prepare.articulated.synthetic_articulated import SyntheticArticulated
from dpcli.runtime.seeds import generator
from dpcli.segment.flow.estimators import estimate_flow_both_ways
from dpcli.segment.flow.object_aware_icp import object_aware_icp
from dpcli.segment.network.model_file import default_model, load_model
from dpcli.segment.prediction import predict_parts
from dpcli.segment.prediction_settings import Refinement
from dpcli.segment.segmenters import NetworkSegmenter
from dpcli.store import CloudSequence
from tests.support.ops_helpers import backend

LIMIT_S = 0.5
Stage = Callable[[CloudSequence], object]


def objects(count: int) -> list[CloudSequence]:
    reader = SyntheticArticulated(objects=count, sequences_per_object=1)
    return [reader.read(item, generator(0, k)).sequence for k, item in enumerate(reader.items())]


def stages() -> dict[str, Stage]:
    """What a prediction does, alone and whole."""
    segmenter = NetworkSegmenter(load_model(default_model())[0], torch.device("cpu"))
    flow = partial(estimate_flow_both_ways, method="icp")

    def frames(sequence: CloudSequence) -> list[torch.Tensor]:
        return [torch.from_numpy(sequence.frame(t)) for t in range(sequence.num_frames)]

    def refine(sequence: CloudSequence) -> object:
        clouds = torch.stack(frames(sequence))
        rng = torch.Generator().manual_seed(0)
        mask = torch.softmax(4 * torch.randn(*clouds.shape[:2], 8, generator=rng), -1)
        order = torch.arange(8).expand(len(clouds) - 1, -1)
        return object_aware_icp(clouds[:-1], clouds[1:], mask[:-1], mask[1:], torch.zeros_like(clouds[1:]), 20, order)

    def kabsch(sequence: CloudSequence) -> object:
        clouds = torch.stack(frames(sequence))
        return weighted_kabsch(clouds[:-1], clouds[1:], torch.ones(len(clouds) - 1, clouds.shape[1], 8))

    def flows(sequence: CloudSequence) -> object:
        clouds = frames(sequence)
        return [flow(a, b) for a, b in zip(clouds, clouds[1:])]

    return {
        "flow of 3 pairs, ICP": flows,
        "network, 4 frames": lambda sequence: segmenter.segment(frames(sequence), {}),
        "object-aware ICP, 3 pairs, 20 steps": refine,
        "weighted Kabsch, 3 pairs, 8 slots": kabsch,
        "whole prediction": lambda sequence: predict_parts(sequence, segmenter, flow, Refinement(), 0)[0],
    }


def least_ms(stage: Stage, sequences: list[CloudSequence], repeat: int) -> tuple[float, float]:
    """Mean over the sequences of the least wall and the least processor time."""
    total = np.zeros(2)
    for sequence in sequences:
        runs = []
        for _ in range(repeat):
            start = np.array([time.perf_counter(), time.process_time()])
            stage(sequence)
            runs.append(np.array([time.perf_counter(), time.process_time()]) - start)
        total += np.min(runs, 0)
    wall, processor = 1e3 * total / len(sequences)
    return wall, processor


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--objects", type=int, default=5)
    parser.add_argument("--repeat", type=int, default=5)
    options = parser.parse_args()
    sequences, work = objects(options.objects), stages()
    whole = work["whole prediction"]
    parts = [whole(sequence) for sequence in sequences]
    with backend("torch"):
        same = np.mean([np.mean(own == whole(sequence)) for own, sequence in zip(parts, sequences)])
    if same < 0.99:
        sys.exit(f"parts differ from the reference's at {100 * (1 - same):.1f} % of the points")
    print(
        f"{torch.get_num_threads()} torch threads, load {os.getloadavg()[0]:.1f}; same parts at {100 * same:.2f} %; ms"
    )
    print(f"{'stage':38} {'wall':>8} {'cpu':>8}   torch: {'wall':>8} {'cpu':>8}")
    threads = torch.get_num_threads()
    for name, stage in work.items():
        torch.set_num_threads(threads if stage is whole else 1)  # as inside a prediction of few points
        wall, processor = least_ms(stage, sequences, options.repeat)
        with backend("torch"):
            slow = least_ms(stage, sequences, min(options.repeat, 2))
        print(f"{name:38} {wall:8.1f} {processor:8.1f}          {slow[0]:8.1f} {slow[1]:8.1f}", flush=True)
    if wall > 1e3 * LIMIT_S:
        sys.exit(f"a prediction takes {wall:.0f} ms; the limit is {1e3 * LIMIT_S:.0f} ms")


if __name__ == "__main__":
    main()
