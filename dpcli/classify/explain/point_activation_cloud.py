"""Point activation clouds: how strongly each point of a clip acts in the static and in the dynamic stream.

Rule `activation` (thesis A.1.4, eq. A.2): the largest activation over a centroid's neighborhood and over all channels, in
the layer before the first max-pooling and in the corresponding one of the dynamic branch. It knows no class. Rule
`gradient` (Grad-CAM, Selvaraju et al. 2017): relu(sum_k a_k f_k) with a_k the mean over centroids of a class logit's
gradient with respect to channel k of the last stage's features f.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from dpcli.classify.data.clips import Clip, ClipSource, normalize
from dpcli.classify.explain.features import Layer, stage_layer
from dpcli.classify.network.config import KinetConfig
from dpcli.classify.network.kinet import STREAMS, Kinet, fuse
from dpcli.errors import DataError
from dpcli.store import CloudSequence

_LEAST = 1e-10  # squared distances are clamped to this, so that a coincident point takes all the weight
_ROWS = 4096  # points at a time
_FIRST = {"activation": 0, "gradient": None}  # the stage looked at by default; None: the last


@dataclass(frozen=True)
class Question:
    """Says what is asked of a clip. rule: activation or gradient; stage: 0 the first, None the rule's own;
    target: predicted, label or a class's number, for the rule gradient."""

    rule: Literal["activation", "gradient"] = "activation"
    stage: int | None = None
    target: str | int = "predicted"


@dataclass
class ActivationCloud:
    """Holds the frames of one clip with an activation for each point.

    sequence: all points of the clip's frames as the file has them; frames: their numbers in the video; activation: stream
    -> f32 (P) in 0..1; target: the class asked about (-1 with the rule activation); predicted: the clip's class;
    probability: that class's share in the fused streams (of the static one, where only that was asked for).
    """

    sequence: CloudSequence
    frames: tuple[int, ...]
    activation: dict[str, np.ndarray]
    target: int
    predicted: int
    probability: float


def activation_cloud(
    model: Kinet, source: ClipSource, clip: Clip, streams: tuple[str, ...], question: Question, device: torch.device
) -> ActivationCloud:
    """Returns the activation of every point of a clip's frames, by stream: `streams` of static, dynamic, fused.

    A point takes the inverse-squared-distance mean of the three centroids nearest in space and time (see `carry`). Then
    each stream's values are mapped linearly such that the clip's smallest is 0 and its largest 1 (all 0 where they are
    equal). `fused` is the mean of both streams' maps.
    Raises DataError on target `label` for a video without one, and on a clip without points.
    """
    fields = [field for field in source.reader.fields if field != "scene_flow"]  # its next frame may not be the clip's
    sequence = source.reader.read(clip.sequence, clip.frames, fields)
    if not len(sequence.points):
        raise DataError(
            f"{source.reader.path}: frames {clip.frames[0]} to {clip.frames[-1]} of {sequence.name!r} have no points"
        )
    drawn = raw_points(source, clip)
    points = normalize(drawn, source.config.normalize)
    queries = _in_network_coordinates(sequence, drawn, points)
    given = torch.from_numpy(np.ascontiguousarray(points, np.float32))[None].to(device)
    probability = _probability(model, given, only_static=streams == ("static",))
    predicted = int(probability.argmax())
    target = -1 if question.rule == "activation" else _target(question.target, predicted, sequence)
    own = STREAMS if "fused" in streams else streams
    found = {}
    for stream in own:
        stage = _FIRST[question.rule] if question.stage is None else question.stage
        layer = stage_layer(model, given, stream, stage, None if target < 0 else target)
        found[stream] = rescaled(
            np.concatenate(carry(layer, centroid_activation(layer), queries, frame_length(model.config)))
        )
    if "fused" in streams:
        found["fused"] = (found["static"] + found["dynamic"]) / 2
    return ActivationCloud(
        sequence,
        clip.frames,
        {stream: found[stream] for stream in streams},
        target,
        predicted,
        float(probability[predicted]),
    )


@torch.no_grad()
def _probability(model: Kinet, points: Tensor, only_static: bool) -> Tensor:
    """Returns the probabilities (C) of both streams, or of the static one where the other, perhaps untrained, isn't asked for."""
    if only_static:
        return torch.softmax(model.static_logits(points), -1)[0]
    return fuse(*model(points), model.config.fusion)[0]


def _target(wanted: str | int, predicted: int, sequence: CloudSequence) -> int:
    if wanted == "predicted":
        return predicted
    if wanted == "label":
        if sequence.label < 0:
            raise DataError(f"sample {sequence.name!r} has no label; class = predicted explains what the network sees")
        return sequence.label
    return int(wanted)


def channel_weights(layer: Layer) -> Tensor:
    """Returns Grad-CAM's weight of each channel (C): the mean over centroids of the class logit's gradient."""
    return layer.gradient.mean(0)


def centroid_activation(layer: Layer) -> Tensor:
    """Returns one value (M) a centroid: eq. A.2's maximum over channels, or Grad-CAM's weighted sum where there is a gradient."""
    if layer.gradient is None:
        return layer.values.amax(-1)
    return torch.relu(layer.values @ channel_weights(layer))


def carry(layer: Layer, values: Tensor, queries: list[np.ndarray], frame_length: float) -> list[np.ndarray]:
    """Returns values (M) of the centroids at the points (N_t,3) of each frame t, f32 (N_t): inverse-squared-distance mean of the
    three nearest centroids in space and time, where a frame counts as `frame_length`.

    As `ops.three_nn_interpolate` in four dimensions (of equally near centroids any may be taken). With the frame's own
    centroids alone, what stands still would go without in most frames: farthest points of all frames together take it once.
    """
    known = torch.cat([layer.centers, layer.times[:, None] * frame_length], -1).double().cpu()
    values = values.double().cpu()
    carried = []
    for t, query in enumerate(queries):
        where = torch.cat(
            [torch.from_numpy(query).double(), torch.full((len(query), 1), t * frame_length).double()], -1
        )
        found = [_interpolated(block, known, values) for block in where.split(_ROWS)]
        carried.append(torch.cat(found).numpy().astype(np.float32))
    return carried


def _interpolated(query: Tensor, known: Tensor, values: Tensor) -> Tensor:
    distance = torch.cdist(query, known, compute_mode="donot_use_mm_for_euclid_dist")
    distance, near = distance.topk(min(3, len(known)), largest=False)
    weight = distance.square().clamp(min=_LEAST).reciprocal()
    return (weight * values[near]).sum(-1) / weight.sum(-1)


def frame_length(config: KinetConfig) -> float:
    """Returns a frame as a length, in the network's unit: such that a neighborhood of the first stage ends as far off in time (one
    frame beyond its temporal radius) as in space."""
    return config.radii[0] / (config.temporal_radius + 1)


def rescaled(values: np.ndarray) -> np.ndarray:
    """Returns f32 values mapped linearly to 0..1; zeros where all are equal."""
    low, high = float(values.min()), float(values.max())
    return ((values - low) / (high - low)).astype(np.float32) if high > low else np.zeros(len(values), np.float32)


def raw_points(source: ClipSource, clip: Clip) -> np.ndarray:
    """Returns the points f32 (T,P,3) that prediction draws from a clip, in the file's coordinates."""
    plain = ClipSource(
        source.reader, [clip.sequence], source.config.changed(normalize="none"), timing=source.timing, seed=source.seed
    )
    return plain.load_shown(clip)


def _in_network_coordinates(sequence: CloudSequence, drawn: np.ndarray, points: np.ndarray) -> list[np.ndarray]:
    """Returns all points of each frame, f32 (N_t,3), moved as normalization moved the drawn ones: an affine map of each axis."""
    before, after = drawn.reshape(-1, 3).astype(np.float64), points.reshape(-1, 3).astype(np.float64)
    ends = before.argmin(0), before.argmax(0)
    axes = np.arange(3)
    extent = before[ends[1], axes] - before[ends[0], axes]
    change = after[ends[1], axes] - after[ends[0], axes]
    scale = np.where(extent > 0, change / np.where(extent > 0, extent, 1), 1)
    shift = after[ends[0], axes] - scale * before[ends[0], axes]
    return [(sequence.frame(t) * scale + shift).astype(np.float32) for t in range(sequence.num_frames)]
