"""Making the learned and temporal metrics with their networks; one whose weights are absent doesn't keep the others away."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from dpcli.errors import DpcError
from dpcli.evaluate.choices import FRECHET_METRICS
from dpcli.evaluate.video.learned.base import LearnedMetric
from dpcli.evaluate.video.learned.clip import ClipMetric, ClipTemporal, ClipViews, PairEmbeddings
from dpcli.evaluate.video.learned.fvd import FrechetMetric
from dpcli.evaluate.video.learned.lpips import LpipsMetric
from dpcli.evaluate.video.learned.warping import WarpingMetric
from dpcli.evaluate.video.protocol import Networks


def load_metrics(
    names: Sequence[str], networks: Networks, folder: Path, device: str = "cpu"
) -> tuple[dict[str, LearnedMetric], dict[str, str]]:
    """Returns the metrics by name, and the reason for each that can't be had: weights or a package that are absent.

    names: of LEARNED_METRICS. folder: of the weights. device: a torch device, on which the networks run.
    """
    made: dict[str, LearnedMetric] = {}
    missing: dict[str, str] = {}
    embeddings: dict[tuple[str, bool], PairEmbeddings] = {}
    for name in names:
        try:
            made[name] = _load_metric(name, networks, folder, device, embeddings)
        except DpcError as error:
            missing[name] = str(error)
    return made, missing


def _load_metric(name: str, networks: Networks, folder: Path, device: str, embeddings: dict) -> LearnedMetric:
    if name == "lpips":
        return LpipsMetric(networks, folder, device)
    if name in FRECHET_METRICS:
        return FrechetMetric(name, networks, folder, device)
    if name == "warping":
        return WarpingMetric()
    if name == "clip_spherical":  # 4DGen's: other weights, colors swapped by its reader
        networks = Networks(clip="laion")
    key = networks.clip, name == "clip_spherical"
    if key not in embeddings:
        embeddings[key] = PairEmbeddings(networks, folder, device, bgr=key[1])
    if name == "clip_temporal":
        return ClipTemporal(embeddings[key])
    return ClipViews(embeddings[key]) if name == "clip_views" else ClipMetric(name, embeddings[key])
