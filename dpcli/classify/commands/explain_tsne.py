"""`dpc classify explain tsne`: videos in the plane, and how well neighbors and classes agree."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dpcli.classify.commands.explain_inputs import check_targets, chosen_streams
from dpcli.classify.commands.model_task import ModelTask
from dpcli.classify.data.videos import check_classes, select_videos
from dpcli.classify.explain.pictures import plane_picture
from dpcli.classify.explain.tsne import (
    NEIGHBORS,
    chosen_perplexity,
    joined_features,
    neighbor_accuracy,
    plane,
    silhouette,
    video_features,
)
from dpcli.classify.network.model_file import ModelInfo, load_model
from dpcli.counted import counted
from dpcli.runtime import provenance
from dpcli.runtime.device import choose_device
from dpcli.runtime.progress import log
from dpcli.runtime.tuning import keep_freed_memory
from dpcli.runtime.whole_file import FIGURES
from dpcli.store import CloudsReader, input_file, output_file
from dpcli.store.embedding import StreamEmbedding, write_embedding


@dataclass(frozen=True)
class TsneRequest:
    """Says which streams' features are embedded, and how. stream: names with commas between, None for those that were trained.

    perplexity: None for 30, at most a third of the videos. clips_per_video: averaged for a video, None takes every start.
    """

    stream: str | None = None
    perplexity: float | None = None
    clips_per_video: int | None = 4
    batch: int = 8
    picture: Path | None = None


@dataclass(frozen=True)
class Embedding:
    """Holds the videos in the plane by stream, their labels i32 (S), -1 where unknown, and the perplexity."""

    streams: dict[str, StreamEmbedding]
    labels: np.ndarray
    perplexity: float

    def report(self) -> dict[str, Any]:
        """Returns the object that `--json` prints."""
        metrics = {
            f"{stream}_{key}": embedding.values.get(key)
            for stream, embedding in self.streams.items()
            for key in ("neighbor_accuracy", "silhouette")
        }
        return {
            "metrics": metrics,
            "units": {key: "-1..1" if key.endswith("silhouette") else "fraction" for key in metrics},
            "videos": len(self.labels),
            "labeled": int((self.labels >= 0).sum()),
            "neighbors": NEIGHBORS,
            "perplexity": self.perplexity,
        }

    def lines(self) -> list[str]:
        """Returns the same for a person, one line a stream below a heading."""
        heading = (
            f"{counted(len(self.labels), 'video')}, perplexity {self.perplexity:.3g}; of the features, not of the map:"
        )
        return [heading] + [
            f"{stream:<8} {embedding.features.shape[1]:>5} numbers, {_caption(embedding)}"
            for stream, embedding in self.streams.items()
        ]


def explain_tsne(task: ModelTask, request: TsneRequest) -> Embedding:
    """Embeds the videos of a file by t-SNE of their features, writes them, and draws them.

    Raises UsageError for options that don't fit the model, DataError for too few videos.
    """
    check_targets(str(task.output), task.force, (request.picture, "--picture", FIGURES))
    device = choose_device(task.device)
    model, info = load_model(task.model, task.backbone)
    streams = chosen_streams(request.stream, info)
    with input_file(task.data) as path, output_file(task.output) as place:
        reader = CloudsReader(path)
        check_classes(reader, info, task.model)
        sequences = select_videos(reader, task.split, info, task.model)
        perplexity = chosen_perplexity(request.perplexity, len(sequences))
        source = task.clips(reader, sequences, info)
        keep_freed_memory()
        features = video_features(model.to(device), source, request.clips_per_video, request.batch, device)
        if "fused" in streams:
            features["fused"] = joined_features(features)
        labels = reader.labels[sequences]
        _tell_what_is_missing(labels)
        embeddings = {s: _embedding(features[s], labels, perplexity, task.seed) for s in streams}
        entry = provenance.record(_record(task, request, streams, perplexity, info), task.seed, {"clouds": path})
        write_embedding(
            place,
            [reader.names[i] for i in sequences],
            labels,
            [reader.splits[i] for i in sequences],
            embeddings,
            class_names=info.class_names,
            source=task.source,
            seed=task.seed,
            provenance=[*reader.provenance, entry],
            force=task.force,
        )
        if request.picture:
            captions = {s: _caption(embedding) for s, embedding in embeddings.items()}
            coordinates = {s: embedding.coordinates for s, embedding in embeddings.items()}
            plane_picture(request.picture, coordinates, labels, info.class_names, captions)
    return Embedding(embeddings, labels, perplexity)


def _record(
    task: ModelTask, request: TsneRequest, streams: tuple[str, ...], perplexity: float, info: ModelInfo
) -> dict[str, Any]:
    """Returns what shapes the map, for the file's provenance."""
    return {
        "streams": list(streams),
        "split": task.split,
        "perplexity": perplexity,
        "clips_per_video": request.clips_per_video,
        **task.model_record(info),
    }


def _embedding(features: np.ndarray, labels: np.ndarray, perplexity: float, seed: int) -> StreamEmbedding:
    figures = {"neighbor_accuracy": neighbor_accuracy(features, labels), "silhouette": silhouette(features, labels)}
    values = {"perplexity": perplexity, **{key: value for key, value in figures.items() if value is not None}}
    return StreamEmbedding(features, plane(features, perplexity, seed), values)


def _tell_what_is_missing(labels: np.ndarray) -> None:
    """Says which figures there can't be, and why."""
    unknown, classes = int((labels < 0).sum()), len(np.unique(labels[labels >= 0]))
    if unknown:
        log.info(
            f"{unknown} of {counted(len(labels), 'video')} without a label: gray in the picture, left out of the figures"
        )
    if classes < 2:
        log.info(
            f"{'one class' if classes else 'no labels'}: no neighbors' accuracy and no silhouette, which compare classes"
        )


def _caption(embedding: StreamEmbedding) -> str:
    accuracy, value = embedding.values.get("neighbor_accuracy"), embedding.values.get("silhouette")
    first = f"{NEIGHBORS} nearest neighbors {'-' if accuracy is None else f'{100 * accuracy:.1f} %'}"
    return f"{first}, silhouette {'-' if value is None else f'{value:.3f}'}"
