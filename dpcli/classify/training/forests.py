"""Forests beside the members of a network for sparse clouds: each grown from the videos that its member learned from."""

from __future__ import annotations

import numpy as np
import torch

from dpcli.classify.data.clips import ClipSource
from dpcli.classify.fusion import geometric_weights
from dpcli.classify.network.config import KinetConfig
from dpcli.classify.network.descriptors import clip_descriptors
from dpcli.classify.network.forest import Forest
from dpcli.classify.network.kinet import Kinet
from dpcli.runtime.progress import log
from dpcli.runtime.seeds import scikit_learn_state

TREES = 125  # of each forest
UNJUDGED = 0.3  # their share where no video is left to choose it by
_BATCH = 64


def grow_forests(model: Kinet, source: ClipSource, seed: int) -> KinetConfig:
    """Grows a forest beside each member of the backbone slots from the whole videos of `source` that are not of its fold;
    returns the configuration of the network with them.

    Their share beside the networks is what the folds make likeliest.
    """
    from sklearn.ensemble import ExtraTreesClassifier

    clips = _whole_clips(source)
    described, labels = clip_descriptors(clips), source.reader.labels[source.sequences]
    folds = np.array([source.folds.get(sequence, -1) for sequence in source.sequences])
    grown = []
    for number in range(len(model.static.members)):
        own = folds != number
        if not own.any():
            own[:] = True
        forest = ExtraTreesClassifier(TREES, random_state=scikit_learn_state(seed + number), n_jobs=1)
        grown.append(forest.fit(described[own], labels[own]))
    nodes = max(one.tree_.node_count for forest in grown for one in forest.estimators_)
    config = model.config.changed(forest=(TREES, nodes))
    for member, forest in zip(model.static.members, grown):
        member.forest = Forest.grown(forest, nodes, config.num_classes).to(member.position.device)
    model.config = model.static.config = config
    model.static.forest_share.fill_(_share(model, clips, labels) if source.folds else UNJUDGED)
    log.info(f"forests on descriptors have a weight of {float(model.static.forest_share):.2f} beside the networks")
    return config


@torch.inference_mode()
def _share(model: Kinet, clips: np.ndarray, labels: np.ndarray) -> float:
    """Returns the forests' share in the geometric mean that makes the labels likeliest, each clip judged by the member that
    must not learn from it."""
    model.eval()
    scores, where = [], model.static.forest_share.device
    for share in (0.0, 1.0):
        model.static.forest_share.fill_(share)
        parts = [
            torch.softmax(model.static_logits(some), -1) for some in torch.from_numpy(clips).to(where).split(_BATCH)
        ]
        scores.append(torch.cat(parts).cpu().numpy())
    return float(geometric_weights(np.stack(scores), labels)[1])


def _whole_clips(source: ClipSource) -> np.ndarray:
    """Returns each video as it is, as clips f32 (S,T,P,5+F), marked by their folds."""
    plain = ClipSource(
        source.reader, source.sequences, source.config, timing="slots", seed=source.seed, folds=source.folds
    )
    clips = [plain.video_clips(sequence, 1)[0] for sequence in plain.sequences]
    return np.stack([plain.load(clip, clip.sequence) for clip in clips])
