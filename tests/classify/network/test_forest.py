"""A forest as tensors votes as scikit-learn's trees do, travels with weights, and a damaged one ends."""

from __future__ import annotations

import numpy as np
import torch
from sklearn.ensemble import ExtraTreesClassifier

from dpcli.classify.network.forest import Forest


def grown(nodes=99):
    rng = np.random.default_rng(0)
    values, labels = rng.normal(size=(60, 5)).astype(np.float32), rng.integers(0, 3, 60) * 2  # classes 0, 2 and 4
    values[:, 0] += labels
    theirs = ExtraTreesClassifier(20, random_state=0).fit(values, labels)
    return Forest.grown(theirs, nodes, 6), theirs, values


def test_votes_are_those_of_the_trees():
    ours, theirs, values = grown()
    asked = np.concatenate([values, np.random.default_rng(1).normal(size=(40, 5)).astype(np.float32)])
    votes = np.zeros((100, 6))
    for tree in theirs.estimators_:
        votes[np.arange(100), theirs.classes_[tree.predict(asked).astype(int)]] += 1
    found = ours(torch.from_numpy(asked)).numpy()
    assert np.abs(found - (votes + 1) / 26).max() < 1e-6 and (found[:, 1] == 1 / 26).all()


def test_a_threshold_between_neighboring_numbers_parts_them():
    """Two float32 without another between them: a threshold that is rounded to the larger sends both to the left."""
    low = np.float32(1000)
    values = np.array([[low], [np.nextafter(low, np.float32(2000))]], np.float32)
    theirs = ExtraTreesClassifier(50, random_state=0).fit(values, [0, 1])
    votes = Forest.grown(theirs, 3, 2)(torch.from_numpy(values)).numpy()
    assert np.allclose(votes, np.array([[51, 1], [1, 51]]) / 52)


def test_it_comes_back_from_its_tensors():
    ours, _, values = grown()
    again = Forest(20, 99, 6)
    again.load_state_dict(ours.state_dict())
    assert torch.equal(again(torch.from_numpy(values)), ours(torch.from_numpy(values)))


def test_a_damaged_one_ends_with_probabilities():
    ours, _, values = grown()
    ours.feature[:], ours.left[:], ours.right[:], ours.label[:] = 10**6, 7, -(10**6), 10**6  # a circle of nodes
    found = ours(torch.from_numpy(values))
    assert torch.isfinite(found).all() and torch.allclose(found.sum(1), torch.ones(60))
