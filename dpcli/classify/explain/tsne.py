"""Video features in the plane: the vectors before the last layer, averaged over a video's clips, by t-SNE (thesis A.3.2).

t-SNE (van der Maaten and Hinton, 2008) keeps neighbors, not distances: so two figures of the features themselves stand
beside the picture, the leave-one-out accuracy of the five nearest neighbors and the silhouette.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from dpcli.classify.data.clips import ClipSource
from dpcli.classify.explain.features import ClipVectors
from dpcli.classify.network.kinet import Kinet
from dpcli.classify.video_scores import batches
from dpcli.counted import counted
from dpcli.errors import DataError, UsageError
from dpcli.runtime.progress import Progress
from dpcli.runtime.seeds import scikit_learn_state
from dpcli.runtime.signals import stop_requested

NEIGHBORS = 5
_PERPLEXITY = 30.0  # by default, and less where there are few videos
_FEWEST = 4  # videos
_ROWS = 256  # videos whose distances from all others are held at once


def video_features(
    model: Kinet, source: ClipSource, clips_per_video: int | None, batch: int, device: torch.device
) -> dict[str, np.ndarray]:
    """Returns the mean over each video's clips of the vector before the last layer, f32 (S,D) by stream, in `source.sequences`' order.

    The points drawn are those of prediction, so the batch makes no difference beyond rounding.
    """
    place = {sequence: row for row, sequence in enumerate(source.sequences)}
    sums: dict[str, np.ndarray] = {}
    counts = np.zeros(len(place))
    look: ClipVectors | None = None
    with stop_requested() as stop, Progress("explain tsne", len(place), "video") as bar:
        for clips, points in batches(source, source.clips(clips_per_video), batch):
            points = points.to(device)
            look = look or ClipVectors(model, points[:1])
            rows = [place[clip.sequence] for clip in clips]
            bar.advance(len({row for row in rows if counts[row] == 0}), clips=len(rows))
            np.add.at(counts, rows, 1)
            for stream, vectors in look.vectors(points).items():
                total = sums.setdefault(stream, np.zeros((len(place), vectors.shape[1])))
                np.add.at(total, rows, vectors.double().cpu().numpy())
            stop.check("nothing was kept", again="to start over")
    return {stream: (total / counts[:, None]).astype(np.float32) for stream, total in sums.items()}


def joined_features(features: dict[str, np.ndarray]) -> np.ndarray:
    """Returns both streams' vectors, each of unit length, side by side: f32 (S,D1+D2)."""
    norms = [np.maximum(np.linalg.norm(features[s], axis=1, keepdims=True), 1e-12) for s in ("static", "dynamic")]
    return np.concatenate([features[s] / n for s, n in zip(("static", "dynamic"), norms)], axis=1).astype(np.float32)


def chosen_perplexity(wanted: float | None, videos: int) -> float:
    """Returns `wanted`, or without it 30 and at most a third of the others.

    Raises DataError below four videos, UsageError for a perplexity out of range.

    >>> chosen_perplexity(None, videos=31)
    10.0
    """
    if videos < _FEWEST:
        raise DataError(
            f"{counted(videos, 'video')} for a map, expected at least {_FEWEST}; take another --split, or all"
        )
    if wanted is None:
        return min(_PERPLEXITY, (videos - 1) / 3)
    if not 1 <= wanted < videos:
        raise UsageError(f"--perplexity {wanted:g}: expected 1 or more, and less than the {videos} videos")
    return wanted


def plane(features: np.ndarray, perplexity: float, seed: int) -> np.ndarray:
    """Returns coordinates f32 (S,2) by t-SNE of features (S,D): Euclidean distances, started from the first two principal components."""
    from sklearn.manifold import TSNE

    if np.ptp(features, axis=0).max(initial=0) == 0:
        raise DataError(
            f"all {len(features)} videos have the same feature vector; the stream has not been trained, or is dead"
        )
    # scaled as a whole, which changes no neighbor, so that the search for bandwidths starts near its goal
    scaled = (features - features.mean(0)) / features.std()
    fit = TSNE(
        2,
        perplexity=perplexity,
        init="pca",
        learning_rate="auto",
        random_state=scikit_learn_state(seed),
        method="exact" if len(features) < 500 else "barnes_hut",
    )
    return fit.fit_transform(scaled.astype(np.float64)).astype(np.float32)


def neighbor_accuracy(features: np.ndarray, labels: np.ndarray, k: int = NEIGHBORS) -> float | None:
    """Returns the share of the labeled videos (S,D) whose k nearest other labeled ones vote for their class; None where it says nothing.

    Euclidean distances in float64, ties to the lower index; a tied vote goes to the tied class with the nearest member.
    Fewer than k+1 videos: all others vote. None with fewer than two videos or classes.
    """
    known = labels >= 0
    vectors, truth = features[known].astype(np.float64), labels[known]
    if len(truth) < 2 or len(np.unique(truth)) < 2:
        return None
    nearest = _nearest(vectors, min(k, len(truth) - 1))
    return float(np.mean([_vote(truth[row]) == own for row, own in zip(nearest, truth)]))


def _nearest(vectors: np.ndarray, k: int) -> Iterator[np.ndarray]:
    """Yields the indices of the k nearest others of each vector, some rows of distances in memory at a time."""
    from scipy.spatial.distance import cdist

    for start in range(0, len(vectors), _ROWS):
        distance = cdist(vectors[start : start + _ROWS], vectors)
        distance[np.arange(len(distance)), start + np.arange(len(distance))] = np.inf
        yield from np.argsort(distance, axis=1, kind="stable")[:, :k]


def _vote(labels: np.ndarray) -> int:
    """Returns the most frequent label; of equally frequent ones the first."""
    values, first, counts = np.unique(labels, return_index=True, return_counts=True)
    best = counts == counts.max()
    return int(values[best][first[best].argmin()])


def silhouette(features: np.ndarray, labels: np.ndarray) -> float | None:
    """Returns the mean over labeled videos of (b - a) / max(a, b), -1..1 (Rousseeuw, 1987): a the mean Euclidean distance to the own
    class, b to the nearest other one; 0 for a class of one. None unless there are two classes, one with two videos."""
    from sklearn.metrics import silhouette_score

    known = labels >= 0
    classes = len(np.unique(labels[known]))
    if not 2 <= classes < int(known.sum()):
        return None
    return float(silhouette_score(features[known].astype(np.float64), labels[known]))
