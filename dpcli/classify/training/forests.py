"""Forests beside the members of a network for sparse clouds: each grown from the videos that its member learned from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dpcli.classify.data.augment import NONE
from dpcli.classify.data.clips import ClipSource
from dpcli.classify.data.descriptors import clip_descriptors
from dpcli.classify.network.config import KinetConfig
from dpcli.classify.network.forest import Forest
from dpcli.classify.network.kinet import Kinet

TREES = 125  # of each forest


def grow_forests(model: Kinet, source: ClipSource, seed: int) -> KinetConfig:
    """Grows a forest beside each member of the backbone slots from the whole videos of `source` that are not of its fold;
    returns the configuration of the network with them."""
    from sklearn.ensemble import ExtraTreesClassifier

    described, labels = _described(source), source.reader.labels[source.sequences]
    folds = np.array([source.folds.get(sequence, -1) for sequence in source.sequences])
    grown = []
    for number in range(len(model.static.members)):
        own = folds != number
        if not own.any():
            own[:] = True
        forest = ExtraTreesClassifier(TREES, random_state=(seed + number) % 2**32, n_jobs=1)
        grown.append(forest.fit(described[own], labels[own]))
    nodes = max(one.tree_.node_count for forest in grown for one in forest.estimators_)
    config = model.config.changed(forest=(TREES, nodes))
    for member, forest in zip(model.static.members, grown):
        member.forest = Forest.grown(forest, nodes, config.num_classes).to(member.position.device)
    model.config = model.static.config = config
    return config


def _described(source: ClipSource) -> np.ndarray:
    """Returns the descriptors f32 (S,D) of each video as it is."""
    plain = ClipSource(
        source.reader, source.sequences, replace(source.config), timing="slots", augmentation=NONE, seed=source.seed
    )
    clips = [plain.video_clips(sequence, 1)[0] for sequence in plain.sequences]
    return np.concatenate([clip_descriptors(plain.load(clip, clip.sequence)[None]) for clip in clips])
