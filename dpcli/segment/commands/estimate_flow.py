"""`dpc segment estimate-flow`: the scene flow of every frame, as a field of a clouds file or as points (flow-based framework, A.1.5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch

from dpcli.runtime import provenance
from dpcli.runtime.device import choose_device, cpu_count
from dpcli.runtime.machines.shards import describe_shard
from dpcli.runtime.machines.spread import ALONE, Spread
from dpcli.runtime.progress import log
from dpcli.runtime.seeds import SegmentStream, generator
from dpcli.runtime.tuning import keep_freed_memory
from dpcli.segment.flow.estimators import METHODS, estimate_flow, find_estimator
from dpcli.segment.sequence_splits import sequences_of_split
from dpcli.store import CloudSequence, CloudsReader, CloudsWriter, input_file, output_file
from dpcli.store.writing.already_made import WORK, already_made
from dpcli.store.writing.item_pass import ItemPass, Wording, skipped_lines

REACH = 99  # percentile of norms that stands for the largest: a few wrong matches must not decide the scale
_NO_MOTION = 1e-9  # of the cloud's reach: below this flow is rounding, and no factor makes it a cloud
_WORTH_WORKERS = 200  # frames; fewer are done by one process before a second has started


@dataclass(frozen=True)
class FlowOfSequence:
    """Estimates the flow of one sequence; picklable, for worker processes.

    flow: icp, nearest, or a trained estimator. points: drawn from each frame, 0 = all. as_points: whether the flow vectors
    take the place of the points.
    """

    flow: str
    points: int = 512
    as_points: bool = False
    seed: int = 0
    device: str = "cpu"

    def fields(self, given: Sequence[str]) -> list[str]:
        """Returns the fields of the result: those of the input beside the flow; only the time where flow is the points."""
        if self.as_points:
            return [name for name in given if name == "time"]
        return [*(name for name in given if name != "scene_flow"), "scene_flow"]

    def __call__(self, sequence: CloudSequence) -> CloudSequence:
        """Returns some points of each frame of a sequence, and their flow."""
        if self.flow not in METHODS:
            choose_device(self.device)  # a worker multiplies matrices by the library that the command itself chose
        drawn = draw_points(sequence, self.points, generator(self.seed, SegmentStream.FLOW_POINTS))
        whole = [sequence.frame(t) for t in range(sequence.num_frames)]
        drawn.scene_flow = sequence_flow(drawn, whole, self.flow, self.device)
        if self.as_points:
            drawn.points, drawn.scene_flow, drawn.shift = flow_as_points(drawn), None, None  # vectors are at no place
        return drawn


def draw_points(sequence: CloudSequence, points: int, rng: np.random.Generator) -> CloudSequence:
    """Returns at most `points` random points of each frame in their own order, with their fields; 0 keeps all."""
    starts, counts = sequence.frame_offsets[:-1], np.diff(sequence.frame_offsets)
    keep = [
        start + (np.sort(rng.choice(count, points, replace=False)) if 0 < points < count else np.arange(count))
        for start, count in zip(starts, counts)
    ]
    drawn = replace(sequence)
    offsets = np.concatenate([[0], np.cumsum([len(own) for own in keep])]).astype(np.int64)
    drawn.take_points(np.concatenate(keep).astype(np.int64), offsets)
    return drawn


def sequence_flow(drawn: CloudSequence, whole: list[np.ndarray], flow: str, device: str = "cpu") -> np.ndarray:
    """Returns the flow f32 (P,3) of the points drawn from the frames `whole`: to the next frame, of the last frame back.

    icp and nearest look for the points in the whole next frame (icp in 1,024 of its points at most), a trained
    estimator in the points drawn from it, as it was trained. Zero in a single frame and toward a frame without points.
    """
    frames = [drawn.frame(t) for t in range(drawn.num_frames)]
    if len(frames) == 1:
        return np.zeros_like(drawn.points)
    targets = whole if flow in METHODS else frames
    pairs = zip(frames, [*targets[1:], targets[-2]])
    return np.concatenate([_frame_flow(*pair, flow, device) for pair in pairs]).astype(np.float32, copy=False)


def _frame_flow(points: np.ndarray, target: np.ndarray, flow: str, device: str) -> np.ndarray:
    """Returns the flow f32 (N,3) of points (N,3) toward a frame (M,3); zero where either has no points."""
    if min(len(points), len(target)) == 0:
        return np.zeros_like(points)
    pair = (torch.from_numpy(np.ascontiguousarray(cloud))[None] for cloud in (points, target))
    return estimate_flow(*pair, method=flow, device=device)[0].numpy()


def flow_as_points(sequence: CloudSequence) -> np.ndarray:
    """Returns flow f32 (P,3) scaled to the range of the coordinates (thesis A.1.5.2), forward in time in all frames.

    One factor a sequence: the 99th percentile of the flow's norms becomes that of the distances of all points from
    their mean. The largest norm counts where that percentile is 0; flow below 1e-9 of the distances becomes 0.
    """
    flow = sequence.scene_flow.astype(np.float64)
    if sequence.num_frames > 1:
        flow[sequence.frame_offsets[-2] :] *= -1
    wanted = np.percentile(np.linalg.norm(sequence.points - sequence.points.mean(0, dtype=np.float64), axis=1), REACH)
    norms = np.linalg.norm(flow, axis=1)
    reach = np.percentile(norms, REACH)
    if reach <= _NO_MOTION * wanted:
        reach = norms.max()
    factor = wanted / reach if reach > _NO_MOTION * wanted else 0.0
    return np.float32(flow * factor)


class EstimatedFlow(NamedTuple):
    """Holds how much flow was estimated."""

    sequences: int
    frames: int


def estimate_flow_of_file(
    data: str,
    output: str,
    *,
    flow: str,
    points: int,
    as_points: bool,
    split: str,
    seed: int,
    device: str,
    force: bool,
    spread: Spread = ALONE,
) -> EstimatedFlow:
    """Writes the flow of a clouds file; running again continues where a stopped or killed run ended.

    flow, points, as_points: see `FlowOfSequence`. spread: who works on which sequences.
    """
    weights = find_estimator(flow)
    with input_file(data) as path, output_file(output) as target:
        reader = CloudsReader(path)
        chosen = sequences_of_split(reader, split, data)
        config = {"flow": "estimator" if weights else flow, "points": points, "as_points": as_points, "split": split}
        inputs = {"clouds": path} | ({"flow": weights} if weights else {})
        entry = describe_shard(provenance.record(config, seed, inputs), spread.shard)
        device = str(choose_device(device)) if weights else "cpu"
        work = FlowOfSequence(str(weights.resolve()) if weights else flow, points, as_points, seed, device)
        if force or not already_made(target, entry, CloudsReader, WORK):
            keep_freed_memory()
            with CloudsWriter(
                target,
                class_names=reader.class_names,
                length_unit=reader.length_unit,
                seed=seed,
                source=reader.path.name if data != "-" else "stdin",
                provenance=[*reader.provenance, entry],
                fields=work.fields(reader.fields),
                force=force,
                resume=output != "-",
            ) as writer:
                _estimate_sequences(reader, chosen, work, writer, spread)
        with CloudsReader(target) as made:
            for line in skipped_lines(made.skipped):
                log.warn(line)
            return EstimatedFlow(len(made), int(made.frame_counts.sum()))


def _worthwhile_processes(work: FlowOfSequence, frames: int) -> int:
    """Returns how many processes are worthwhile: one for each core for the search of rigid bodies, which uses one core, else one."""
    return cpu_count() if work.flow == "icp" and frames > _WORTH_WORKERS else 1


def _estimate_sequences(
    reader: CloudsReader, chosen: list[int], work: FlowOfSequence, writer: CloudsWriter, spread: Spread
) -> None:
    """Writes the flow of the sequences that an earlier run has not written."""
    read = [name for name in work.fields(reader.fields) if name in reader.fields and name != "scene_flow"]

    def write(place: int, sequence: CloudSequence) -> dict[str, float]:
        writer.write(sequence)
        return {"frames": sequence.num_frames}

    def load(place: int) -> CloudSequence:
        return reader.read(chosen[place], fields=read)

    names, words = [reader.names[i] for i in chosen], Wording("segment estimate-flow", "sequence", "estimated")
    taken = ItemPass(writer, names, words, spread.shard)
    with spread.workers(_worthwhile_processes(work, int(reader.frame_counts[chosen].sum()))) as workers:
        taken.run(work, load, write, workers)
